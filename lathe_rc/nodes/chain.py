# SPDX-License-Identifier: Apache-2.0
"""Chain of stages in one process, computed together, many blocks at a time.

A stage alone computes as far as its inputs allow and hands the blocks over: in a loop with a feedback of one block, one
block at a time. A chain computes like the offline engine, as far as the window and the other processes allow, and each
stage then publishes its blocks. Between two steps of a chain every stage has the state that it would have alone, queues
and delay buffers included. So the chain can be dissolved after an error, and each stage goes on alone.
"""

from collections.abc import Mapping, Sequence

from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.program import Program, Tapes, Wired, chunk_of
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes.stage_role import StageRole


class Chain:
    """Chain of stages that are about to compute block 0.

    Args:
        roles: stages in the order of computation.
    """

    def __init__(self, roles: Sequence[StageRole]) -> None:
        self._roles = list(roles)
        size = roles[0].node.table.block_size
        self._most = min(role.together for role in roles) * size
        topics: dict[str, tuple[str, dict[str, int]]] = {}
        for role in roles:
            outputs = zip(role.outputs.topics, role.stage.outputs, strict=True)
            topics |= {topic: (port.type, {}) for topic, port in outputs}
        self._inside = set(topics)
        self._stages, delays_inside = [], []
        for role in roles:
            inputs = []
            for place, (topic, port) in enumerate(role.inputs.ports):
                tape = topic if topic in self._inside else f"{role.node.full_name} {place}"
                delay = port.delay if topic in self._inside else 0  # inputs from outside are delayed already
                delays = topics.setdefault(tape, (port.type, {}))[1]
                delays |= {name: max(delays.get(name, 0), delay) for name in port.fields}
                delays_inside.append(delay)
                inputs.append((tape, delay))
            self._stages.append(Wired(role.stage, inputs, role.outputs.topics))
        self._tapes = Tapes(topics, self._most)
        self._program = Program(self._stages, self._tapes, chunk_of(size, delays_inside))
        self._busy = self._over = False
        if begun := roles[0].begun:
            self._tapes.restart(begun.sample, roles[0].past)
            self._program.begin([role.stage for role in roles], begun.sample)
        for role in roles:
            role.join(self, self._inside)
        names = [role.node.get_name() for role in roles]
        roles[0].node.reporter("chain", names[0], nodes=names)

    def advance(self) -> None:
        """Compute as far as the inputs from outside the chain allow; the first stage sets the limit."""
        if not self._busy:
            self._roles[0].lead()

    def ready(self) -> tuple[int, bool] | None:
        """Return the number of computable samples and whether the run ends there; None while an input is missing."""
        samples, last = self._most, False
        for role in self._roles:
            try:
                ready = role.ready() if role.computes else None
            except LatheError as error:
                role.node.fail(error)  # the reader of the bad input, not the first stage
                return None
            if ready is None:
                return None
            if ready[0] <= samples:
                last = ready[1] or (last and ready[0] == samples)
                samples = ready[0]
        return samples, last

    def compute(self, samples: int, *, last: bool) -> None:
        """Compute and publish a number of samples in all stages; ``last``: the run ends with these samples."""
        first, failure, self._busy = self._roles[0].samples, None, True
        self._tapes.advance(first)
        self._take_inputs(first, samples)
        try:
            self._program.run(first + samples)
        except LatheError as error:
            failure, self._over = error, True
        for number, (role, end) in enumerate(zip(self._roles, self._program.ends, strict=True)):
            said = self._program.said(number, end)
            if end > first:
                outputs = [self._tapes.view(topic, first, end - first) for topic in role.outputs.topics]
                role.angle = self._angle(number, end) if role.stage.tunable else 0.0
                try:
                    role.publish_copies(said, outputs, last=last and end == first + samples)
                except LatheError as error:
                    role.node.fail(error)
        for role in self._roles:
            role.inputs.pass_over(self._inside, role.samples)
        self._busy = False
        if self._over:
            self.leave()
        if failure is not None:
            self._roles[self._program.number].node.fail(failure)

    def _angle(self, number: int, end: int) -> float:
        """Return the measured spindle angle of the newest sample of a stage [rad], which ends before sample ``end``."""
        stage, inputs, _ = self._stages[number]
        if stage.angle_input is None:
            return 0.0
        tape, delay = inputs[stage.angle_input]
        return float(self._tapes.view(tape, end - 1, 1, delay)["angle"][0])

    def _take_inputs(self, first: int, samples: int) -> None:
        """Copy the samples from outside the chain to its tapes."""
        for role, stage in zip(self._roles, self._stages, strict=True):
            for place, (tape, _) in enumerate(stage.inputs):
                if tape in self._inside:
                    continue
                written = self._tapes.view(tape, first, samples)
                for name, array in role.inputs.take(place, first, samples).items():
                    written[name][:] = array

    def leave(self) -> None:
        """Dissolve the chain: each stage goes on alone from its current sample."""
        self._over = True
        if not self._busy:
            for role in self._roles:
                role.part(self._inside)


def form(role: StageRole, cell: Cell | None = None) -> None:
    """Form chains of a stage and other stages of its process and cell, none of which has computed yet.

    Args:
        role: the stage.
        cell: cell of all members, if known.
    """
    node, master, waiting = role.node, role.node.protocol.master, role.node.exchange.stages
    mates = {other.node.full_name: other for other in waiting if other.may_join and other.cell == role.cell}
    waiting[:] = [other for other in waiting if other.node.full_name not in mates]
    if master is None or len(mates) < 2:
        return
    try:
        cell = cell or Cell(*node.announced(master.members))
    except InputError:
        return  # the members form no valid cell, as the time master reports: each stage computes alone
    here = {name: mates[node.namespace + name] for name in cell.stages if node.namespace + name in mates}
    for group in _groups(cell, here):
        if len(group) > 1:
            Chain([here[name] for name in group])


def _groups(cell: Cell, here: Mapping[str, object]) -> list[list[str]]:
    """Group the stages of this process such that a group's outputs return to it only through feedback.

    The feedback inputs of members of unknown kind are not known: such members are placed after every group.
    """
    groups: list[list[str]] = [[]]
    beyond: set[str] = set()  # stages elsewhere that depend on the current group
    for name, stage in cell.stages.items():
        reads = {cell.dense[remapped(stage.shared, port.topic)].node for port in stage.inputs if not port.delay}
        if name in here:
            if reads & (beyond | cell.unknown.keys()):
                groups.append([])
                beyond.clear()
            groups[-1].append(name)
        elif reads & {*groups[-1], *beyond, *cell.unknown}:
            beyond.add(name)
    return groups
