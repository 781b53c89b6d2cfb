# SPDX-License-Identifier: Apache-2.0
"""Exchange of signals between the nodes of one process: in memory, without DDS.

The topics inside the process are fixed once, after the nodes of the process have been configured and before any is
activated. Nodes configured later, and nodes in other processes, use DDS. The exchange passes on the publisher's arrays
themselves, which are not modified afterwards, or the bytes of a message at a chosen sample. Blocks computed in one step
are passed on as one `JoinedBlocks`.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from lathe_rc.blocks.block import Block

if TYPE_CHECKING:
    from lathe_rc.cell.wiring import Cell


class JoinedBlocks(NamedTuple):
    """Consecutive blocks, joined into one.

    Attributes:
        block: the samples of all blocks, with the companions and the ``last`` flag of the last one.
        companions: companions of each block, see BlockInfo.msg.
    """

    block: Block
    companions: Sequence[int]

    def blocks(self, size: int) -> Iterator[Block]:
        """Yield each block as a view; ``size`` is the block size [sample], the last block of the run may be shorter."""
        if len(self.companions) == 1:
            yield self.block
            return
        for k, companions in enumerate(self.companions):
            block = self.block.part(k * size, min((k + 1) * size, self.block.samples))
            block.companions = companions
            yield block


Delivery = JoinedBlocks | bytes  #: blocks, or an encoded message at a chosen sample


class Exchange:
    """Exchange of blocks between the nodes of one process.

    Attributes:
        master: callback for the Progress of a node, if the time master is in this process.
        stages: active roles whose stage has not computed yet (see `lathe_rc.nodes.chain`).
        form: function that forms chains of a stage and the waiting stages of its cell; takes the role and the cell. By
            default there are no chains: each stage computes alone.
        waited: time for which nodes of this process have waited in vain for acknowledgements [s].
    """

    def __init__(self, form: Callable[[Any, "Cell | None"], None] = lambda _role, _cell: None) -> None:
        self.form = form
        self.master: Callable[[Any], None] | None = None
        self.stages: list[Any] = []
        self.waited = 0.0
        self._inside: set[str] = set()
        self._readers: dict[str, dict[str, Callable[[Any], None]]] = defaultdict(dict)
        self._newest: dict[str, JoinedBlocks] = {}  # by topic

    def join(self, published: Iterable[str]) -> None:
        """Register the topics that a configured node publishes, by fully qualified name."""
        self._inside.update(published)

    def has(self, topic: str) -> bool:
        """Return True if a node of this process publishes a topic."""
        return topic in self._inside

    def listen(self, topic: str, member: str, callback: Callable[[Any], None]) -> None:
        """Subscribe a node to a topic of this process (see `has`); its callback receives every `Delivery`.

        A late reader, which begins to follow the time master, receives the newest blocks.
        """
        self._readers[topic][member] = callback
        if topic in self._newest:
            callback(self._newest[topic])

    def read(self, topic: str) -> bool:
        """Return True if a node of this process reads a topic."""
        return topic in self._readers

    def readers(self, topic: str) -> set[str]:
        """Return the fully qualified names of the nodes that read a topic here instead of through DDS."""
        return set(self._readers.get(topic, ()))

    def hand_over(self, topic: str, delivery: Delivery) -> None:
        """Pass a message on to the readers in this process."""
        if isinstance(delivery, JoinedBlocks):
            self._newest[topic] = delivery
        for callback in self._readers.get(topic, {}).values():
            callback(delivery)
