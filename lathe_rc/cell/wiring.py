# SPDX-License-Identifier: Apache-2.0
"""The wired cell: stages in the order in which they compute, topics by name, and the checks before a start.

Longer than 400 lines: each check looks at the same wired cell, and a cell is refused by all of them or by none.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple

import numpy as np

from lathe_rc.analysis.learning import Response
from lathe_rc.cell import extremes
from lathe_rc.cell.cures import Loop
from lathe_rc.cell.parameters import NodeParameters, remapped
from lathe_rc.cell.scenario import kind_of
from lathe_rc.cell.stage import Input, Output, Stage
from lathe_rc.cell.stages import MASTERS, STAGES
from lathe_rc.cell.stages.drive import Drive
from lathe_rc.cell.stages.form import ProfileStage
from lathe_rc.cell.stages.learner import Learner
from lathe_rc.cell.stages.learning_controller import LearningController
from lathe_rc.cell.stages.supervisor import Supervisor
from lathe_rc.cell.stages.time_master import TimeMaster
from lathe_rc.cell.stages.tool import Tool
from lathe_rc.errors import InputError, UnpublishedError
from lathe_rc.safety.state_machine import Reaction
from lathe_rc.signals.tip_path import steepest_fall

_LEAST_SAMPLES = 4  # of a revolution


@dataclass(frozen=True)
class Source:
    """The node that publishes a topic."""

    node: str
    type: str


@dataclass(frozen=True)
class Unknown:
    """A member whose stage or parameters nobody here knows: of it counts what it announces of its topics.

    Attributes:
        dense: message type by relative topic, of those that carry a block a block.
        sparse: the same of those that carry messages at chosen samples.
        reads: relative topics.
    """

    dense: Mapping[str, str]
    sparse: Mapping[str, str]
    reads: frozenset[str]


class Ports(NamedTuple):
    """The ports of a stage; topics are relative names after remapping.

    Attributes:
        node: its name.
        inputs: that it reads, with their topics.
        own: how many of them its step gets.
        outputs: that it publishes, the same way.
        sparse: topics and types of messages at chosen samples.
    """

    node: str
    inputs: tuple[tuple[str, Input], ...]
    own: int
    outputs: tuple[tuple[str, Output], ...]
    sparse: tuple[tuple[str, str], ...]


def _ports(stage: Stage) -> Ports:
    table = stage.shared
    return Ports(
        stage.name,
        tuple((remapped(table, port.topic), port) for port in stage.inputs),
        stage.own_inputs,
        tuple((remapped(table, port.topic), port) for port in stage.outputs),
        tuple((remapped(table, topic), msgtype) for topic, msgtype in stage.sparse_topics.items()),
    )


@dataclass(frozen=True, eq=False)
class Wiring:
    """Publishers and order of the stages; the same one for all cells whose ports are alike.

    Attributes:
        dense, sparse: see `Cell`.
        order: of the stages.
    """

    dense: dict[str, Source]
    sparse: dict[str, Source]
    order: Sequence[str]


def _wire(stages: Sequence[Ports], unknown: Mapping[str, Unknown]) -> Wiring:
    """Wire some stages and members; raises as `Cell` does."""
    dense, sparse = _sources(stages, unknown)
    order: TopologicalSorter[str] = TopologicalSorter({stage.node: () for stage in stages})
    for stage in stages:
        for topic, port in stage.inputs:
            source = _source(dense, stage.node, topic, port)
            if port.delay == 0 and source.node not in unknown:
                order.add(stage.node, source.node)
    try:
        return Wiring(dense, sparse, tuple(order.static_order()))
    except CycleError as error:
        raise InputError(f"{' -> '.join(error.args[1])}: a loop without a feedback delay cannot start") from None


def _sources(stages: Sequence[Ports], unknown: Mapping[str, Unknown]) -> tuple[dict[str, Source], dict[str, Source]]:
    """The publishers of dense and sparse topics."""
    dense: dict[str, Source] = {}
    sparse: dict[str, Source] = {}

    def add(topics: dict[str, Source], topic: str, source: Source) -> None:
        if other := dense.get(topic) or sparse.get(topic):
            raise InputError(f"{topic} is published by {other.node} and {source.node}; remap one of them")
        topics[topic] = source

    for stage in stages:
        for topic, output in stage.outputs:
            add(dense, topic, Source(stage.node, output.type))
        for topic, msgtype in stage.sparse:
            add(sparse, topic, Source(stage.node, msgtype))
    for name, member in unknown.items():
        for topics, published in ((dense, member.dense), (sparse, member.sparse)):
            for topic, msgtype in published.items():
                add(topics, topic, Source(name, msgtype))
    return dense, sparse


@lru_cache
def _wire_alike(stages: tuple[Ports, ...]) -> Wiring:
    return _wire(stages, {})


def _source(dense: Mapping[str, Source], node: str, topic: str, port: Input) -> Source:
    """The publisher of a topic that a node reads."""
    source = dense.get(topic)
    if source is None:
        raise UnpublishedError(
            f"{node} reads {topic}, which no node of the scenario publishes; allowed: a node that does, or another "
            f"topic by {node}.remap"
        )
    if source.type != port.type:
        raise InputError(f"{node} reads {topic} as {port.type}, but {source.node} publishes {source.type}")
    return source


def new_stage(name: str, table: NodeParameters) -> Stage:
    """The stage of a node."""
    return STAGES[kind_of(name, table.stage)](name, table)


class Cell:
    """All stages of a scenario, wired.

    Args:
        nodes: table of each node by name; nodes that are no stages are left out.
        unknown: members that nobody here knows more of than their topics, by name.
        stage: gives the stage of a name and table.

    Attributes:
        unknown: see above.
        unchecked: what `check` could not check since it depends on them, or since a law or drive of others does not
            tell what is needed; one line each.
        warnings: doubts about parameters that can be meant, and what makes the form worse than the laws can do, with
            its cure; one line each. `check` finds them.
        factors: largest factor of a cycle over all frequencies, sup|Q - γZ| of repetitive control, by learning node;
            below 1 the error of each cycle is smaller than that of the one before. `check` finds it.
        stages: by node name, in the order of the forward edges.
        wiring: see `Wiring`.
        dense: publisher of each topic that carries a block a block, by relative topic.
        sparse: the same for topics that carry messages at chosen samples.

    Raises:
        InputError: a topic without or with two publishers, types that do not match, a loop without a delay.
    """

    def __init__(
        self,
        nodes: Mapping[str, NodeParameters],
        unknown: Mapping[str, Unknown] | None = None,
        *,
        stage: Callable[[str, NodeParameters], Stage] = new_stage,
    ) -> None:
        self.unknown, self.unchecked, self.warnings = unknown or {}, list[str](), list[str]()
        self.factors: dict[str, float] = {}
        self._tables = nodes
        with extremes.refused(nodes):
            made = {name: stage(name, table) for name, table in nodes.items() if kind_of(name, table.stage) in STAGES}
        ports = tuple(map(_ports, made.values()))
        self.wiring = _wire(ports, self.unknown) if self.unknown else _wire_alike(ports)
        self.dense, self.sparse = self.wiring.dense, self.wiring.sparse
        self.stages = {name: made[name] for name in self.wiring.order}

    def _publisher(self, topic: str, question: str) -> Stage | None:
        """The stage that publishes a topic; None if nobody here knows it: then the question stays open."""
        name = self.dense[topic].node
        if name in self.unknown:
            self._leave_open(question, name)
        return self.stages.get(name)

    def _leave_open(self, question: str, name: str) -> None:
        self.unchecked.append(f"the parameters of {name} are not known here: {question}")

    def replace(self, stage: Stage) -> None:
        """Put a stage in the place of the one of its name, whose ports it has."""
        self.stages[stage.name] = stage
        self.__dict__.pop("master", None)

    @cached_property
    def master(self) -> TimeMaster:
        """The time master.

        Raises:
            InputError: there is none, or more than one.
        """
        found = [stage for stage in self.stages.values() if isinstance(stage, TimeMaster)]
        if len(found) != 1:
            raise InputError(f"{len(found)} time masters in the scenario; allowed: 1, a {' or '.join(MASTERS)}")
        return found[0]

    @property
    def samples(self) -> int:
        """Length of a run.

        Raises:
            InputError: it has no end, or nobody knows it before, or there is no time master.
        """
        expected = self.expected_samples
        if self.master.samples is None:
            raise InputError(
                f"{self.master.name} follows a device, which a node hears; allowed: --mode composed or processes, or a "
                "file of its counts"
            )
        return expected

    @property
    def expected_samples(self) -> int:
        """Length of a run, as far as it can be known before.

        Raises:
            InputError: it has no end, or there is no time master.
        """
        expected = self.master.expected_samples
        if expected is None:
            raise InputError(f"{self.master.name}.revolutions = 0; this run needs an end: allowed above 0")
        return expected

    def readers(self, topic: str) -> list[Stage]:
        """Stages that read a relative topic."""
        return [
            stage
            for stage in self.stages.values()
            if any(remapped(stage.shared, port.topic) == topic for port in stage.inputs)
        ]

    def inputs(self, topic: str) -> list[Input]:
        """Ports that read a relative topic."""
        return [
            port
            for stage in self.stages.values()
            for port in stage.inputs
            if remapped(stage.shared, port.topic) == topic
        ]

    @property
    def shortest_feedback(self) -> int | None:
        """Shortest feedback delay in the cell [sample]; None without feedback."""
        delays = [port.delay for stage in self.stages.values() for port in stage.inputs if port.delay]
        return min(delays, default=None)

    def check(self, *, cures: bool = True) -> None:
        """Refuse what cannot work, with the figures, before anything moves; `unchecked` says what was left out.

        Args:
            cures: look for parameters with which learning would converge, which takes half a second at most.

        Raises:
            InputError: a block longer than a feedback delay, a profile that a drive cannot follow, a flank of the tool
                that would rub, a tool that is not brought out of the part, a memory that would be read before it is
                learned, a learning loop that does not converge.
        """
        with extremes.refused(self._tables):
            self._check(cures=cures)

    def _check(self, *, cures: bool) -> None:
        self.unchecked.clear()
        seconds = (self.master.expected_samples or math.inf) * self.master.shared.step
        self.warnings = [doubt for stage in self.stages.values() for doubt in stage.warnings(seconds)]
        self.factors.clear()
        low, high = self.master.speed_range()
        if low <= 0.0:
            raise InputError(
                f"{self.master.name}.nominal_rpm and its deviations: speed falls to {low:.4g} rad/s; allowed: above 0"
            )
        if (samples := 2.0 * math.pi / (high * self.master.shared.step)) < _LEAST_SAMPLES:
            raise InputError(
                f"{self.master.name}.nominal_rpm and its deviations: a revolution takes {samples:.3g} samples at "
                f"{high:.4g} rad/s; allowed: {_LEAST_SAMPLES} or more (turn slower, or raise sample_rate)"
            )
        for stage in self.stages.values():
            for port in stage.inputs:
                if 0 < port.delay < stage.shared.block_size:
                    raise InputError(
                        f"{stage.name}: feedback of {port.topic} is delayed by {port.delay} samples, block_size = "
                        f"{stage.shared.block_size}; allowed: a block no longer than the delay"
                    )
            if isinstance(stage, Tool):
                owner = self._form(stage)
                self._check_profile(stage, owner, high)
                _check_flank(owner)
            if isinstance(stage, Supervisor) and stage.parameters.drives:
                self._check_obedience(stage)
                self._check_retraction(stage)
                self._check_clearance(stage)
            if isinstance(stage, LearningController):
                self._check_preview(stage)
            if isinstance(stage, Learner):
                self._check_delay(stage, high)
                self._check_convergence(stage, stage.checked_speeds(low, high), cures=cures)
                self.warnings += stage.encoder_warnings(low, high, self.master.parameters.counts_per_revolution)

    @property
    def margins(self) -> dict[str, float | None]:
        """Stability margin of each learning controller, 1 less its factor of a cycle; None if that is not known."""
        learners = (name for name, stage in self.stages.items() if isinstance(stage, Learner))
        return {name: 1.0 - self.factors[name] if name in self.factors else None for name in learners}

    def learned(self, stage: Learner) -> list[tuple[Response, str]]:
        """Responses and names of the drives that a channel commands."""
        commands = {remapped(stage.shared, output.topic) for output in stage.outputs}
        return [
            (response, drive.name)
            for drive in self.stages.values()
            if isinstance(drive, Drive)
            for topic, response in drive.responses().items()
            if remapped(drive.shared, topic) in commands and any(port.topic == topic for port in drive.inputs)
        ]

    def _check_convergence(self, stage: Learner, speeds: Collection[float], *, cures: bool) -> None:
        command = remapped(stage.shared, stage.outputs[0].topic)
        unknown = [name for name, member in self.unknown.items() if command in member.reads]
        for name in unknown:
            self._leave_open(f"whether {stage.name} converges with {name}", name)
        learned, untold = self.learned(stage), list[str]()
        for response, drive in learned:
            self._check_reach(stage, drive)
            found = {speed: stage.worst(response, speed) for speed in speeds}
            told = [(worst, speed) for speed, worst in found.items() if worst is not None]
            if broken := next(((worst, speed) for worst, speed in told if math.isnan(worst[0])), None):
                (_, waves), speed = broken
                raise InputError(
                    f"{stage.name}: {stage.factor} with {drive} is not a number at {waves:.4g} waves and {speed:.4g} "
                    "rad/s; allowed: finite numbers; see contraction of the law and response of the drive"
                )
            if told:
                worst, speed = max(told)
                self.factors[stage.name] = max(worst[0], self.factors.get(stage.name, 0.0))
                loop = Loop(stage, [response for response, _ in learned], speeds)
                _check_factor(loop, drive, worst, speed, cures=cures)
            else:
                untold.append(f"{stage.name}: {stage.kind} tells no factor of a cycle: nobody knows if it converges")
        if not learned and not unknown:
            untold.append(f"{stage.name}: no drive tells its response to {command}: nobody knows if it converges")
        if untold and not (stage.parameters.stop_ratio or stage.parameters.allow_unstable):
            raise InputError(
                f"{untold[0]}; allowed: {stage.name}.stop_ratio above 0 (2: twice the error of the first cycle ends "
                "the run), or allow_unstable"
            )
        self.unchecked += untold

    def _check_obedience(self, stage: Supervisor) -> None:
        """Where a retraction can be asked for, somebody takes the tool out."""
        asks = next((monitor for monitor in stage.monitors if monitor.reaction >= Reaction.RETRACT), None)
        drive, safety = stage.parameters.drives[0], remapped(stage.shared, "safety")
        found = [self.dense.get(remapped(stage.shared, f"{drive}/{what}")) for what in ("command", "state")]
        nodes = [source.node for source in found if source]
        listening = {reader.name for reader in self.readers(safety)}
        listening |= {name for name, member in self.unknown.items() if safety in member.reads}
        if asks and nodes and not listening & set(nodes):
            asked = f"monitor {asks.name} asks for {asks.reaction.name.lower()}"
            raise InputError(
                f"{stage.name}: {asked}, but no node that moves {drive} reads safety; "
                f"allowed: {nodes[0]}.reaction_delay of a block or more, or a weaker reaction"
            )

    def _check_retraction(self, stage: Supervisor) -> None:
        """The tool has to get as far out of the part as is asked for before it is safe."""
        drive, clear = stage.parameters.drives[0], stage.parameters.clear_position
        for topic, name in ((f"{drive}/command", "retract_position"), (f"{drive}/state", "command_stroke")):
            outlet_topic = remapped(stage.shared, topic)
            outlet = self.dense.get(outlet_topic)
            if outlet is None:
                continue  # a series drive passes commands on inside
            source = self._publisher(outlet_topic, f"whether {outlet.node} gets beyond {stage.name}.clear_position")
            if source is None:
                continue
            reached = getattr(source.shared, name, None)
            counts = reached if name == "command_stroke" else getattr(source.shared, "reaction_delay", 0)
            if counts and reached is not None and reached <= clear:
                raise InputError(
                    f"{source.name}.{name} = {reached:g} m, but the tool is out of the part beyond "
                    f"{stage.name}.clear_position = {clear:g} m; allowed: above that, or a smaller clear_position"
                )

    def _check_clearance(self, stage: Supervisor) -> None:
        """A drive gets no farther than its stroke."""
        clear = stage.parameters.clear_position
        outlet = self.dense.get(remapped(stage.shared, f"{stage.parameters.drives[0]}/state"))
        drive = self.stages.get(outlet.node) if outlet else None  # what is unknown has been said of the retraction
        if not isinstance(drive, Drive):
            return
        for limits in drive.limits().values():
            if limits.stroke <= clear:
                raise InputError(
                    f"{stage.name}.clear_position = {clear:g} m: the tool is out of the part beyond that, and the "
                    f"stroke of {drive.name} ends at {limits.stroke:g} m; allowed: less than that"
                )

    def _check_reach(self, stage: Learner, name: str) -> None:
        """Refuse bounds with which it could not take over from every position of the drive."""
        drive, parameters = self.stages[name], stage.parameters
        assert isinstance(drive, Drive), "it learns"
        reach = parameters.bounds().reach(parameters.retract_time)
        for limits in drive.limits().values() if parameters.reaction_delay else ():
            needed = limits.stroke + max(limits.stroke, abs(parameters.retract_position))
            if reach < needed:
                raise InputError(
                    f"{stage.name}.retract_time = {parameters.retract_time:g} s: the bounds allow a way of {reach:.3g} "
                    f"m in that, and the stroke of {name} needs {needed:.3g} m; allowed: a longer retract_time, or "
                    "wider bounds"
                )

    def _check_delay(self, stage: Learner, speed: float) -> None:
        encoder = self.master.parameters
        count = 2 * math.pi / encoder.counts_per_revolution if encoder.counts_per_revolution else 0.0
        acceleration = self.master.largest_acceleration()
        largest = stage.largest_delay(speed, acceleration, count, encoder.speed_window * encoder.step)
        delay = stage.parameters.feedback_delay
        if largest is None:
            self.unchecked.append(f"{stage.name}: {stage.kind} tells no longest feedback_delay")
        elif delay > largest:
            least = stage.shared.block_size
            allowed = f"{least} up to {largest}"
            if largest < least:
                allowed = f"{largest} or less, with a block_size no longer than that"
            if largest < 1:
                allowed = "a longer cycle, a shorter lead, or a spindle that turns slower"
            raise InputError(
                f"{stage.name}.feedback_delay = {delay} samples: at {speed:.4g} rad/s the cycle leaves "
                f"{max(largest, 0)}; allowed: {allowed}"
            )

    def _check_preview(self, stage: LearningController) -> None:
        if stage.parameters.lead_law != "exact_preview":
            return
        told, true = stage.parameters.speed_law(stage.name), self.master.law
        if true is None:
            raise InputError(
                f"{stage.name}.lead_law = exact_preview, but nobody knows the speed of {self.master.name} in advance; "
                "allowed: another lead law"
            )
        if not (np.array_equal(told.lines, true.lines) and np.array_equal(told.tachogram, true.tachogram)):
            raise InputError(
                f"{stage.name}.lead_law = exact_preview, but it does not know the speed of {self.master.name}; give "
                f"it the same deviation, tachogram and random parameters"
            )

    def _check_profile(self, tool: Tool, owner: Tool | ProfileStage | None, speed: float) -> None:
        """The first drive carries the profile that ``owner`` has; the others what it leaves."""
        drive = tool.parameters.drives[0]
        topic = remapped(tool.shared, f"{drive}/state")
        source = self._publisher(topic, f"whether {self.dense[topic].node} can follow the profile of {tool.name}")
        if owner is None or owner.form is None or not isinstance(source, Drive):
            return
        acceleration = self.master.largest_acceleration()
        demand = owner.form.profile.demand(speed, acceleration, owner.parameters.feed)
        for of, limits in source.limits().items():
            if remapped(source.shared, of) != topic:
                continue
            for what, asked, allowed, unit in (
                ("stroke", demand.stroke * 1e6, limits.stroke * 1e6, "µm"),
                ("velocity", demand.velocity, limits.velocity, "m/s"),
                ("acceleration", demand.acceleration, limits.acceleration, "m/s^2"),
            ):
                if asked > allowed:
                    raise InputError(
                        f"{owner.name}.profile: {source.name} cannot follow it at {speed:.4g} rad/s: {what} "
                        f"{asked:.4g} {unit}; allowed: {allowed:.4g} {unit} (turn slower or change the form)"
                    )

    def _form(self, tool: Tool) -> Tool | ProfileStage | None:
        """The stage that has the tool's desired form."""
        if tool.form is not None:
            return tool
        source = self._publisher(
            remapped(tool.shared, "reference"), f"whether a drive can follow what {tool.name} reads"
        )
        return source if isinstance(source, ProfileStage) else None


