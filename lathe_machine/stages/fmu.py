# SPDX-License-Identifier: Apache-2.0
"""Functional Mock-up Unit of another tool as a stage.

The FMU's clock is the sample counter: at sample n the stage sets the inputs, lets the FMU compute from n·h to
(n + 1)·h, and reads the outputs. With ``fmu_step`` = N·h, the inputs are those of the first of N samples, and the
outputs change at the last one.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lathe_machine.fmi.c_function import c_status
from lathe_machine.fmi.units import alike, powers
from lathe_rc import messages
from lathe_rc.arrays import Array, Integers
from lathe_rc.blocks.columns import units
from lathe_rc.blocks.ports import CLOCK, Input, Joint, Output, Sparse
from lathe_rc.cell.parameters import NodeParameters, NonNegative, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached, Stage, WiredCell
from lathe_rc.compiled.step import CompiledStep
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples, Signals

if TYPE_CHECKING:
    from lathe_machine.fmi.imported import Fmu, Instance, Unit, Variable

_TYPES = {
    **{name: (msgtype,) for name, msgtype in messages.BLOCK_TOPICS.items()},
    "command": (messages.COMMAND, messages.SERVO),
    "demand": (messages.SERVO,),
    "reference": (messages.REFERENCE,),
}  # block types by the last component of a topic's name
_FAILED, _TERMINATED = 1, 2  # reasons why the step stops
_TRIAL = 16  # communication steps of the check for equal bits
_WARNING = 1  # the highest status of a call that has not failed
_REACHED = 1e-6  # largest difference between the end of a step and the time that the FMU has reached, in steps


class FmuParameters(NodeParameters):
    """FMU, its connections to topics, and its parameters."""

    fmu_file: str = parameter("", "FMU for co-simulation (FMI 2.0 or 3.0); machine code that the node runs", path=True)
    fmu_inputs: list[str] = parameter(
        [], "VARIABLE = TOPIC.FIELD for each input, with 'delayed N' (samples) behind it for feedback"
    )
    fmu_outputs: list[str] = parameter(
        [], "TOPIC.FIELD = VARIABLE, or = NUMBER, for each field of the topics that the node publishes"
    )
    fmu_parameters: list[str] = parameter([], "VARIABLE = VALUE before the start; numbers in SI units")
    fmu_step: NonNegative = parameter(0.0, "step of the FMU, a multiple of the sample; 0: one sample", "s")


class Memory(NamedTuple):
    """Memory of the step.

    Attributes:
        is_3: whether the FMU implements FMI 3.0; otherwise 2.0.
        component: address of the instance.
        set, get, advance: addresses of the FMU's functions.
        period: communication step [s].
        every: communication step [sample].
        sources: field of each FMU input.
        factors, offsets: units of the FMU's inputs (see `lathe_machine.fmi.imported.Unit`).
        inputs, outputs: value references, uint32 as bytes.
        given, got: newest inputs and outputs in the FMU's units.
        places: FMU output of each field; -1 for a constant.
        scales, shifts: its unit; for a constant, ``shifts`` is the value.
        told: FMI 3.0: event, end and early return, as C writes them.
        reached: FMI 3.0: time that the FMU has reached [s].
    """

    is_3: bool
    component: int
    set: int
    get: int
    advance: int
    period: float
    every: int
    sources: Integers
    factors: Array
    offsets: Array
    inputs: Samples
    outputs: Samples
    given: Array
    got: Array
    places: Integers
    scales: Array
    shifts: Array
    told: Samples
    reached: Array


@kernel
def advance(memory: Memory, index: int) -> int:
    """Compute a communication step that begins at sample ``index``, and return the FMU's status, or -1 at its end."""
    unit, values, begin = memory.component, memory.given, index / memory.every * memory.period
    status: int
    if values.size:
        references, pointer = memory.inputs.ctypes.data, values.ctypes.data
        if memory.is_3:
            status = c_status(memory.set, (unit, references, values.size, pointer, values.size))
        else:
            status = c_status(memory.set, (unit, references, values.size, pointer))
        if status > _WARNING:
            return status
    if memory.is_3:
        told = memory.told.ctypes.data
        end = memory.reached.ctypes.data
        status = c_status(memory.advance, (unit, begin, memory.period, 1, told, told + 1, told + 2, end))
        if memory.told[1]:
            return -1
        if abs(memory.reached[0] - begin - memory.period) > _REACHED * memory.period:
            return max(status, _WARNING + 1)
    else:
        status = c_status(memory.advance, (unit, begin, memory.period, 1))
    return fetch(memory) if status <= _WARNING else status


