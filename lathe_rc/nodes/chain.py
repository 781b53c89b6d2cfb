# SPDX-License-Identifier: Apache-2.0
"""Stages of one process that compute as one program, many blocks at a time.

By itself each stage computes what its inputs allow and hands it over: in a loop with a feedback of one block, one
block. As a chain they compute as the offline engine does, as far as the window and the other processes allow, and each
then publishes what it has computed. Between two steps of a chain every stage is as it would be by itself: its queues
and tracks hold what it would find there. So when anything goes wrong the chain is given up, and each goes on alone.
"""

from collections.abc import Mapping, Sequence

from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.program import Program, Tapes, Wired, chunk_of
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes.stage_role import StageRole


class Chain:
    """Some stages that are about to compute sample 0.

    Args:
        roles: in the order in which they compute.
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
                delay = port.delay if topic in self._inside else 0  # what comes from outside is late already
                delays = topics.setdefault(tape, (port.type, {}))[1]
                delays |= {name: max(delays.get(name, 0), delay) for name in port.fields}
                delays_inside.append(delay)
                inputs.append((tape, delay))
            self._stages.append(Wired(role.stage, inputs, role.outputs.topics))
        self._tapes = Tapes(topics, self._most)
        self._program = Program(self._stages, self._tapes, chunk_of(size, delays_inside))
        self._busy = self._over = False
        for role in roles:
            role.join(self, self._inside)
        names = [role.node.get_name() for role in roles]
        roles[0].node.reporter("chain", names[0], nodes=names)

    def advance(self) -> None:
        """Compute what the inputs from outside allow; the first of the stages says how far."""
        if not self._busy:
            self._roles[0].lead()

    def ready(self) -> tuple[int, bool] | None:
        """Samples that all can compute, and whether the run ends with them; None while an input is missing."""
        samples, last = self._most, False
        for role in self._roles:
            ready = role.ready() if role.computes else None
            if ready is None:
                return None
            if ready[0] <= samples:
                last = ready[1] or (last and ready[0] == samples)
                samples = ready[0]
        return samples, last

    def compute(self, samples: int, *, last: bool) -> None:
        """Let all compute so many samples, with which the run may end, and publish them."""
        first, failure, self._busy = self._roles[0].samples, None, True
        self._tapes.advance(first)
        for role, stage in zip(self._roles, self._stages, strict=True):
            for place, (tape, _) in enumerate(stage.inputs):
                if tape not in self._inside:
                    written = self._tapes.view(tape, first, samples)
                    for name, array in role.inputs.take(place, first, samples).items():
                        written[name][:] = array
        try:
            self._program.run(first + samples)
        except LatheError as error:
            failure, self._over = error, True
        for number, (role, end) in enumerate(zip(self._roles, self._program.ends, strict=True)):
            said = self._program.said(number, end)
            if end > first:
                outputs = [self._tapes.view(topic, first, end - first) for topic in role.outputs.topics]
                role.publish_copies(said, outputs, last=last and end == first + samples)
        for role in self._roles:
            role.inputs.pass_over(self._inside, role.samples)
        self._busy = False
        if self._over:
            self.leave()
        if failure is not None:
            self._roles[self._program.number].node.fail(failure)

    def leave(self) -> None:
        """Let each stage go on alone, from where it stands."""
        self._over = True
        if not self._busy:
            for role in self._roles:
                role.part(self._inside)


def form(role: StageRole, cell: Cell | None = None) -> None:
    """Make chains of a stage and others of its process and cell, none of which has computed yet.

    Args:
        role: see above.
        cell: that the members make, if it is known.
    """
    node, master, waiting = role.node, role.node.protocol.master, role.node.exchange.stages
    mates = {other.node.full_name: other for other in waiting if other.may_join and other.cell == role.cell}
    waiting[:] = [other for other in waiting if other.node.full_name not in mates]
    if master is None or len(mates) < 2:
        return
    try:
        cell = cell or Cell(*node.announced(master.members))
    except InputError:
        return  # no cell can be made of them, as the time master says: each stage computes alone
    here = {name: mates[node.namespace + name] for name in cell.stages if node.namespace + name in mates}
    for group in _groups(cell, here):
        if len(group) > 1:
            Chain([here[name] for name in group])


def _groups(cell: Cell, here: Mapping[str, object]) -> list[list[str]]:
    """The stages that are here, cut so that what leaves a group comes back to it by feedback alone.

    Of members that nobody here knows it is not known which of their inputs are feedback: they come after every group.
    """
    groups: list[list[str]] = [[]]
    beyond: set[str] = set()  # stages elsewhere that compute after some of the group at hand
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
