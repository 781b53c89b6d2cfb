# SPDX-License-Identifier: Apache-2.0
"""Several stages of a cell, wired together as one function of inputs, outputs and a block of state.

The block of state belongs to the caller. It holds, one after the other, the position in the run, tapes with the newest
samples of each signal, and the state of each stage, all of which `lathe_save` copies; then the memory of each stage and
its table, which hold addresses, and room for temporary arrays. ``lathe.c`` runs the steps on it;
`lathe_export.c_library.sources` writes its tables. No size depends on the processor: those of addresses are bounds.
"""

from collections.abc import Collection, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from math import inf, nextafter
from typing import Any, NamedTuple

import numpy as np

from lathe_export.c_library.printer import printed
from lathe_export.c_library.step_memory import Place, leaves
from lathe_rc import messages
from lathe_rc.blocks.columns import units
from lathe_rc.cell import events
from lathe_rc.cell.parameters import ParameterRow, explain_overflow, remapped
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.compiled.struct_view import address
from lathe_rc.errors import InputError, LatheError
from lathe_rc.messages import MAX_BLOCK
from lathe_rc.names import instead
from lathe_rc.safety.state_machine import Reaction, State
from lathe_rc.signals.noise import NormalStream

_HEAD = 256  # [B] of the block for the position in the run, see lathe.c
_LEAST = 512  # elements of a temporary array that any step may take
_HUGE = 1e300  # of a parameter without a limit
_CLOSE, _HALVINGS = 1e-3, 60  # relative accuracy of the limits that follow from checks, and steps of their search
_STROKE = 1.0  # [m] bound on displacements of the tool and their commands
_BOUNDS = {"m": 1e2, "m/s": 1e3, "rad": 1e9, "rad/s": 1e5, "N": 1e7, "A": 1e6, "V": 1e6, "1": 1e6}  # by unit
_FLAGS = {"index_pulse": 1.0, "reaction": float(max(Reaction)), "state": float(max(State))}
LEARN = {"learn": 1.0, "freeze": 0.0}  #: events that set the parameter ``learning``


@dataclass(frozen=True)
class Signal:
    """Field of a topic that the caller gives or gets.

    Attributes:
        topic, field: relative topic after remapping, and the field of its messages.
        unit: unit; empty if there is none.
        bytes: size of a sample: 8 for a double, 4 for a float, 1 for a uint8_t.
        tape: index of the tape.
        low, high: smallest and largest value that is accepted or given.
        delay: for an input, the caller gives at sample k the value of sample k - delay.
    """

    topic: str
    field: str
    unit: str
    bytes: int
    tape: int
    low: float
    high: float
    delay: int = 0

    @property
    def name(self) -> str:
        """Topic and field, as in ``coarse/command.position``."""
        return f"{self.topic}.{self.field}"


@dataclass(frozen=True)
class Parameter:
    """Number in the state of a stage that the caller may change.

    Attributes:
        part: index of the stage.
        name: node and parameter, as in ``learning_controller.learning_gain``.
        unit: unit; empty if there is none.
        doc: description.
        low, high: smallest and largest permitted value.
        limits: the range in words; empty if there is none.
        whole: whether it is an integer.
        value: value at the start.
        places: offsets in the block at which it is stored [B].
    """

    part: int
    name: str
    unit: str
    doc: str
    low: float
    high: float
    limits: str
    whole: bool
    value: float
    places: Sequence[int]


class Tape(NamedTuple):
    """Newest samples of a signal.

    Attributes:
        offset: place in the block [B].
        bytes: size of a sample.
        length: samples that are kept for delayed readers, each stored twice; 0: only those of the current call.
    """

    offset: int
    bytes: int
    length: int


