# SPDX-License-Identifier: Apache-2.0
"""Supervisor of the cell: monitors, and requested reactions, which nodes read as feedback with a declared delay."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Le

from lathe_machine.safety import next_step
from lathe_machine.safety.monitors import (
    Alarm,
    Clearance,
    Lookout,
    Monitor,
    Place,
    Plain,
    PlainMonitor,
    Rule,
    Watcher,
    below,
    growth,
    index_pulses,
    rate,
    threshold,
)
from lathe_machine.safety.rules import MonitorTable, clear, walk
from lathe_machine.stages.drive.drive import Drive
from lathe_machine.stages.learning.learner import Learner
from lathe_rc import messages
from lathe_rc.arrays import Integers
from lathe_rc.blocks.ports import Input, Output, Sparse
from lathe_rc.cell.parameters import NodeParameters, NonNegative, parameter, remapped
from lathe_rc.cell.stage import DONE, Fields, Reached, Stage, WiredCell, cut
from lathe_rc.errors import InputError
from lathe_rc.extensions import Named, Registry, code_of_others
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples, Signals
from lathe_rc.safety import state_machine
from lathe_rc.safety.state_machine import RESET, RETRACTED, Reaction, State

Asked = Literal["warn", "freeze", "fall_back", "hold", "retract", "stop"]

#: third-party monitors, by name; built-in monitors have thresholds of their own
MONITORS: Registry[PlainMonitor] = Registry("monitor", PlainMonitor, {}, "lathe_rc.monitors")


class SupervisorParameters(NodeParameters):
    """Thresholds of the monitors (0 disables a monitor), and the reactions requested when a threshold is violated."""

    drives: list[str] = parameter(
        [], "drives of the tool that are watched, by the names of their topics; the first takes the tool out"
    )
    slides: list[Literal["cross", "longitudinal"]] = parameter([], "slides that are watched")

    speed_limit: NonNegative = parameter(0.0, "encoder: measured speed, deviation from the nominal", "rad/s")
    speed_reaction: Asked = parameter("stop", "what is asked for then")
    acceleration_limit: NonNegative = parameter(0.0, "encoder: change of the measured speed", "rad/s^2")
    acceleration_window: Annotated[int, Ge(1), Le(65536)] = parameter(640, "over so many samples", "sample")
    acceleration_reaction: Asked = parameter("stop", "what is asked for then")
    index_limit: Annotated[float, Ge(0), Le(3)] = parameter(
        0.0, "encoder: measured angle from index pulse to index pulse, deviation from a revolution", "rad"
    )
    index_reaction: Asked = parameter("retract", "what is asked for then")
    following_limit: list[NonNegative] = parameter(
        [], "drives: command - measured position, the drive's own lag included; one for each, or none", "m"
    )
    following_time: NonNegative = parameter(1e-3, "for so long", "s")
    following_reaction: Asked = parameter("retract", "what is asked for then")
    stroke_limit: list[NonNegative] = parameter(
        [], "drives: measured position to each side; one for each, or none", "m"
    )
    stroke_reaction: Asked = parameter("retract", "what is asked for then")
    effort_limit: list[NonNegative] = parameter(
        [], "drives: current or voltage at which one is taken to be saturated; one for each, or none", "A or V"
    )
    effort_time: NonNegative = parameter(5e-3, "for so long", "s")
    effort_reaction: Asked = parameter("freeze", "what is asked for then")
    error_limit: NonNegative = parameter(0.0, "tool: measured error", "m")
    error_after: NonNegative = parameter(
        10.0, "after so many from the start or a reset: they are there to learn", "rev"
    )
    error_reaction: Asked = parameter("retract", "what is asked for then")
    growth_limit: NonNegative = parameter(0.0, "tool: RMS error of a revolution over that of the one before")
    growth_cycles: Annotated[int, Ge(1), Le(1000)] = parameter(3, "so many times in a row", "rev")
    growth_floor: NonNegative = parameter(1e-6, "RMS error that does not count", "m")
    growth_reaction: Asked = parameter("freeze", "what is asked for then")
    margin_limit: list[NonNegative] = parameter(
        [],
        "drives: smallest stability margin of the channel that commands one, which has publish_margin; one for each, "
        "or none",
    )
    margin_after: NonNegative = parameter(
        10.0, "after so many from the start or a reset: the drive has to be identified", "rev"
    )
    margin_reaction: Asked = parameter("freeze", "what is asked for then")
    force_limit: NonNegative = parameter(0.0, "cut: measured force", "N")
    force_time: NonNegative = parameter(1e-3, "for so long", "s")
    force_low: NonNegative = parameter(0.0, "cut: measured force below this is lost", "N")
    force_after: NonNegative = parameter(10.0, "after so many from the start or a reset", "rev")
    force_reaction: Asked = parameter("retract", "what is asked for beyond either")
    slide_limit: list[NonNegative] = parameter([], "slides: measured position to each side; one for each, or none", "m")
    slide_reaction: Asked = parameter("hold", "what is asked for then")
    monitors: list[Annotated[str, Named(MONITORS)]] = parameter([], "monitors of others")
    monitor_signals: list[str] = parameter(
        [], "what each of them watches, as TOPIC.FIELD, like tool.measured_error or coarse/state.effort"
    )
    monitor_others: list[str] = parameter(
        [], "a second signal for each, an empty text where there is none; empty: for none of them"
    )
    monitor_limits: list[float] = parameter([], "threshold of each, in the unit of what it finds")
    monitor_reactions: list[Asked] = parameter([], "what each of them asks for")

    clear_position: NonNegative = parameter(
        0.25e-3, "the tool is out of the part where the first drive's measured position is beyond this", "m"
    )
    clear_time: NonNegative = parameter(1e-3, "for so long", "s")

    def shown(self) -> Mapping[str, Any]:
        """Supervision, largest allowed margin of the drives, and limit of the force [N]."""
        margin = max(self.margin_limit, default=0.0)
        return {"supervised": True, "margin": margin, "force_limit": self.force_limit}


MEMBERS_LOST = "members_lost"  #: name in place of a monitor's: the host reports that members of the cell are lost
RETRACT = "retract"  #: event that takes the tool out
RESET_REFUSED = "reset refused"  #: likewise: a reset is refused during a retraction or after a stop
_SENSOR, _COMMAND, _MARGIN = ("measured_position", "effort"), ("position",), ("stability_margin",)
_STATE, _REACTION, _TOLD = range(3)  # indices into the state of the step function
_ANSWER = 1  # stop reason: the state changes within the block, or a message is due


class Memory(NamedTuple):
    """State of the supervisor's step function.

    Attributes:
        watch: table of the monitors.
        clearance: state of the `lathe_machine.safety.monitors.Clearance`.
        out: index of the signal with the position for the clearance check; negative if there is none.
        state: state of the cell, reaction in force, and whether there is something to publish.
    """

    watch: MonitorTable
    clearance: Samples
    out: int
    state: Integers


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Monitor one block; with `_ANSWER`, the step function stops at the end of the block."""
    state, reaction = outputs
    n = state.size
    if start == n:
        return n, DONE
    found = walk(memory.watch, inputs, inputs[0], flags[0])
    if found or memory.state[_TOLD]:
        return n, _ANSWER
    if memory.state[_STATE] == State.RETRACTING.value and memory.out >= 0:
        place, run = clear(inputs[memory.out], memory.clearance)
        if place >= 0:
            return n, _ANSWER
        memory.clearance[2] = run
    state[:] = memory.state[_STATE]
    reaction[:] = memory.state[_REACTION]
    return n, DONE


