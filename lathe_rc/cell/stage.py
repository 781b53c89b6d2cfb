# SPDX-License-Identifier: Apache-2.0
"""Stages: computation of output block k from input block k.

A stage's output depends on its parameters, its state and its declared inputs alone; the length of the blocks
does not change the results. Hosts (the offline engine, a ROS node) feed it in order, without knowledge of its function.

Most stages compute by a step, which a program of many stages can call if it is compiled (`lathe_rc.cell.program`):

    reached, reason = step(memory, first, start, inputs, flags, outputs)

It computes the block that begins at sample ``first``, from its sample ``start`` to the end of the block
(`DONE`), or until Python code is needed (any other reason, see `Stage.serve`), and is called again from there.
Inputs are the arrays of float64 of all fields of all input ports in their order, flags the arrays of uint8, or an empty
one if there are none, and outputs are the arrays of all fields of all output ports.
"""

from abc import ABC
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from lathe_rc import messages
from lathe_rc.blocks.ports import CLOCK, Input, Joint, Output, Sparse
from lathe_rc.cell import events, ros_yaml
from lathe_rc.cell.events import Trigger
from lathe_rc.cell.parameters import NodeParameters, Values, about, remapped
from lathe_rc.compiled.step import CompiledStep, Step, is_compiled
from lathe_rc.compiled.struct_view import explain_unfit
from lathe_rc.errors import InputError, LatheError
from lathe_rc.extensions import is_ours
from lathe_rc.messages import Samples, Signals
from lathe_rc.names import instead
from lathe_rc.signals.noise import NormalStream, Sensor

if TYPE_CHECKING:
    from lathe_rc.safety.faults import Fault
    from lathe_rc.safety.injection import Injection

Fields = tuple[Samples, ...]  #: arrays of a step, each of shape (n,)
Reached = tuple[int, int]  #: sample of the block that a step has reached, and why it has stopped
DONE, PYTHON = 0, -1  #: why a step, or a program of steps, has stopped
NEVER = np.iinfo(np.int64).max  #: no sample at all

_AROUND = ("prepare", "process", "compute", "advance")  # methods with which a stage changes samples beside its step
_NOTHING = np.empty(0)
_NO_FLAGS = np.empty(0, np.uint8)  # flags of a step without any, so that the call is the same