@dataclass(frozen=True)
class LibraryStage:
    """Stage of a library.

    Attributes:
        stage: the stage, before its first sample.
        symbol: name of its functions.
        code: the functions in C.
        arrays: number of places in them that make a temporary array.
        state, memory, table: offsets of its state, memory and address table in the block [B].
        reads: tape and delay of each entry of the address table; tape -1: none.
        writes: indices of its outputs among those of the library.
    """

    stage: Stage
    symbol: str
    code: str
    arrays: int
    state: int
    memory: int
    table: int
    reads: Sequence[tuple[int, int]]
    writes: Sequence[int]


@dataclass(frozen=True)
class Stream:
    """Random stream of a stage.

    Attributes:
        state: offset of its state in the block [B].
        values, used: offsets of the numbers drawn in advance and of the number of those used [B].
        seed: state and increment of PCG64 at the start, lower words first.
    """

    state: int
    values: int
    used: int
    seed: Sequence[int]


@dataclass
class Library:
    """Stages of a cell as a library (see the module).

    Args:
        cell: wired cell, before its first sample.
        nodes: names of the stages; all others of the cell give inputs.
        name: name of the library, a C identifier.
        block: largest number of samples in a call.
        tune: further parameters that the caller may change, as NODE.PARAM, or a NODE for all whose values its step
            reads as they are; those that the event ``set`` may change are always among them.
        real: type of real numbers in C, ``double`` or ``float``.

    Attributes:
        step: sampling step [s].
        inputs, outputs: signals, in the order of the caller's arrays.
        parameters: numbers that the caller may change.
        parts, tapes, streams: see the classes.
        held: offset of the newest value of each output, 8 B each [B].
        saved: size of a saved state, with which the block begins [B].
        room: offset of the room for temporary arrays [B].
        size: size of the block [B].
        left_out: events and faults of the scenario, which the caller has to cause; one line each.
        fixed: other parameters of nodes in ``tune``, and those that the event ``set`` may change, whose values the step
            does not read as they are, with the members of its memory that depend on them.

    Raises:
        InputError: a stage is unknown or needs Python, a stage that is left out lies between two others, the block is
            longer than a delay, or a parameter to be tuned is none or is not stored as it is.
    """

    cell: Cell
    nodes: Collection[str]
    name: str
    block: int
    tune: Collection[str] = ()
    real: str = "double"
    inputs: list[Signal] = field(default_factory=list)
    outputs: list[Signal] = field(default_factory=list)
    parameters: list[Parameter] = field(default_factory=list)
    parts: list[LibraryStage] = field(default_factory=list)
    tapes: list[Tape] = field(default_factory=list)
    streams: list[Stream] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    fixed: dict[str, list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        known = self.cell.stages
        for name in self.nodes:
            if name not in known:
                raise InputError(f"node {name}; {instead(name, known)}")
        stages = [stage for name, stage in known.items() if name in self.nodes]
        if not 1 <= self.block <= MAX_BLOCK:
            raise InputError(f"--block {self.block}; allowed: 1 up to {MAX_BLOCK}")
        for stage in stages:
            self._check(stage)
        self._check_between(stages)
        self.step = stages[0].shared.step
        self._end, self._real = _HEAD, {"double": 8, "float": 4}[self.real]
        numbers = self._lay_tapes(stages)
        self.held = self._append(8 * len(self.outputs))
        for stage in stages:
            self._add(stage, numbers)
            self._check_events(stage)
        self.saved = self._end
        for place, part in enumerate(self.parts):
            memory = self._append(8 * max(part.stage.native().view.size, 1))
            self.parts[place] = replace(part, memory=memory, table=self._append(8 * len(part.reads)))
        for name in self.tune:
            if name not in {*self.nodes, *(parameter.name for parameter in self.parameters)}:
                node, _, parameter = name.partition(".")
                if node not in self.nodes or parameter not in type(known[node].shared).rows():
                    raise InputError(f"--tune {name}; allowed: NODE.PARAM of {', '.join(sorted(self.nodes))}")
                raise InputError(f"--tune {name}: the step does not store it as it is; allowed: export once more")
        arrays = max(part.arrays for part in self.parts)
        self.room = self._end
        self.size = self.room + (arrays + 1) * self._real * max(self.block, _LEAST)

    # ---- checks -------------------------------------------------------------------------------------

    def _check(self, stage: Stage) -> None:
        if why := stage.needs_python:
            raise InputError(f"{stage.name}: {why}")
        for port in stage.inputs[: stage.own_inputs]:
            if 0 < port.delay < self.block:
                raise InputError(
                    f"--block {self.block}: {stage.name} reads {port.topic} {port.delay} samples late; allowed: 1 up "
                    f"to {port.delay}"
                )

    def _check_events(self, stage: Stage) -> None:
        """Check that the caller can cause the events of a stage by its parameters, and list them."""
        known = {parameter.name for parameter in self.parameters}
        for event in stage.waiting:
            verb, target, _ = events.parse(event.partition(": ")[2])
            name = target if verb == events.SET else "learning" if verb in LEARN else ""
            if f"{stage.name}.{name}" not in known:
                raise InputError(
                    f"{stage.name}: the event {event!r} changes no parameter of the exported step; allowed: a scenario "
                    f"without it (--set {stage.name}.events=[] --set {stage.name}.faults=[])"
                )
            self.left_out.append(f"{stage.name}: {event}")

    def _check_between(self, stages: Sequence[Stage]) -> None:
        """Check that no stage outside of the library reads it and is read by it in the same sample."""
        after: dict[str, str] = {}  # nodes outside, with the node of the library that they depend on
        for name, stage in self.cell.stages.items():
            for port in stage.inputs[: stage.own_inputs]:
                source = self.cell.node_of(remapped(stage.shared, port.topic))
                if port.delay or source is None:
                    continue
                if stage in stages and source in after:
                    raise InputError(
                        f"{source} lies between {after[source]} and {name}: it reads the one and is read by the other "
                        f"in the same sample; allowed: export {source} as well"
                    )
                if stage not in stages and (source in self.nodes or source in after):
                    after[name] = after.get(source, source)

    def dependencies(self) -> dict[str, list[str]]:
        """Return by output the inputs whose value at a sample acts on the output at the same sample, by name.

        Inputs that only arrive late act on later samples.
        """
        needed = {signal.tape: {signal.name} for signal in self.inputs if not signal.delay}
        for part in self.parts:  # none reads a later one in the same sample
            found = set[str]().union(*(needed.get(tape, set()) for tape, delay in part.reads if delay == 0))
            needed |= {self.outputs[number].tape: found for number in part.writes}
        return {signal.name: sorted(needed[signal.tape]) for signal in self.outputs}

    # ---- layout -------------------------------------------------------------------------------------

    def _append(self, size: int) -> int:
        """Append some bytes to the block, and return their offset."""
        offset = self._end
        self._end += -(-size // 64) * 64
        return offset

    def _lay_tapes(self, stages: Sequence[Stage]) -> dict[tuple[str, str], int]:
        """Lay out a tape for each signal, and return the numbers of the tapes."""
        delays: dict[tuple[str, str], list[int]] = {}
        types: dict[str, str] = {}
        for stage in stages:
            for port in stage.inputs[: stage.own_inputs]:
                topic = remapped(stage.shared, port.topic)
                types[topic] = port.type
                for name in port.fields:
                    delays.setdefault((topic, name), []).append(port.delay)
        made: dict[str, str] = {}
        for stage in stages:
            for output in stage.outputs:
                topic = remapped(stage.shared, output.topic)
                types[topic] = made[topic] = output.type
                for name in messages.sample_fields(output.type):
                    delays.setdefault((topic, name), []).append(0)
        for number, ((topic, name), found) in enumerate(delays.items()):
            kind = types[topic]
            given = 0 if topic in made or min(found) == 0 else self.block
            size = 1 if messages.sample_fields(kind)[name].itemsize == 1 else self._real
            longest = max(found) - given
            length = longest + self.block if longest else 0
            self.tapes.append(Tape(self._append((2 * length or self.block) * size), size, length))
            signal = Signal(topic, name, units(kind).get(name, ""), size, number, *_range(kind, name), given)
            (self.outputs if topic in made else self.inputs).append(signal)
        return {key: number for number, key in enumerate(delays)}

    def _add(self, stage: Stage, numbers: dict[tuple[str, str], int]) -> None:
        step = stage.native()
        given = {signal.tape: signal.delay for signal in self.inputs}
        reads = [(-1, 0)] * (step.table.size - 1)
        places = iter(step.table.places)
        for port in stage.inputs[: stage.own_inputs]:
            for name in port.fields:
                tape = numbers[remapped(stage.shared, port.topic), name]
                reads[next(places) - 1] = tape, port.delay - given.get(tape, 0)
        writes = [
            numbers[remapped(stage.shared, output.topic), name]
            for output in stage.outputs
            for name in messages.sample_fields(output.type)
        ]
        for tape in writes:
            reads[next(places) - 1] = tape, 0
        tuned = self._tuned(stage)
        symbol = f"{self.name}_{len(self.parts)}_{stage.kind}"
        code, arrays, memory = printed(stage, symbol, tuned, self._real, self.block)
        state = self._append(memory.size)
        for stream in stage.streams:
            if stream.drawn.values.size:
                values, used = (state + memory.offset(part) for part in stream.drawn)
                self.streams.append(Stream(self._append(8 * 5), values, used, _seed(stream)))
        for name in tuned:
            self.parameters.append(self._parameter(stage, name, [state + place for place in memory.offsets(name)]))
        outputs = [signal.tape for signal in self.outputs]
        written = [outputs.index(tape) for tape in writes]
        self.parts.append(LibraryStage(stage, symbol, code, arrays, state, 0, 0, reads, written))

    # ---- parameters ---------------------------------------------------------------------------------

    def _tuned(self, stage: Stage) -> dict[str, list[Place]]:
        """Return the numbers in the memory that each parameter is stored as, and note the parameters without any."""
        paths = {address(part): path for path, part in leaves(stage.memory) if isinstance(part, np.ndarray)}
        found: dict[str, list[Place]]
        found = {name: [(paths[address(array)], index)] for name, (array, index) in stage.handles.items()}
        asked = [name.partition(".")[2] for name in self.tune if name.partition(".")[0] == stage.name]
        rows = type(stage.shared).rows()
        numbers = [name for name, row in rows.items() if row.type is float and not row.is_list]
        for name in dict.fromkeys((*stage.tunable, *asked, *(numbers if stage.name in self.tune else ()))):
            if name in numbers and (places := _places(stage, name)):
                found[name] = places
            elif (members := _members(stage, name) if name in numbers else []) or name in stage.tunable:
                self.fixed[f"{stage.name}.{name}"] = members
        return found

    def _parameter(self, stage: Stage, name: str, places: Sequence[int]) -> Parameter:
        part, named = len(self.parts), f"{stage.name}.{name}"
        if name in stage.handles:
            array, index = stage.handles[name]
            doc, start = "1: it learns; 0: it does not", float(array.flat[index])
            return Parameter(part, named, "", doc, 0.0, 1.0, "0 or 1", whole=True, value=start, places=places)
        row, value = type(stage.shared).rows()[name], getattr(stage.shared, name)
        low, high = (self._bound(stage, name, value, end) for end in _ends(row))
        limits = f"from {low:.6g} up to {high:.6g}"
        return Parameter(part, named, row.unit, row.doc, low, high, limits, whole=False, value=value, places=places)

    def _bound(self, stage: Stage, name: str, value: float, end: float) -> float:
        """Return the value of a parameter farthest towards ``end`` that the checks of the cell accept.

        All other parameters are as they are; up to the value returned, none is refused.
        """
        if self._is_accepted(stage, name, end):
            return end
        good, bad = value, end
        for _ in range(_HALVINGS):
            if abs(bad - good) <= _CLOSE * abs(good):
                break
            middle = np.copysign(np.sqrt(abs(good)) * np.sqrt(abs(bad)), good) if good * bad > 0.0 else (good + bad) / 2
            good, bad = (middle, bad) if self._is_accepted(stage, name, float(middle)) else (good, middle)
        return float(good)

    def _is_accepted(self, stage: Stage, name: str, value: float) -> bool:
        """Return whether the engine would accept the event ``set`` with this value."""
        cell = copy(self.cell)  # the checks write their results into it
        cell.warnings, cell.unchecked, cell.factors, cell.loops = [], [], {}, {}
        table = stage.shared.model_copy(update={"events": [], "faults": []})
        try:
            with explain_overflow({stage.name: table}), np.errstate(all="ignore"):
                type(stage)(stage.name, table.changed(stage.name, {name: value})).check_cell(cell, cures=False)
        except (LatheError, ArithmeticError):
            return False
        return True


def _ends(row: ParameterRow) -> tuple[float, float]:
    """Return the smallest and largest value in the range of a parameter."""
    low = nextafter(row.low, inf) if "above" in row.limits else max(row.low, -_HUGE)
    return low, nextafter(row.high, -inf) if "below" in row.limits else min(row.high, _HUGE)


def _range(msgtype: str, name: str) -> tuple[float, float]:
    """Return the smallest and largest value of a signal, far beyond those of any machine.

    The bounds keep a wrong number, such as one in another unit, from poisoning a memory or reaching a drive.
    """
    if messages.sample_fields(msgtype)[name].itemsize == 1:
        return 0.0, _FLAGS[name]
    tip = msgtype in (messages.COMMAND, messages.TOOL) and name != "height"
    bound = _STROKE if tip else max(_BOUNDS[unit] for unit in (units(msgtype).get(name) or "1").split(" or "))
    return -bound, bound


def _changes(stage: Stage, name: str) -> Iterator[tuple[float, Stage]]:
    """Yield other values of a parameter, each with the stage that has it."""
    value = getattr(stage.shared, name)
    for other in (value * 0.75, value * 1.25, value + 0.125, 0.375):
        try:
            changed = type(stage)(stage.name, stage.shared.changed(stage.name, {name: other}))
        except LatheError:
            continue
        if other != value:
            yield other, changed


def _places(stage: Stage, name: str) -> list[Place]:
    """Return the numbers in a stage's memory that a parameter is stored as, as it is; empty if it acts elsewhere."""
    found = list[list[Place]]()
    for other, changed in _changes(stage, name):
        places = _differences(stage.memory, changed.memory, other)
        if places is None:
            return []
        found.append(places)
    return found[0] if len(found) > 1 and all(each == found[0] for each in found) else []


def _members(stage: Stage, name: str) -> list[str]:
    """Return the members of a stage's memory that depend on a parameter."""
    known, found = dict(leaves(stage.memory)), dict[str, None]()
    for _, changed in _changes(stage, name):
        new = dict(leaves(changed.memory))
        same = {path for path in new if path in known and np.array_equal(known[path], new[path], equal_nan=True)}
        found |= dict.fromkeys(".".join(path) for path in known if path not in same)
    return list(found)


def _differences(memory: tuple[Any, ...], changed: tuple[Any, ...], value: float) -> list[Place] | None:
    """Return the numbers that differ between two memories; None if the changed one is not always the given value."""
    places, known, new = list[Place](), dict(leaves(memory)), dict(leaves(changed))
    if known.keys() != new.keys():
        return None
    for path, part in known.items():
        one, other = np.asarray(part), np.asarray(new[path])
        if one.shape != other.shape:
            return None
        differs = np.flatnonzero((one != other) & ~(np.isnan(one) & np.isnan(other)))
        if differs.size and not (one.dtype == float and one.flags.writeable and np.all(other.flat[differs] == value)):
            return None
        places += [(path, place if one.ndim else None) for place in differs.tolist()]
    return places


def _seed(stream: NormalStream) -> list[int]:
    state: Any = stream.generator.bit_generator.state
    return [state["state"][part] >> shift & (2**64 - 1) for part in ("state", "inc") for shift in (0, 64)]