def _check_flank(owner: Tool | ProfileStage | None) -> None:
    """The flank leaves the surface behind the edge free."""
    if owner is None or owner.form is None or not owner.parameters.clearance:
        return
    parameters = owner.parameters
    fall = steepest_fall(owner.form.surface, parameters.part_radius, parameters.feed)
    if fall.clearance >= parameters.clearance:
        raise InputError(
            f"{owner.name}.clearance = {parameters.clearance:g} rad: the tool's flank would rub, since the form falls "
            f"by {fall.clearance:.4g} rad at {fall.angle:.4g} rad, height {fall.height:g} m; allowed: above that, or a "
            "flatter form"
        )


def _check_factor(loop: Loop, drive: str, worst: tuple[float, float], speed: float, *, cures: bool) -> None:
    (largest, waves), stage = worst, loop.stage
    where = f"{waves * speed:.5g} rad/s ({waves:.4g} waves at {speed:.4g} rad/s)"
    if largest >= 1.0 and not stage.parameters.allow_unstable:
        told = " or ".join(loop.cures() if cures else []) or stage.remedy
        raise InputError(
            f"{stage.name}: learning diverges with {drive}: {stage.factor} = {largest:.4g} at {where} with "
            f"{stage.settings()}; allowed: below 1 ({told}; or set allow_unstable)"
        )
