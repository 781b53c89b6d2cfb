# SPDX-License-Identifier: Apache-2.0
"""Nodes of one process whose stages compute as one program, many blocks at a time.

By itself each node computes what its inputs allow and hands it over: in a loop with a feedback of one block, one
block. As a chain they compute as the offline engine does, as far as the window and the other processes allow, and each
then publishes what it has computed. Between two steps of a chain every node is as it would be by itself: its queues
and tracks hold what it would find there. So when anything goes wrong the chain is given up, and each goes on alone.
"""

from collections.abc import Mapping, Sequence

from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.program import Program, Tapes, Wired, chunk_of
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes.stage_node import StageNode


class Chain:
    """Some nodes that are about to compute sample 0.

    Args:
        nodes: in the order in which their stages compute.
    """

    def __init__(self, nodes: Sequence[StageNode]) -> None:
        self._nodes = list(nodes)
        size = nodes[0].table.block_size
        self._most = min(node.together for node in nodes) * size
        topics: dict[str, tuple[str, dict[str, int]]] = {}
        for node in nodes:
            topics |= {topic: (port.type, {}) for topic, port in zip(node.dense, node.stage.outputs, strict=True)}
        self._inside = set(topics)
        self._stages, delays_inside = [], []
        for node in nodes:
            inputs = []
            for place, (topic, port) in enumerate(node.ports()):
                tape = topic if topic in self._inside else f"{node.full_name} {place}"
                delay = port.delay if topic in self._inside else 0  # what comes from outside is late already
                delays = topics.setdefault(tape, (port.type, {}))[1]
                delays |= {name: max(delays.get(name, 0), delay) for name in port.fields}
                delays_inside.append(delay)
                inputs.append((tape, delay))
            self._stages.append(Wired(node.stage, inputs, node.dense))
        self._tapes = Tapes(topics, self._most)
        self._program = Program(self._stages, self._tapes, chunk_of(size, delays_inside))
        self._busy = self._over = False
        for node in nodes:
            node.join(self, self._inside)
        nodes[0].reporter("chain", nodes[0].get_name(), nodes=[node.get_name() for node in nodes])

    def advance(self) -> None:
        """Compute what the inputs from outside allow; the first of the nodes says how far."""
        if not self._busy:
            self._nodes[0].lead()

    def ready(self) -> tuple[int, bool] | None:
        """Samples that all can compute, and whether the run ends with them; None while an input is missing."""
        samples, last = self._most, False
        for node in self._nodes:
            found = node.next() if node.computes else None
            if found is None:
                return None
            if found[0] <= samples:
                last = found[1] or (last and found[0] == samples)
                samples = found[0]
        return samples, last

    def compute(self, samples: int, *, last: bool) -> None:
        """Let all compute so many samples, with which the run may end, and publish them."""
        first, failure, self._busy = self._nodes[0].samples, None, True
        self._tapes.advance(first)
        for node, stage in zip(self._nodes, self._stages, strict=True):
            for place, (tape, _) in enumerate(stage.inputs):
                if tape not in self._inside:
                    written = self._tapes.view(tape, first, samples)
                    for name, array in node.take(place, samples).items():
                        written[name][:] = array
        try:
            self._program.run(first + samples)
        except LatheError as error:
            failure, self._over = error, True
        for number, (node, end) in enumerate(zip(self._nodes, self._program.ends, strict=True)):
            said = self._program.said(number, end)
            if end > first:
                outputs = [self._tapes.view(topic, first, end - first) for topic in node.dense]
                node.publish_copies(said, outputs, last=last and end == first + samples)
        for node in self._nodes:
            node.pass_over(self._inside)
        self._busy = False
        if self._over:
            self.leave()
        if failure is not None:
            self._nodes[self._program.number].fail(failure)

    def leave(self) -> None:
        """Let each node go on alone, from where it stands."""
        self._over = True
        if not self._busy:
            for node in self._nodes:
                node.part(self._inside)


def form(node: StageNode, cell: Cell | None = None) -> None:
    """Make chains of a node and others of its process and cell, none of which has computed yet.

    Args:
        node: see above.
        cell: that the members make, if it is known.
    """
    waiting = node.exchange.stages
    mates = {other.full_name: other for other in waiting if other.may_join and other.cell == node.cell}
    waiting[:] = [other for other in waiting if other.full_name not in mates]
    if node.master is None or len(mates) < 2:
        return
    namespace = node.get_namespace().rstrip("/") + "/"
    try:
        cell = cell or Cell(*node.announced(node.master.members))
    except InputError:
        return  # no cell can be made of them, as the time master says: each node computes alone
    here = {name: mates[namespace + name] for name in cell.stages if namespace + name in mates}
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