@kernel
def fetch(memory: Memory) -> int:
    """Read the outputs of the FMU, and return its status."""
    unit, values = memory.component, memory.got
    if not values.size:
        return 0
    references, pointer = memory.outputs.ctypes.data, values.ctypes.data
    status: int
    if memory.is_3:
        status = c_status(memory.get, (unit, references, values.size, pointer, values.size))
    else:
        status = c_status(memory.get, (unit, references, values.size, pointer))
    return status


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Compute one block."""
    samples = outputs[0].size
    for k in range(start, samples):
        place = (first + k) % memory.every
        if place == 0:
            for i in range(memory.sources.size):
                memory.given[i] = (inputs[memory.sources[i]][k] - memory.offsets[i]) / memory.factors[i]
        if place == memory.every - 1:
            status = advance(memory, first + k - place)
            if status > _WARNING or status < 0:
                return k, _FAILED if status > _WARNING else _TERMINATED
        for j in range(len(outputs)):
            value = memory.got[memory.places[j]] if memory.places[j] >= 0 else 0.0
            outputs[j][k] = memory.scales[j] * value + memory.shifts[j]
    return samples, DONE


def _parted(text: str, *, last: bool) -> tuple[str, str]:
    """Return both sides of a rule; names of variables may contain the sign, those of topics do not."""
    left, sign, right = text.rpartition("=") if last else text.partition("=")
    if not (sign and left.strip() and right.strip()):
        raise InputError(f"{text!r}; allowed: NAME = NAME")
    return left.strip(), right.strip()


def _signal(text: str) -> tuple[str, str, str]:
    """Return the topic, type and field of TOPIC.FIELD."""
    topic, _, field = text.rpartition(".")
    for msgtype in (types := _TYPES.get(topic.rpartition("/")[2], ())):
        if messages.sample_fields(msgtype).get(field) == np.float64:
            return topic, msgtype, field
    fields = [f"{topic}.{each}" for msgtype in types for each in messages.sample_fields(msgtype)]
    allowed = ", ".join(fields) or f"TOPIC.FIELD with a TOPIC that ends in {', '.join(_TYPES)}"
    raise InputError(f"{text!r}; allowed: {allowed}")


def _checked(variable: "Variable", signal: str, msgtype: str, field: str) -> "Unit":
    """Return the unit of a variable, which must be one of a field's quantity."""
    unit, wanted = variable.unit, units(msgtype)[field]
    if unit.powers is not None and not any(alike(unit.powers, powers(each) or {}) for each in wanted.split(" or ")):
        raise InputError(
            f"{shown(variable.name)!r} is in {shown(unit.name)} and {signal} in {wanted}; allowed: a "
            "variable of the same quantity"
        )
    return unit


