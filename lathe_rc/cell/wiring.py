# SPDX-License-Identifier: Apache-2.0
"""Wired cell: stages in order of computation, topics by name, and the checks before a start.

Requirements of a single kind of stage are checked by its `lathe_rc.cell.stage.Stage.check_cell`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from graphlib import CycleError, TopologicalSorter
from typing import TYPE_CHECKING, NamedTuple

from lathe_rc.blocks.ports import Input, Output
from lathe_rc.cell.kinds import MASTERS, STAGES
from lathe_rc.cell.parameters import NodeParameters, explain_overflow, remapped
from lathe_rc.cell.scenario import kind_of, new_stage
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.time_master import START_FROM, TimeMaster
from lathe_rc.errors import InputError, UnpublishedError

if TYPE_CHECKING:
    from lathe_machine.stages.learning.learner import CheckedLoop
    from lathe_rc.analysis.cycle_factors import DriveMargin
    from lathe_rc.cell.checkpoint import Checkpoint


def _begun(nodes: Mapping[str, NodeParameters]) -> "Checkpoint | None":
    """Return the checkpoint that the time master of some nodes names; None without one."""
    if not any(getattr(table, START_FROM, "") for table in nodes.values()):
        return None
    from lathe_rc.cell.checkpoint import begun_of

    return begun_of(nodes)


@dataclass(frozen=True)
class Publisher:
    """Node that publishes a topic."""

    node: str
    type: str


@dataclass(frozen=True)
class Unknown:
    """Member with unknown stage or parameters, described only by the topics that it announces.

    Attributes:
        dense: message type by relative topic, of the topics with one block per block.
        sparse: message type by relative topic, of the topics with messages at chosen samples.
        reads: relative topics that the member reads.
    """

    dense: Mapping[str, str]
    sparse: Mapping[str, str]
    reads: frozenset[str]


class Ports(NamedTuple):
    """Ports of a stage, with relative topic names after remapping.

    Attributes:
        node: name of the stage's node.
        inputs: input ports with their topics.
        own: number of inputs passed to the step.
        outputs: output ports with their topics.
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
    """Publishers and order of the stages, shared by all cells with equal ports.

    Attributes:
        dense, sparse: see `Cell`.
        order: indices of the stages in order of computation.
    """

    dense: dict[str, Publisher]
    sparse: dict[str, Publisher]
    order: Sequence[str]


def _wire(stages: Sequence[Ports], unknown: Mapping[str, Unknown]) -> Wiring:
    """Wire stages and unknown members; raise as `Cell` does."""
    dense, sparse = _sources(stages, unknown)
    # All nodes first, so that those that do not depend on one another keep the order of the scenario.
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


def _sources(
    stages: Sequence[Ports], unknown: Mapping[str, Unknown]
) -> tuple[dict[str, Publisher], dict[str, Publisher]]:
    """Return the publishers of dense and sparse topics."""
    dense: dict[str, Publisher] = {}
    sparse: dict[str, Publisher] = {}

    def add(topics: dict[str, Publisher], topic: str, source: Publisher) -> None:
        if other := dense.get(topic) or sparse.get(topic):
            raise InputError(f"{topic} is published by {other.node} and {source.node}; remap one of them")
        topics[topic] = source

    for stage in stages:
        for topic, output in stage.outputs:
            add(dense, topic, Publisher(stage.node, output.type))
        for topic, msgtype in stage.sparse:
            add(sparse, topic, Publisher(stage.node, msgtype))
    for name, member in unknown.items():
        for topics, published in ((dense, member.dense), (sparse, member.sparse)):
            for topic, msgtype in published.items():
                add(topics, topic, Publisher(name, msgtype))
    return dense, sparse


@lru_cache
def _wire_alike(stages: tuple[Ports, ...]) -> Wiring:
    # Shared by all cells of a batch with equal wiring; `Engine.begin` compares it by identity.
    return _wire(stages, {})


def _source(dense: Mapping[str, Publisher], node: str, topic: str, port: Input) -> Publisher:
    """Return the publisher of a topic that a node reads."""
    source = dense.get(topic)
    if source is None:
        raise UnpublishedError(
            f"{node} reads {topic}, which no node of the scenario publishes; allowed: a node that does, or another "
            f"topic by {node}.remap"
        )
    if source.type != port.type:
        raise InputError(f"{node} reads {topic} as {port.type}, but {source.node} publishes {source.type}")
    return source


NewStage = Callable[[str, NodeParameters], Stage]  #: factory of a new stage