class WiredCell(Protocol):
    """Interface of a wired cell as seen by the checks of a stage (see `lathe_rc.cell.wiring.Cell`)."""

    stages: dict[str, "Stage"]
    unknown: Mapping[str, Any]
    warnings: list[str]
    unchecked: list[str]
    factors: dict[str, float]
    loops: dict[str, list[Any]]

    @property
    def master(self) -> Any:
        """Time master of the cell (see `lathe_rc.cell.time_master.TimeMaster`)."""

    @property
    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest spindle speed in the run [rad/s]."""

    def node_of(self, topic: str) -> str | None:
        """Return the name of the member that publishes a block topic; None if there is no such member."""

    def publisher(self, topic: str, question: str) -> "Stage | None":
        """Return the stage that publishes a topic; None for an unknown member, which leaves the question open."""

    def reader_names(self, topic: str) -> set[str]:
        """Return the names of the members that read a topic."""

    def leave_open(self, question: str, name: str) -> None:
        """Record a question that depends on the parameters of an unknown member."""


class Stage(ABC):
    """Base class of all stages.

    Args:
        name: node name without namespace.
        parameters: parameter table of the node.

    Attributes:
        inputs, outputs: the ports, in the order of the arrays passed to `advance`.
        sparse_topics: relative name and type of every topic that carries `Sparse` messages.
        parameters: parameter table, with the values of the ``set`` events so far.
        shared: parameter table at the start.
        unheard: sparse topics without a reader; their messages need not be created.
        foreign: type of each topic that the node receives from outside the cell, by name before remapping.
        tells: whether the stage generates events by itself, known only to `process`.
        own_inputs: number of inputs of `process`; one more may provide the spindle angle for the events.
        step: step function, compiled or in Python; None if the stage overrides `process`.

    Example:
        >>> import numpy as np
        >>> from lathe_rc import DONE, Input, NodeParameters, Output, Stage, messages, parameter
        >>> class HalfParameters(NodeParameters):
        ...     share: float = parameter(0.5, "of the command")
        >>> def step(memory, first, start, inputs, flags, outputs):
        ...     outputs[0][start:] = memory * inputs[0][start:]
        ...     return inputs[0].size, DONE
        >>> class Half(Stage):
        ...     Parameters = HalfParameters
        ...     step = staticmethod(step)
        ...
        ...     def __init__(self, name, parameters):
        ...         super().__init__(name, parameters)
        ...         self.declare(
        ...             inputs=[Input("coarse/command", messages.COMMAND, ("position",))],
        ...             outputs=[Output("coarse/half", messages.COMMAND)],
        ...         )
        ...
        ...     @property
        ...     def memory(self):
        ...         return self.parameters.share
        >>> half, out = Half("half", HalfParameters()), {"position": np.empty(2)}
        >>> half.advance(0, [{"position": np.array([1.0, 2.0])}], [out])
        []
        >>> out["position"].tolist()
        [0.5, 1.0]
    """

    kind: ClassVar[str]
    Parameters: ClassVar[type[NodeParameters]]
    parameters: NodeParameters
    actions: ClassVar[tuple[str, ...]] = ()  #: events that it knows
    tunable: tuple[str, ...] = ()  #: parameters that the event ``set PARAM VALUE`` may change, all float
    announces: ClassVar[tuple[str, ...]] = ()  #: events that come about by themselves; up to a colon
    relayed: str = ""  #: topic, before remapping, of the motion that it passes on as its own; empty: none
    devices: ClassVar[tuple[str, ...]] = ()  #: what can break beside its ports; see `lathe_rc.safety.faults.Kind`

    inputs: tuple[Input, ...] = ()
    outputs: tuple[Output, ...] = ()
    step: ClassVar[Step | None] = None
    learns: ClassVar[bool] = False  #: whether a run tells its stability margin
    goes_on: ClassVar[Collection[int]] = ()  #: stop reasons after which the step needs no answer
    stops: ClassVar[Mapping[int, str]] = {}  #: all other stop reasons: name, colon, explanation
    rooms: ClassVar[int] = 0  #: arrays of a block that the step needs for itself
    _sensors: Sequence[Sensor] = ()  # sensors whose noise the step needs

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        # Messages name a third-party stage by its class.
        if not hasattr(cls, "kind") and not is_ours(cls.__module__):
            cls.kind = cls.__name__
        if "process" in vars(cls) and "step" not in vars(cls):
            cls.step = None  # an inherited step computes something else
        if cls.tunable and cls.tune is Stage.tune:
            raise TypeError(f"{cls.__name__}.tunable = {cls.tunable!r} without a method tune(self, parameters)")

    def __init__(self, name: str, parameters: NodeParameters) -> None:
        self.name = name
        self.shared = self.parameters = parameters
        self.sparse_topics: dict[str, str] = {}
        self.unheard: Collection[str] = ()
        self.foreign: dict[str, str] = {}
        self._triggers = events.triggers(name, parameters)
        self._injection: Injection | None = None
        self.own_inputs, self.tells = 0, False
        self._native: CompiledStep | None = None
        self._room: Samples | None = None
        self._remarks: list[str] = []  # events caused by the current event

    def warnings(self, seconds: float) -> list[str]:
        """Return the warnings about the parameters, one line each, for a run of ``seconds``; inf for an endless run."""
        return []

    def check_cell(self, cell: WiredCell, *, cures: bool = True) -> None:
        """Check the stage in its wired cell before the start; overriding methods call this one.

        Args:
            cell: wired cell; its ``warnings``, ``unchecked``, ``factors`` and ``loops`` receive the results.
            cures: see `lathe_rc.cell.wiring.Cell.check`.

        Raises:
            InputError: a block is longer than a feedback delay.
        """
        for port in self.inputs:
            if 0 < port.delay < self.shared.block_size:
                raise InputError(
                    f"{self.name}: feedback of {port.topic} is delayed by {port.delay} samples, block_size = "
                    f"{self.shared.block_size}; allowed: block_size up to the delay"
                )

    def causes_off(self, cell: WiredCell) -> dict[str, Values | str]:
        """Return the values of the stage that switch causes of a form error off, which depend on the wired cell.

        Returns:
            By cause, the values, or the reason for which nothing switches it off.
        """
        return {}

    def declare(self, *, inputs: Sequence[Input] = (), outputs: Sequence[Output] = (), tells: bool = False) -> None:
        """Set the ports; call once, at the end of the constructor.

        Args:
            inputs: input ports in the order of the arguments of `process`.
            outputs: output ports in the same order.
            tells: whether the stage generates events by itself, even if none can be requested.

        Raises:
            InputError: an event or fault is invalid.
        """
        self.inputs, self.outputs, self.own_inputs = tuple(inputs), tuple(outputs), len(inputs)
        # An event by revolutions needs the angle, even where the step does not: an additional input outside the step.
        if inputs and self.angle_input is None and any(trigger.kind == "revolution" for trigger in self._triggers):
            self.inputs += (CLOCK,)
        self._joints = [(place, output.joint) for place, output in enumerate(self.outputs) if output.joint]
        if self._joints:
            self.sparse_topics[f"{self.name}/joint_states"] = messages.JOINTS
        self.tells = tells
        if self.takes_events or tells:
            self.sparse_topics[f"{self.name}/events"] = messages.EVENT
        if self.shared.allow_faults:
            from lathe_rc.safety.injection import Injection, Port

            self._injection = Injection(
                self.name,
                [Port(remapped(self.shared, p.topic), p.type, p.fields, p.delay, out=False) for p in inputs],
                [
                    Port(remapped(self.shared, p.topic), p.type, tuple(messages.sample_fields(p.type)), 0, out=True)
                    for p in outputs
                ],
                devices=self.devices,
                seed=self.shared.seed,
                step=self.shared.step,
            )
        for trigger in self._triggers:
            with about(self.name, trigger.parameter):
                self.check_action(trigger.action)

    @property
    def topics(self) -> list[str]:
        """Return the topics of all ports, before remapping."""
        return [*(port.topic for port in self.inputs), *(port.topic for port in self.outputs), *self.sparse_topics]

    @property
    def takes_events(self) -> bool:
        """Return whether the stage can receive events."""
        return bool(self.actions or self.tunable) or self.shared.allow_faults

    @property
    def fault_targets(self) -> dict[str, list[str]]:
        """Return what may be faulty, by kind of fault; empty unless faults are allowed."""
        if self._injection is None:
            return {}
        return self._injection.targets_by_kind()

    def check_action(self, action: str) -> None:
        """Check that an event can be carried out.

        Raises:
            InputError: the event is unknown to the stage, or a prerequisite is missing.
        """
        asked = events.parse(action)
        if asked.verb in (events.FAULT, events.REPAIR):
            if self._injection is None:
                raise InputError(
                    f"{self.name}: {action!r} is refused; set allow_faults = true under /** to let things break"
                )
            if asked.verb == events.FAULT or asked.values:
                self._injection.check(self._injection.parse(asked.fault, asked.verb))
            else:
                self._injection.check_target(asked.target)
            return
        if asked.verb == events.SET:
            if asked.target not in self.tunable:
                known = instead(asked.target, self.tunable)
                raise InputError(f"{self.name}: event {action!r}: no PARAM of 'set PARAM VALUE'; {known}")
            self.tuned(action)
            return
        if action not in self.actions:
            known = instead(action, self.actions) if self.actions else f"allowed: none ({self.kind} has no events)"
            raise InputError(f"{self.name}: event {action!r}; {known}")

    def tuned(self, *actions: str) -> "Stage":
        """Return a new stage of this kind, with the parameters after all waiting ``set`` events and further ones.

        Raises:
            InputError: a value is invalid.
        """
        ordered = sorted(self._triggers, key=lambda trigger: trigger.value if trigger.kind == "sample" else -1.0)
        return self._after([*(trigger.action for trigger in ordered), *actions])

    def variants(self) -> Iterator["Stage"]:
        """Yield the stage as it is after each ``set`` event of its scenario, in their order, for checks."""
        done: list[str] = []
        for trigger in self._triggers:
            done.append(trigger.action)
            if events.parse(trigger.action).verb == events.SET:
                yield self._after(done)

    def _after(self, actions: Sequence[str]) -> "Stage":
        """Return a new stage of this kind without events, with the parameters after some actions."""
        table = self._table_after(actions).model_copy(update={"events": [], "faults": []})
        return type(self)(self.name, table)

    def _table_after(self, actions: Sequence[str]) -> NodeParameters:
        """Return the parameters after all ``set`` events among some actions."""
        table = self.parameters
        for verb, parameter, value in map(events.parse, actions):
            if verb == events.SET:
                table = table.changed(self.name, {parameter: ros_yaml.parse_value(value, f"{self.name}.{parameter}")})
        return table

    def schedule(self, action: str, at: float, kind: str = "sample") -> None:
        """Schedule an event.

        Args:
            action: what to do.
            at: sample, which the host has not issued yet, or number of turns of the measured spindle angle.
            kind: ``sample`` or ``revolution``.

        Raises:
            InputError: the stage cannot carry it out.
        """
        self.check_action(action)
        self._triggers.append(Trigger(kind, at, action, "events"))

    def replay(self, action: str, index: int) -> None:
        """Schedule a recorded event at its original sample; events that the stage generates itself are skipped."""
        if events.parse(action).verb not in (*self.announces, events.NOTHING_TO_REPAIR):
            self.schedule(action, index)

    @property
    def waiting(self) -> list[str]:
        """Return the events that have not taken effect yet, excluding the ends of faults."""
        return [trigger.text for trigger in self._triggers if not trigger.ends]

    def lose(self, index: int) -> None:
        """Schedule the transition to the safe state at sample ``index``, not issued yet, after a loss of members."""
        self._triggers.append(Trigger("sample", index, events.SAFE, ""))

    def _scheduled_actions(self, action: str) -> bool:
        """Return whether the scenario lists an event with this action."""
        return any(trigger.action == action for trigger in self._triggers)

    @property
    def angle_input(self) -> int | None:
        """Return the index of the input with the measured spindle angle, if the stage reads it."""
        for place, port in enumerate(self.inputs):
            if port.type == messages.ENCODER and port.delay == 0 and "angle" in port.fields:
                return place
        return None

    @property
    def due(self) -> tuple[int, float]:
        """Return the sample and spindle angle [rad] from which a block needs `compute` instead of the step alone."""
        if self._injection and self._injection.any:
            return 0, 0.0
        if not self._triggers:
            return NEVER, np.inf
        samples = [
            trigger.sample(self.shared.sample_rate) for trigger in self._triggers if trigger.kind != "revolution"
        ]
        turns = [trigger.value * 2 * np.pi for trigger in self._triggers if trigger.kind == "revolution"]
        return min(samples, default=NEVER), min(turns, default=np.inf)

    def _due(self, first: int, samples: int, inputs: Sequence[Signals]) -> list[tuple[int, str]]:
        """Remove and return the events that fall into a block, ordered by sample, then by scheduling."""
        due, waiting = [], []
        for trigger in self._triggers:
            if trigger.kind != "revolution":
                index = trigger.sample(self.shared.sample_rate)
            else:
                place = self.angle_input
                assert place is not None, "declare() refuses revolutions without an angle"
                index = first + int(np.searchsorted(inputs[place]["angle"], trigger.value * 2 * np.pi))
            if index < first + samples:
                due.append((max(index, first), trigger.action))
            else:
                waiting.append(trigger)
        self._triggers = waiting
        return sorted(due, key=lambda event: event[0])

    def advance(
        self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals], *, last: bool = False
    ) -> list[Sparse]:
        """Compute one block of samples.

        Args:
            first: index of the first sample.
            inputs: arrays of shape (n,) by field, in the order of the ports.
            outputs: output arrays in the same layout, to be filled.
            last: whether the run ends with this block.

        Returns:
            The sparse messages of the block, by sample index.

        Raises:
            LatheError: the stage cannot continue; the message names it.
        """
        with self.named():
            sparse = self.compute(first, inputs, outputs)
        end = first + next(iter(outputs[0].values())).size
        return self.conclude(first, end, sparse, outputs, last=last)

    def named(self) -> AbstractContextManager[None]:
        """Return a context manager that adds the node name to errors."""
        return _Named(self.name)

    def compute(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """Compute a block with its events and faults (see `advance`)."""
        if self._triggers or (self._injection and self._injection.any):
            return self._compute_with_events(first, inputs, outputs)
        own = inputs if len(inputs) == self.own_inputs else inputs[: self.own_inputs]
        return self.process(first, own, outputs)

    def conclude(
        self, first: int, end: int, sparse: list[Sparse], outputs: Sequence[Signals], *, last: bool = False
    ) -> list[Sparse]:
        """Return the sparse messages of samples ``first`` to ``end`` (exclusive), ordered by sample.

        Args:
            first: index of the first sample.
            end: index after the last sample.
            sparse: messages returned by `compute`.
            outputs: output arrays of these samples; not needed by a stage without readers of its joint states.
            last: whether the run ends with these samples.
        """
        if last:
            # Not in place: the list is the caller's.
            sparse = sparse + self.finish(end - 1)
        if self.tells_joints:
            for place, joint in self._joints:
                sparse = sparse + self._joint_states(first, joint, outputs[place])
        if len(sparse) > 1:
            sparse.sort(key=lambda message: message.index)
        return sparse

    def _compute_with_events(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """Compute a block in segments between events."""
        samples = next(iter(outputs[0].values())).size
        sparse: list[Sparse] = []
        start = 0
        for index, action in self._due(first, samples, inputs):
            sparse += self._piece(first, start, index - first, inputs, outputs)
            start = index - first
            self.act(action, index)
            if (topic := f"{self.name}/events") in self.sparse_topics:
                said = [action, *self._remarks]
                sparse += [Sparse(topic, messages.EVENT, index, {"action": text}) for text in said]
            self._remarks.clear()
        return sparse + self._piece(first, start, samples, inputs, outputs)

    def _piece(
        self, first: int, start: int, stop: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        if start == stop:
            return []
        first, read, written = first + start, cut(inputs[: self.own_inputs], start, stop), cut(outputs, start, stop)
        if self._injection is None:
            return self.process(first, read, written)
        # Faults of inputs act on copies: other stages read the same arrays.
        sparse = self.process(first, self._injection.inputs(first, read), written)
        self._injection.outputs(first, written)
        return sparse

    def act(self, action: str, index: int) -> None:
        """Carry out an event at sample ``index``, which is the next one."""
        asked = events.parse(action)
        if asked.verb == events.SAFE:
            self.go_safe()
        elif asked.verb == events.FAULT:
            assert self._injection is not None, "the fault has been checked"
            fault = self._injection.parse(asked.fault)
            if self._injection.is_of_device(fault):
                self.damage(fault)
            else:
                self._injection.begin(fault, index)
        elif asked.verb == events.SET:
            self.parameters = self._table_after([action])
            self.tune(self.parameters)
        elif asked.verb == events.REPAIR:
            assert self._injection is not None, "the event has been checked"
            one = self._injection.parse(asked.fault) if asked.values else None
            is_device = asked.target in self.devices
            mended = self.mend(one) if is_device else self._injection.end(asked.target, index, one)
            if not mended:
                self._remarks.append(f"{events.NOTHING_TO_REPAIR}: {asked.target}")
        else:
            self.perform(action)

    def tune(self, parameters: Any) -> None:
        """Continue with changed ``tunable`` parameters from the next sample on; stages with such override this.

        Args:
            parameters: the whole table with the new values.
        """
        raise NotImplementedError(parameters)

    def go_safe(self) -> None:  # noqa: B027 - most stages move nothing, and go on as they are
        """Go to the safe state after a loss of cell members."""

    def damage(self, fault: "Fault") -> None:
        """Apply a fault to one of the ``devices`` of the stage.

        Stages with ``devices`` override this; other faults are rejected earlier by `check_action`.
        """
        raise NotImplementedError(fault.text)

    def mend(self, fault: "Fault | None") -> bool:
        """End a fault, or all faults; return whether there was one. Stages with ``devices`` override this."""
        raise NotImplementedError(fault)

    @property
    def tells_joints(self) -> bool:
        """Return whether the stage publishes joint states that have a reader."""
        return bool(self._joints) and f"{self.name}/joint_states" not in self.unheard

    def _joint_states(self, first: int, joint: Joint, signals: Signals) -> list[Sparse]:
        period = self.shared.joint_state_period
        samples = signals[joint.position].size
        start = -first % period
        if start >= samples:
            return []
        # Copies: the block's own arrays are reused.
        given = {what: signals[name][start::period].copy() for what, name in joint._asdict().items() if name}
        topic, found = f"{self.name}/joint_states", []
        for k in range(given["position"].size):
            told = {what: given[what][k : k + 1] if what in given else _NOTHING for what in joint._fields}
            index = first + start + k * period
            found.append(Sparse(topic, messages.JOINTS, index, {"name": [self.name], **told}))
        return found

    def perform(self, action: str) -> None:
        """Carry out an event, effective from the next sample.

        Stages with ``actions`` override this; other events are rejected earlier by `check_action`.
        """
        raise NotImplementedError(action)

    def finish(self, index: int) -> list[Sparse]:
        """Return the remaining events of a run that ends with sample ``index``."""
        return []

    # ---- the compiled step ----------------------------------------------------------------------------

    @property
    def memory(self) -> tuple[Any, ...]:
        """Memory of the step: a NamedTuple of arrays and constants, which may be replaced after each stop."""
        return ()

    @property
    def is_compiled(self) -> bool:
        """Return whether a program can call the step."""
        return is_compiled(self.step)

    def _advance(self, first: int, start: int, fields: Sequence[Any], samples: int) -> Reached:
        """Call the step with the arrays of all fields, each of shape (samples,)."""
        assert self.step is not None, "a stage without a step has its own `process`"
        if self.is_compiled:
            return self.native()(first, start, fields, samples)
        inputs = sum(len(port.fields) for port in self.inputs[: self.own_inputs])
        flags = tuple(field for field in fields[:inputs] if field.dtype != np.float64) or (_NO_FLAGS,)
        floats = tuple(field for field in fields[:inputs] if field.dtype == np.float64)
        return self.step(self.memory, first, start, floats, flags, tuple(fields[inputs:]))

    @property
    def field_types(self) -> tuple[list[np.dtype[Any]], list[np.dtype[Any]]]:
        """Return the element types of the step's arrays: all fields of its own inputs, and of its outputs."""
        read = [messages.sample_fields(p.type)[n] for p in self.inputs[: self.own_inputs] for n in p.fields]
        return read, [kind for port in self.outputs for kind in messages.sample_fields(port.type).values()]

    def native(self) -> CompiledStep:
        """Return the step with its current memory as a function of addresses."""
        if self._native is None:
            assert self.step is not None, "a stage without a step has its own `process`"
            # Numba's own error for an invalid memory does not help the author of a stage.
            if not is_ours(type(self).__module__) and (why := explain_unfit(self.memory)):
                raise InputError(f"{self.name}: memory of a compiled step: {why}")
            self._native = CompiledStep(self.step, self.memory, *self.field_types)
        else:
            # The same words at the same address: a program keeps using the address.
            self._native.update(self.memory)
        return self._native

    @property
    def room(self) -> Samples:
        """Scratch memory of the step, shape (rooms, MAX_BLOCK), allocated once because allocation is slow."""
        if self._room is None:
            self._room = np.zeros((self.rooms, messages.MAX_BLOCK))
        return self._room

    @property
    def of_block(self) -> list[Samples]:
        """Return the arrays of the memory that hold values of the current block alone.

        Their rows have `MAX_BLOCK` elements or a few more; a host with shorter blocks may shorten them.
        """
        return [self.room, *(stream.drawn.values for stream in self.streams)]

    def take_room(self, other: "Stage") -> None:
        """Take over the scratch memory of a stage that no longer runs, if it is of the same size."""
        if other.rooms == self.rooms:
            self._room = other.room

    def forget(self) -> None:  # noqa: B027 - most stages keep no such results
        """Forget results that depend on parameters other than those now given, after a start from a checkpoint."""

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes that are state, without addresses and scratch arrays."""
        return {**self.__dict__, "_native": None, "_room": None}

    @property
    def streams(self) -> list[NormalStream]:
        """Return the random streams whose numbers the step uses."""
        return [sensor.stream for sensor in self._sensors]

    @property
    def needs_python(self) -> str:
        """Return why the outputs are not those of the compiled step alone, with what is allowed instead; empty if so.

        A stage whose Python code changes outputs between two calls of the step declares it here.
        """
        if not self.is_compiled:
            return f"{self.kind} has no compiled step; allowed: a step or sample with @kernel"
        own = [name for name in _AROUND if getattr(type(self), name) is not getattr(Stage, name)]
        return f"{self.kind} computes {', '.join(own)} in Python; allowed: a step alone" if own else ""

    @property
    def handles(self) -> Mapping[str, tuple[np.ndarray, int]]:
        """Return the flags in the memory, by name: array and flat index, that alone make the events of that name.

        A host without Python may change them. An event that changes more is none of theirs.
        """
        return {}

    def prepare(self, first: int, samples: int) -> None:
        """Draw the random numbers of the samples from ``first`` in advance, as the step cannot draw them."""
        for stream in self.streams:
            stream.draw(samples)

    def serve(
        self, reason: int, first: int, reached: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        """Handle the reason for which the step has stopped at sample ``reached`` of the block.

        The step continues from there. Stages whose steps stop override this.

        Raises:
            LatheError: the stage cannot continue.
        """
        raise NotImplementedError(reason)

    def tell(self, first: int, end: int) -> list[Sparse]:
        """Return the messages for samples ``first`` to ``end`` (exclusive), which the step has computed last."""
        return []

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """Compute the samples from ``first`` by the step, without events and faults (see `advance`)."""
        samples = next(iter(outputs[0].values())).size
        # Limit of the tables of noise and clipped samples, and of the scratch memory of a step.
        if samples > messages.MAX_BLOCK:
            pieces = [(k, min(k + messages.MAX_BLOCK, samples)) for k in range(0, samples, messages.MAX_BLOCK)]
            return [said for k, m in pieces for said in self.process(first + k, cut(inputs, k, m), cut(outputs, k, m))]
        # Not strict: an input for events alone is not passed on.
        fields = [part[name] for port, part in zip(self.inputs, inputs, strict=False) for name in port.fields]
        fields += [array for part in outputs for array in part.values()]
        self.prepare(first, samples)
        sparse: list[Sparse] = []
        told = reached = 0
        while True:
            reached, reason = self._advance(first, reached, fields, samples)
            if reason == DONE:
                return sparse + self.tell(first + told, first + samples)
            sparse += self.tell(first + told, first + reached)
            told = reached
            sparse += self.serve(reason, first, reached, inputs, outputs)


class _Named(AbstractContextManager[None]):
    """Context manager that adds the node name to errors; 3 times as fast as a generator, used 70 times per run."""

    def __init__(self, node: str) -> None:
        self._node = node

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, LatheError) and not str(error).startswith((f"{self._node}.", f"{self._node}: ")):
            error.args = (f"{self._node}: {error}",)


def cut(signals: Sequence[Signals], start: int, stop: int) -> list[Signals]:
    """Return views of samples ``start`` to ``stop`` (exclusive) of a block."""
    return [{name: samples[start:stop] for name, samples in part.items()} for part in signals]


def compile_kernels(stage: Stage) -> None:
    """Compile the kernels of a stage in advance, so that the first block takes no longer than the next."""
    if stage.shared.allow_faults:
        from lathe_rc.safety.faults import prepare

        prepare()
    if stage.is_compiled:
        assert stage.native().address, "that compiles it"
        return
    inputs = [
        {name: np.empty(0, messages.sample_fields(port.type)[name]) for name in port.fields}
        for port in stage.inputs[: stage.own_inputs]
    ]
    stage.process(0, inputs, [messages.allocate(port.type, 0) for port in stage.outputs])