def _real(port: Input, field: str) -> bool:
    return messages.sample_fields(port.type)[field] == np.float64


class Supervisor(Stage):
    """Supervisor with its monitors (see `lathe_rc.safety`).

    Attributes:
        monitors: active monitors.
    """

    kind = "supervisor"
    Parameters = SupervisorParameters
    parameters: SupervisorParameters
    actions = (RESET, RETRACT)
    stops: ClassVar[Mapping[int, str]] = {_ANSWER: "alarm: a monitor raises one, or the tool has cleared the part"}
    step = staticmethod(step)

    def __init__(self, name: str, parameters: SupervisorParameters) -> None:
        super().__init__(name, parameters)
        self._inputs = [Input("encoder", messages.ENCODER, ("angle", "speed", "index_pulse"))]
        self.monitors: list[Watcher] = []
        self._state = np.array([State.NOMINAL, Reaction.NONE, 0], np.int64)
        self._told: list[str] = []  # state changes since the last sample that were not caused by monitors
        self._out = self._reads(f"{parameters.drives[0]}/state", messages.STATE, _SENSOR) if parameters.drives else None
        self._clearance = Clearance(parameters.clear_position, self._samples(parameters.clear_time))
        self._watch_spindle()
        self._watch_error()
        self._watch_drives()
        self._watch_margins()
        self._watch_cut()
        self._watch_for_others()
        fields = [(place, name) for place, port in enumerate(self._inputs) for name in port.fields if _real(port, name)]
        numbers = {field: number for number, field in enumerate(fields)}
        self._lookout = Lookout([each for each in self.monitors if isinstance(each, Monitor)], numbers)
        self._plain = [each for each in self.monitors if isinstance(each, Plain)]
        self._out_number = -1 if self._out is None else numbers[self._out, "measured_position"]
        self.declare(inputs=self._inputs, outputs=[Output("safety", messages.SAFETY)])
        self.sparse_topics["safety/status"] = messages.SAFETY_STATUS

    # ---- monitors -----------------------------------------------------------------------------------

    def _reads(self, topic: str, msgtype: str, fields: tuple[str, ...]) -> int:
        """Return the index of an input, which is added if missing."""
        for place, port in enumerate(self._inputs):
            if port.topic == topic:
                return place
        self._inputs.append(Input(topic, msgtype, fields))
        return len(self._inputs) - 1

    def _samples(self, seconds: float) -> int:
        return max(1, round(seconds * self.shared.sample_rate))

    def _each(self, name: str, of: Sequence[str]) -> list[tuple[str, float]]:
        """Return the monitored signals with their limits, from a list parameter whose zeros disable monitors."""
        limits: list[float] = getattr(self.parameters, name)
        if limits and len(limits) != len(of):
            raise InputError(f"{self.name}.{name} = {limits}; allowed: one for each of {', '.join(of) or 'none'}")
        return [(subject, limit) for subject, limit in zip(of, limits or [0.0] * len(of), strict=True) if limit]

    def _reaction(self, name: str, text: str = "") -> Reaction:
        """Return the reaction requested by a parameter or by one of its strings."""
        asked = Reaction[(text or getattr(self.parameters, name)).upper()]
        if asked >= Reaction.RETRACT and not self.parameters.drives:
            raise InputError(
                f"{self.name}.{name} = {asked.name.lower()}, but no drive is named that takes the tool out; allowed: "
                "warn, freeze, fall_back or hold, or name the drives"
            )
        return asked

    def _watch(
        self, name: str, subject: str, limit: float, rule: Rule, asked: str, signal: Place, other: Place | None = None
    ) -> None:
        """Add a monitor; ``asked`` is the first word in the name of the parameter with its reaction."""
        reaction = self._reaction(f"{asked}_reaction")
        self.monitors.append(Monitor(name, subject, limit, reaction, rule=rule, signal=signal, other=other))

    def _watch_spindle(self) -> None:
        table, nominal = self.parameters, self.parameters.nominal_speed
        if limit := table.speed_limit:
            self._watch("speed", "encoder", limit, threshold(limit, offset=nominal), "speed", (0, "speed"))
        if limit := table.acceleration_limit:
            rule = rate(limit, window=table.acceleration_window, step=table.step, before=nominal)
            self._watch("acceleration", "encoder", limit, rule, "acceleration", (0, "speed"))
        if limit := table.index_limit:
            self._watch("index_pulses", "encoder", limit, index_pulses(limit), "index", (0, "angle"))

    def _watch_error(self) -> None:
        table = self.parameters
        if not (table.error_limit or table.growth_limit):
            return
        signal = self._reads("tool", messages.TOOL, ("measured_error",)), "measured_error"
        if limit := table.error_limit:
            self._watch("error", "tool", limit, threshold(limit, after=table.error_after), "error", signal)
        if limit := table.growth_limit:
            rule = growth(limit, cycles=table.growth_cycles, floor=table.growth_floor)
            self._watch("error_growth", "tool", limit, rule, "growth", signal)

    def _watch_drives(self) -> None:
        table = self.parameters
        for drive, limit in self._each("following_limit", table.drives):
            state = self._reads(f"{drive}/state", messages.STATE, _SENSOR), "measured_position"
            command = self._reads(f"{drive}/command", messages.COMMAND, _COMMAND), "position"
            rule = threshold(limit, samples=self._samples(table.following_time))
            self._watch("following", drive, limit, rule, "following", command, state)
        for what, of, field, seconds in (
            ("stroke", table.drives, "measured_position", 0.0),
            ("effort", table.drives, "effort", table.effort_time),
            ("slide", table.slides, "measured_position", 0.0),
        ):
            for subject, limit in self._each(f"{what}_limit", of):
                signal = self._reads(f"{subject}/state", messages.STATE, _SENSOR), field
                self._watch(what, subject, limit, threshold(limit, samples=self._samples(seconds)), what, signal)

    def _watch_margins(self) -> None:
        for drive, limit in self._each("margin_limit", self.parameters.drives):
            signal = (self._reads(f"{drive}/margin", messages.MARGIN, _MARGIN), *_MARGIN)
            rule = below(limit, after=self.parameters.margin_after)
            self._watch("stability_margin", drive, limit, rule, "margin", signal)

    def _watch_cut(self) -> None:
        table = self.parameters
        if not (table.force_limit or table.force_low):
            return
        signal = self._reads("cut", messages.CUT, ("measured_force",)), "measured_force"
        samples = self._samples(table.force_time)
        if limit := table.force_limit:
            self._watch("force", "cut", limit, threshold(limit, samples=samples), "force", signal)
        if limit := table.force_low:
            self._watch(
                "force_low", "cut", limit, below(limit, samples=samples, after=table.force_after), "force", signal
            )

    def _watch_for_others(self) -> None:
        table, own = self.parameters, ("monitor_signals", "monitor_limits", "monitor_reactions")
        for name in (*own, "monitor_others") if table.monitor_others else own:
            if len(getattr(table, name)) != len(table.monitors):
                named = ", ".join(table.monitors) or "none"
                raise InputError(f"{self.name}.{name} = {getattr(table, name)}; allowed: one for each of {named}")
        others = table.monitor_others or [""] * len(table.monitors)
        for name, signal, other, limit, asked in zip(
            table.monitors, table.monitor_signals, others, table.monitor_limits, table.monitor_reactions, strict=True
        ):
            reaction = self._reaction("monitor_reactions", asked)
            places = [self._field("monitor_signals", signal)]
            places += [self._field("monitor_others", other)] if other else []
            subject, make = f"{signal}, {other}" if other else signal, partial(MONITORS[name], limit, table.step)
            with code_of_others(f"{self.name}.monitors"):
                self.monitors.append(Plain(name, subject, limit, reaction, signals=places, make=make))

    def _field(self, name: str, text: str) -> tuple[int, str]:
        """Return the input index and the field for a TOPIC.FIELD parameter, adding or extending the input if needed."""
        topic, _, field = text.rpartition(".")
        msgtype = messages.BLOCK_TOPICS.get(topic.rpartition("/")[2], "")
        known = messages.sample_fields(msgtype) if msgtype else {}
        if field not in known:
            fields = ", ".join(f"{topic}.{each}" for each in known)
            allowed = fields or f"TOPIC.FIELD with a TOPIC that ends in {', '.join(messages.BLOCK_TOPICS)}"
            raise InputError(f"{self.name}.{name}: {text!r}; allowed: {allowed}")
        place = self._reads(topic, msgtype, (field,))
        port = self._inputs[place]
        if field not in port.fields:
            self._inputs[place] = replace(port, fields=(*port.fields, field))
        return place, field

    # ---- samples ------------------------------------------------------------------------------------

    def check_action(self, action: str) -> None:
        """Check that an event is known, and that there is a tool to retract."""
        super().check_action(action)
        if action == RETRACT and not self.parameters.drives:
            raise InputError(f"{self.name}: event {action!r}, and no drives; allowed: drives that take the tool out")

    def perform(self, action: str) -> None:
        """Reset the state of the cell, where a persistent fault raises its alarm again, or retract the tool."""
        if action == RETRACT:
            self._ask_for(Reaction.RETRACT)
            self._told.append(next_step.OPERATOR)
            return
        if self.reaction is Reaction.NONE:
            return  # no alarm since the start or the last reset
        if next_step.refusal(self.state, self.reaction):
            self._told.append(RESET_REFUSED)
            return
        to = state_machine.after(self.state, action)
        assert to is not None, "it is not refused"
        self._state[:2] = to, Reaction.NONE
        self._told.append(RESET)
        self._lookout.reset()
        for monitor in self._plain:
            monitor.reset()

    def go_safe(self) -> None:
        """Raise an alarm that cannot be reset, because cell members are lost."""
        self._told.append(MEMBERS_LOST)
        self._ask_for(Reaction.STOP)

    def _ask_for(self, reaction: Reaction) -> None:
        to = state_machine.after(self.state, reaction)
        assert to is not None, "every reaction is known in every state"
        if to is State.RETRACTING and self._out is None:
            to = State.SAFE  # there is no drive to wait for
        if to is State.RETRACTING and self.state is not to:
            self._clearance.begin()
        self._state[:2] = to, max(self.reaction, reaction)

    @property
    def state(self) -> State:
        """Current state of the cell."""
        return State(self._state[_STATE])

    @property
    def reaction(self) -> Reaction:
        """Reaction in force."""
        return Reaction(self._state[_REACTION])

    @property
    def needs_python(self) -> str:
        """Return why the step needs Python: the monitors of others are no kernels."""
        return "monitors of others are computed in Python; allowed: none" if self._plain else super().needs_python

    @property
    def memory(self) -> Memory:
        """Current state of the supervisor's step function."""
        # Monitors in Python need every block, so the step function stops in each of them.
        self._state[_TOLD] = bool(self._told or self._plain)
        return Memory(self._lookout.watch, self._clearance.memory, self._out_number, self._state)

    def serve(
        self, reason: int, first: int, reached: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        """Publish the findings of the monitors and change the state of the cell."""
        (safety,) = outputs
        sparse = [self._status(first, what, "", 0.0, 0.0) for what in self._told]
        self._told.clear()
        place = 0
        for monitor, alarm in self._found(first, reached, inputs):
            self._fill(safety, inputs, first, place, alarm.place, sparse)
            place = alarm.place
            self._ask_for(monitor.reaction)
            sparse.append(self._status(first + place, monitor.name, monitor.subject, alarm.value, monitor.limit))
        self._fill(safety, inputs, first, place, reached, sparse)
        return sparse

    def _found(self, first: int, reached: int, inputs: Sequence[Signals]) -> Sequence[tuple[Watcher, Alarm]]:
        """Return the alarms in the samples up to ``reached``, in sample order."""
        found: list[tuple[Watcher, Alarm]] = [*self._lookout.found()]
        piece = cut(inputs, 0, reached) if self._plain else ()
        found += [(monitor, alarm) for monitor in self._plain if (alarm := monitor.find(first, piece)) is not None]
        return sorted(found, key=lambda one: one[1].place)

    def _fill(
        self, safety: Signals, inputs: Sequence[Signals], first: int, start: int, stop: int, sparse: list[Sparse]
    ) -> None:
        """Fill the state and reaction of samples without an alarm, and detect when the tool has cleared the part."""
        state, reaction = safety["state"][start:stop], safety["reaction"][start:stop]
        if self.state is State.RETRACTING and self._out is not None:
            place = self._clearance.first(inputs[self._out]["measured_position"][start:stop])
            if place is not None:
                state[:place].fill(self.state)
                state = state[place:]
                self._state[_STATE] = State.SAFE
                sparse.append(self._status(first + start + place, RETRACTED, self.parameters.drives[0], 0.0, 0.0))
        state.fill(self.state)
        reaction.fill(self.reaction)

    def _status(self, index: int, monitor: str, subject: str, value: float, limit: float) -> Sparse:
        values = {
            "state": int(self.state),
            "reaction": int(self.reaction),
            "monitor": monitor,
            "subject": subject,
            "value": value,
            "limit": limit,
        }
        return Sparse("safety/status", messages.SAFETY_STATUS, index, values)

    # ---- checks before a start ----------------------------------------------------------------------

    def check_cell(self, cell: WiredCell, *, cures: bool = True) -> None:
        """Check that a requested retraction would clear the part."""
        super().check_cell(cell, cures=cures)
        if self.parameters.drives:
            self._check_obedience(cell)
            self._check_retraction(cell)
            self._check_clearance(cell)

    def _check_obedience(self, cell: WiredCell) -> None:
        """Check that a node that moves the first drive obeys the supervisor."""
        asking = [
            f"monitor {each.name} asks for {each.reaction.name.lower()}"
            for each in self.monitors
            if each.reaction >= Reaction.RETRACT
        ]
        asking += [f"an event asks for {RETRACT}"] * self._scheduled_actions(RETRACT)
        drive, safety = self.parameters.drives[0], remapped(self.shared, "safety")
        movers = [cell.node_of(remapped(self.shared, f"{drive}/{what}")) for what in ("command", "state")]
        nodes = [node for node in movers if node]
        if asking and nodes and not cell.reader_names(safety) & set(nodes):
            raise InputError(
                f"{self.name}: {asking[0]}, but no node that moves {drive} reads safety; "
                f"allowed: {nodes[0]}.reaction_delay of a block or more, or a weaker reaction"
            )

    def _check_retraction(self, cell: WiredCell) -> None:
        """Check that a retraction reaches the requested clearance."""
        drive, clear = self.parameters.drives[0], self.parameters.clear_position
        for topic, name in ((f"{drive}/command", "retract_position"), (f"{drive}/state", "command_stroke")):
            outlet_topic = remapped(self.shared, topic)
            node = cell.node_of(outlet_topic)
            if node is None:
                continue  # a series drive passes commands on internally
            source = cell.publisher(outlet_topic, f"whether {node} gets beyond {self.name}.clear_position")
            if source is None:
                continue
            reached = getattr(source.shared, name, None)
            if reached is not None and isinstance(source, Learner):  # a command, to which the drive has its gain
                learned = source.learned(cell.stages.values())
                reached *= min((response(np.zeros(1))[0].real for response, _ in learned), default=1.0)
            counts = reached if name == "command_stroke" else getattr(source.shared, "reaction_delay", 0)
            if counts and reached is not None and reached <= clear:
                raise InputError(
                    f"{source.name}.{name} = {reached:g} m, but the tool is out of the part beyond "
                    f"{self.name}.clear_position = {clear:g} m; allowed: above that, or a smaller clear_position"
                )

    def _check_clearance(self, cell: WiredCell) -> None:
        """Check that the requested clearance is within the stroke of the drive."""
        clear = self.parameters.clear_position
        node = cell.node_of(remapped(self.shared, f"{self.parameters.drives[0]}/state"))
        drive = cell.stages.get(node or "")  # the check of the retraction has already reported unknown members
        for limits in drive.limits().values() if isinstance(drive, Drive) else ():
            if limits.stroke <= clear:
                raise InputError(
                    f"{self.name}.clear_position = {clear:g} m: the tool is out of the part beyond that, and the "
                    f"stroke of {node} ends at {limits.stroke:g} m; allowed: less than that"
                )