class Cell:
    """Cell with all stages of a scenario, wired.

    Args:
        nodes: table of each node by name; nodes other than stages are ignored.
        unknown: members known only by their topics, by name.
        stage: factory of the stage for a name and table, which may call a function for a new one.

    Attributes:
        begun: checkpoint from which the run goes on; None: it starts at sample 0.
        unknown: members known only by their topics, by name.
        unchecked: omissions of `check`, caused by unknown members, or by third-party laws or drives that do not provide
            the necessary data; one line each.
        warnings: unusual but valid parameters, and avoidable causes of form error, with
            a remedy; one line each. Set by `check`.
        factors: largest factor of a cycle over all frequencies, sup|Q - γZ| of repetitive control, by learning node;
            below 1 the error decreases from cycle to cycle. Set by `check`.
        loops: each learning node with the drives that it commands, also as each `set` event leaves it. Set by `check`.
        stages: by node name, in the order of the forward edges.
        wiring: see `Wiring`.
        dense: publisher of each topic with one block per block, by relative topic.
        sparse: publisher of each topic that carries messages at chosen samples, by relative topic.

    Raises:
        InputError: a topic has no or two publishers, types do not match, or a loop has no delay.
    """

    def __init__(
        self,
        nodes: Mapping[str, NodeParameters],
        unknown: Mapping[str, Unknown] | None = None,
        *,
        stage: Callable[[str, NodeParameters, NewStage], Stage] = lambda name, table, new: new(name, table),
    ) -> None:
        self.unknown, self.unchecked, self.warnings = unknown or {}, list[str](), list[str]()
        self.factors: dict[str, float] = {}
        self.loops: dict[str, list[CheckedLoop]] = {}
        self._tables = nodes
        self.begun: Checkpoint | None = _begun(nodes)
        new = self.begun.stage if self.begun else new_stage
        with explain_overflow(nodes):
            named = {name: table for name, table in nodes.items() if kind_of(name, table.stage) in STAGES}
            made = {name: stage(name, table, new) for name, table in named.items()}
        ports = tuple(map(_ports, made.values()))
        self.wiring = _wire(ports, self.unknown) if self.unknown else _wire_alike(ports)
        self.dense, self.sparse = self.wiring.dense, self.wiring.sparse
        self.stages = {name: made[name] for name in self.wiring.order}
        if self.begun:
            self.begun.check(self.stages, self.master)

    def publisher(self, topic: str, question: str) -> Stage | None:
        """Return the stage that publishes a topic; None for an unknown member, which leaves the question open."""
        name = self.dense[topic].node
        if name in self.unknown:
            self.leave_open(question, name)
        return self.stages.get(name)

    def node_of(self, topic: str) -> str | None:
        """Return the name of the member that publishes a block topic; None if there is no such member."""
        return self.dense[topic].node if topic in self.dense else None

    def leave_open(self, question: str, name: str) -> None:
        """Record a check that is not possible because it depends on the parameters of an unknown member."""
        self.unchecked.append(f"the parameters of {name} are not known here: {question}")

    def replace(self, stage: Stage) -> None:
        """Replace the stage of the same name, which has equal ports."""
        self.stages[stage.name] = stage
        # The cached master may be the replaced stage.
        self.__dict__.pop("master", None)

    @cached_property
    def master(self) -> TimeMaster:
        """Return the time master.

        Raises:
            InputError: there is no time master, or more than one.
        """
        found = [stage for stage in self.stages.values() if isinstance(stage, TimeMaster)]
        if len(found) != 1:
            raise InputError(f"{len(found)} time masters in the scenario; allowed: 1, a {' or '.join(MASTERS)}")
        return found[0]

    @cached_property
    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest speed of the spindle in the run [rad/s], computed once because it needs many samples."""
        return self.master.speed_range()

    @property
    def first(self) -> int:
        """Index of the first sample of a run."""
        return self.begun.sample if self.begun else 0

    @property
    def samples(self) -> int:
        """Return the index after the last sample of a run.

        Raises:
            InputError: the run is endless, its length is unknown in advance, or there is no time master.
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
        """Return the expected length of a run [sample].

        Raises:
            InputError: the run is endless, or there is no time master.
        """
        expected = self.master.expected_samples
        if expected is None:
            raise InputError(f"{self.master.name}.revolutions = 0; this run needs an end: allowed above 0")
        return expected

    def readers(self, topic: str) -> list[Stage]:
        """Return the stages that read a relative topic."""
        return [
            stage
            for stage in self.stages.values()
            if any(remapped(stage.shared, port.topic) == topic for port in stage.inputs)
        ]

    def reader_names(self, topic: str) -> set[str]:
        """Return the names of the members that read a relative topic, including unknown members."""
        known = {stage.name for stage in self.readers(topic)}
        return known | {name for name, member in self.unknown.items() if topic in member.reads}

    def inputs(self, topic: str) -> list[Input]:
        """Return the ports that read a relative topic."""
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
        """Check the cell before a start and report violations with figures; `unchecked` lists the omitted checks.

        Args:
            cures: whether to search for parameters with which learning would converge, which takes up to 0.5 s.

        Raises:
            InputError: a block longer than a feedback delay, a profile that a drive cannot follow, a flank of the tool
                that would rub, a tool that is not brought out of the part, a memory that would be read before it is
                learned, a learning loop that does not converge.
        """
        with explain_overflow(self._tables):
            self.unchecked.clear()
            seconds = (self.master.expected_samples or math.inf) * self.master.shared.step
            self.warnings = [doubt for stage in self.stages.values() for doubt in stage.warnings(seconds)]
            self.factors.clear()
            self.loops.clear()
            for stage in self.stages.values():
                for each in (stage, *stage.variants()):
                    each.check_cell(self, cures=cures)
            self.warnings, self.unchecked = list(dict.fromkeys(self.warnings)), list(dict.fromkeys(self.unchecked))

    @property
    def margins(self) -> dict[str, float | None]:
        """Return the stability margin of each learning controller, 1 less its factor of a cycle; None if unknown."""
        learners = (name for name, stage in self.stages.items() if stage.learns)
        return {name: 1.0 - self.factors[name] if name in self.factors else None for name in learners}

    @property
    def drive_margins(self) -> "dict[str, DriveMargin]":
        """Return the drive margin of each learning controller that provides its factors or characteristic function."""
        found: dict[str, DriveMargin] = {}
        for name, loops in self.loops.items():
            margins = filter(None, (loop.drive_margin() for loop in loops))
            found |= {name: margin} if (margin := min(margins, default=None)) else {}
        return found
