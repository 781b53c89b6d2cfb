# SPDX-License-Identifier: Apache-2.0
"""Signals between the nodes of one process: handed over in memory, not through DDS.

Which topics stay inside is settled once, when the nodes of a process have been configured and before any of them is
activated. Nodes that are configured later, and those in other processes, use DDS. What is handed over is the same:
the arrays that the publisher computed, which nobody writes to afterwards, or the bytes of a message at a chosen sample.
Blocks that were computed in one go come in one piece.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from lathe_rc.cell.block import Block
from lathe_rc.cell.wiring import Cell


class Run(NamedTuple):
    """Consecutive blocks in one piece.

    Attributes:
        block: all of their samples, and the companions of the last; if it is the last, so is the last of them.
        companions: what each of them says of its companions, see BlockInfo.msg.
    """

    block: Block
    companions: Sequence[int]

    def blocks(self, size: int) -> Iterator[Block]:
        """Each of them, as views; ``size`` is their length, the last of the run may be shorter [sample]."""
        if len(self.companions) == 1:
            yield self.block
            return
        for k, companions in enumerate(self.companions):
            block = self.block.part(k * size, min((k + 1) * size, self.block.samples))
            block.companions = companions
            yield block


Delivery = Run | bytes  #: blocks, or an encoded message at a chosen sample


def _alone(role: Any, cell: Cell | None) -> None:
    """Let each stage compute by itself."""


class Exchange:
    """Blocks that nodes hand over inside of a process.

    Attributes:
        master: takes the Progress of a node, if the time master is in this process.
        stages: roles with a stage that are active and have not computed yet, see `lathe_rc.nodes.chain`.
        form: lets a stage and those of its cell that wait here compute together, if it is given what they make.
    """

    def __init__(self, form: Callable[[Any, Cell | None], None] = _alone) -> None:
        self.form = form
        self.master: Callable[[Any], None] | None = None
        self.stages: list[Any] = []
        self._inside: set[str] = set()
        self._readers: dict[str, dict[str, Callable[[Any], None]]] = defaultdict(dict)

    def join(self, published: Iterable[str]) -> None:
        """Take in the fully qualified topics that a configured node publishes."""
        self._inside.update(published)

    def has(self, topic: str) -> bool:
        """Whether a node of this process publishes a topic."""
        return topic in self._inside

    def listen(self, topic: str, member: str, callback: Callable[[Any], None]) -> None:
        """Let a node read a topic that `has`; its callback gets every `Delivery`."""
        self._readers[topic][member] = callback

    def read(self, topic: str) -> bool:
        """Whether anybody in this process reads a topic."""
        return topic in self._readers

    def readers(self, topic: str) -> set[str]:
        """Fully qualified names of the nodes that read a topic here, and not through DDS."""
        return set(self._readers.get(topic, ()))

    def hand_over(self, topic: str, delivery: Delivery) -> None:
        """Give a message to the readers in this process."""
        for callback in self._readers.get(topic, {}).values():
            callback(delivery)