class FmuStage(Stage):
    """Functional Mock-up Unit as a stage, whose ports follow from its parameters.

    Attributes:
        fmu: the FMU.
    """

    kind = "fmu"
    Parameters = FmuParameters
    parameters: FmuParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: FmuParameters) -> None:
        super().__init__(name, parameters)
        self._memory: Memory | None = None
        self._instance: Instance | None = None
        self._saved: Samples | None = None  # state from which the instance goes on
        if not parameters.fmu_file:
            return  # without ports, for the reference; see `check_cell`
        with about(name, "fmu_file"):
            self.fmu = _read(parameters.fmu_file)
        self._every = self._samples_of_step()
        with about(name, "fmu_inputs"):
            inputs = self._read_inputs()
        with about(name, "fmu_outputs"):
            outputs = self._read_outputs()
        with about(name, "fmu_parameters"):
            self._values = dict(map(self._value, parameters.fmu_parameters))
        self.declare(inputs=inputs, outputs=outputs)
        if all(port.delay for port in self.inputs):
            # Blocks of the encoder set the pace of a node that reads nothing else in time, outside of the step.
            self.inputs += (CLOCK,)

    def _samples_of_step(self) -> int:
        wanted, sample = self.parameters.fmu_step or self.shared.step, self.shared.step
        every = max(round(wanted / sample), 1)
        usual = f"; the FMU is made for {self.fmu.usual_step:g} s" if self.fmu.usual_step else ""
        with about(self.name, "fmu_step"):
            if abs(every * sample - wanted) > 1e-9 * wanted:
                raise InputError(f"{wanted:g} s; allowed: a multiple of the sample, {sample:.9g} s{usual}")
            self.fmu.check_step(every * sample)
        return every

    def _read_inputs(self) -> list[Input]:
        ports: dict[tuple[str, str, int], list[str]] = {}
        found: list[tuple[tuple[str, str, int], str, Variable]] = []
        for rule in self.parameters.fmu_inputs:
            name, source = _parted(rule, last=True)
            source, _, delay = source.partition(" delayed ")
            if delay and not delay.strip().isdecimal():
                raise InputError(f"{rule!r}; allowed: delayed N, N in samples")
            topic, msgtype, field = _signal(source.strip())
            variable = self.fmu.variable(name, "input")
            _checked(variable, source, msgtype, field)
            key = topic, msgtype, int(delay or 0)
            if field not in ports.setdefault(key, []):
                ports[key].append(field)
            found.append((key, field, variable))
        _refuse_doubles([variable.name for *_, variable in found])
        places = [(key, field) for key, fields in ports.items() for field in fields]
        self._inputs = [(places.index((key, field)), variable) for key, field, variable in found]
        return [Input(topic, msgtype, tuple(fields), delay) for (topic, msgtype, delay), fields in ports.items()]

    def _read_outputs(self) -> list[Output]:
        ports: dict[str, str] = {}
        given: dict[str, str] = {}
        for rule in self.parameters.fmu_outputs:
            signal, name = _parted(rule, last=False)
            topic, msgtype, field = _signal(signal)
            if ports.setdefault(topic, msgtype) != msgtype:
                raise InputError(f"{signal!r}: {topic} is a {ports[topic]}")
            _refuse_doubles([*given, f"{topic}.{field}"])
            given[f"{topic}.{field}"] = name
        if not ports:
            raise InputError("no output; allowed: TOPIC.FIELD = VARIABLE, at least one")
        self._outputs: list[Variable | float] = []
        for topic, msgtype in ports.items():
            for field in messages.sample_fields(msgtype):
                if (signal := f"{topic}.{field}") not in given:
                    raise InputError(f"nothing for {signal}; allowed: {signal} = VARIABLE, or = NUMBER")
                self._outputs.append(self._source(given[signal], signal, msgtype, field))
        states = [topic for topic, msgtype in ports.items() if msgtype == messages.STATE]
        joint = Joint("position", "velocity", "effort")
        return [Output(topic, kind, joint if topic in states[:1] else None) for topic, kind in ports.items()]

    def _source(self, name: str, signal: str, msgtype: str, field: str) -> "Variable | float":
        """Return the variable or number that an output's field is given."""
        if name not in self.fmu.variables:
            try:
                return float(name)
            except ValueError:
                pass  # the error lists the variables
        variable = self.fmu.variable(name, "output", "local", "input")
        _checked(variable, signal, msgtype, field)
        return variable

    def _value(self, rule: str) -> tuple[str, object]:
        """Return a variable that is set before the start, and its value in the variable's unit."""
        name, text = _parted(rule, last=True)
        variable = self.fmu.variables.get(name)
        if variable is None or not variable.settable:
            known = [each for each, found in self.fmu.variables.items() if found.settable]
            raise InputError(f"{rule!r}: nothing to set; allowed: {', '.join(map(shown, known)) or 'none'}")
        if not variable.is_real:
            return name, text
        try:
            return name, (float(text) - variable.unit.offset) / variable.unit.factor
        except ValueError:
            raise InputError(f"{rule!r}; allowed: a number") from None

    def check_cell(self, cell: WiredCell, *, cures: bool = True) -> None:
        """Check that two instances of the FMU give equal bits in its first steps, with all inputs 0."""
        super().check_cell(cell, cures=cures)
        if not self.parameters.fmu_file:
            raise InputError(f"{self.name}.fmu_file is not given; allowed: the path of an FMU")
        if self.fmu.is_single:
            cell.unchecked.append(f"{self.name}: a process may have one instance of the FMU: nobody compares two")
            return
        with about(self.name, "fmu_file"):
            # Both are there at once: an unloaded library would forget what its instances share.
            both = self._instantiated(), self._instantiated()
            if self._trial(both[0]) != self._trial(both[1]):
                raise InputError(
                    f"{self.fmu.path}: two instances differ in the first {_TRIAL} steps; allowed: an FMU without "
                    "clock, random numbers of its own and uninitialised memory"
                )

    def _trial(self, instance: "Instance") -> bytes:
        """Return the outputs of a new instance in its first steps."""
        read, written = self.field_types
        fields = [np.zeros(_TRIAL * self._every, kind) for kind in (*read, *written)]
        reached, reason = CompiledStep(step, self._laid_out(instance), read, written)(0, 0, fields, fields[0].size)
        if reason != DONE:
            raise InputError(self._failure(instance, reason, reached))
        return b"".join(field.tobytes() for field in fields[len(read) :])

    # ---- the instance ---------------------------------------------------------------------------------

    def _instantiated(self) -> "Instance":
        from lathe_machine.fmi.imported import Instance

        return Instance(self.fmu, self._values)

    @property
    def needs_python(self) -> str:
        """Return that the step calls functions of a loaded FMU."""
        return "an FMU is loaded by Python; allowed: export the other nodes, and wire the FMU to them where they run"

    @property
    def memory(self) -> Memory:
        """Memory of the step, with a running instance of the FMU, which begins when it is first needed."""
        if self._memory is None:
            with self.named():
                self._instance = self._instantiated()
            self._memory = memory = self._laid_out(self._instance)
            if self._saved is not None:
                told = self._saved.tobytes()
                size, rest = memory.given.nbytes, memory.given.nbytes + memory.got.nbytes
                memory.given[:], memory.got[:] = np.frombuffer(told[:size]), np.frombuffer(told[size:rest])
                self._instance.restore(told[rest:])
        return self._memory

    def _laid_out(self, instance: "Instance") -> Memory:
        number = "Float64" if self.fmu.is_3 else "Real"
        read = list(dict.fromkeys(each for each in self._outputs if not isinstance(each, float)))
        units = [variable.unit for _, variable in self._inputs]
        return Memory(
            self.fmu.is_3,
            instance.component,
            instance.address(f"Set{number}"),
            instance.address(f"Get{number}"),
            instance.address("DoStep"),
            self._every * self.shared.step,
            self._every,
            np.array([place for place, _ in self._inputs], np.int64),
            np.array([unit.factor for unit in units]),
            np.array([unit.offset for unit in units]),
            _references([variable for _, variable in self._inputs]),
            _references(read),
            np.zeros(len(units)),
            np.array(instance.numbers(read)),
            np.array([-1 if isinstance(each, float) else read.index(each) for each in self._outputs], np.int64),
            np.array([0.0 if isinstance(each, float) else each.unit.factor for each in self._outputs]),
            np.array([each if isinstance(each, float) else each.unit.offset for each in self._outputs]),
            np.zeros(3, np.uint8),
            np.zeros(1),
        )

    def serve(
        self, reason: int, first: int, reached: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        """Raise the error of a failed step.

        Raises:
            LatheError: the FMU has failed, or has asked for the end.
        """
        assert self._instance is not None, "it has computed"
        raise LatheError(self._failure(self._instance, reason, first + reached))

    def _failure(self, instance: "Instance", reason: int, index: int) -> str:
        """Return the message about a step that the FMU has not carried out."""
        what = f"{self.fmu.path.name} at {index * self.shared.step:.9g} s"
        if reason == _TERMINATED:
            return f"{what}: the FMU asks for the end of the simulation"
        made = f" (it is made for {self.fmu.usual_step:g} s)" if self.fmu.usual_step else ""
        size, why = self._every * self.shared.step, instance.failure("no reason given")
        return f"{what}: a step of {size:.9g} s failed: {why}; allowed: another fmu_step{made}"

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes that are state, with the FMU's own as bytes.

        Raises:
            LatheError: the FMU cannot save its state.
        """
        state = super().__getstate__() | {"_memory": None, "_instance": None}
        for name in ("fmu", "_inputs", "_outputs"):
            del state[name]  # they follow from the parameters
        if self._memory is not None:
            assert self._instance is not None, "both or none"
            told = self._memory.given.tobytes() + self._memory.got.tobytes() + self._instance.state()
            state["_saved"] = np.frombuffer(told, np.uint8)
        return state


def _read(path: str) -> "Fmu":
    from lathe_machine.fmi.imported import read

    return read(path)


def _references(variables: Sequence["Variable"]) -> Samples:
    return np.array([variable.reference for variable in variables], np.uint32).view(np.uint8)


def _refuse_doubles(names: Sequence[str]) -> None:
    for place, name in enumerate(names):
        if name in names[:place]:
            raise InputError(f"{shown(name)!r} twice; allowed: once")
