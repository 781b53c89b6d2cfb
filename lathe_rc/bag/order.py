# SPDX-License-Identifier: Apache-2.0
"""The order of signal messages in a bag: by log time, then topic, then index, whoever arrived first."""

from collections import deque
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from lathe_rc.errors import LatheError

Data = bytes | memoryview  #: an encoded message


class Entry(NamedTuple):
    """A message to be written; sorts as bags are sorted.

    Attributes:
        log_ns: log time.
        topic: fully qualified.
        sequence: number of the message on its topic, from 1.
        data: its bytes.
        first, companions, last: of a block: what its info says.
    """

    log_ns: int
    topic: str
    sequence: int
    data: Data
    first: int = 0
    companions: int = 0
    last: bool = False


class Merger:
    """Collects the messages of all signal topics and gives them back in the order of a bag.

    A block leaves when every dense topic has brought the block with the same first sample and every source the
    sparse messages that its block counts: then nothing with an earlier time can still come.

    Args:
        dense: source by fully qualified dense topic.
        sparse: source by fully qualified sparse topic.
    """

    def __init__(self, dense: Mapping[str, str], sparse: Mapping[str, str]) -> None:
        self._dense, self._sparse = dense, sparse
        self._blocks: dict[str, deque[Entry]] = {topic: deque() for topic in dense}
        self._empty = len(self._blocks)  # topics without a block
        self._waiting: list[Entry] = []
        self._sequence = dict.fromkeys([*dense, *sparse], 0)
        self._received = dict.fromkeys(sparse.values(), 0)
        self.blocks = 0  #: complete blocks given back, over all topics
        self.complete = False  #: True when the last block of every topic has been given back

    def add_block(self, topic: str, log_ns: int, data: Data, *, first: int, companions: int, last: bool) -> bool:
        """Take a block message; returns whether every topic has one now, so that it is worth asking `release`."""
        queue = self._blocks[topic]
        if not queue:
            self._empty -= 1
        sequence = self._sequence[topic] = self._sequence[topic] + 1
        queue.append(Entry(log_ns, topic, sequence, data, first, companions, last))
        return not self._empty

    def add_sparse(self, topic: str, log_ns: int, data: Data) -> None:
        """Take a sparse message."""
        self._sequence[topic] += 1
        self._waiting.append(Entry(log_ns, topic, self._sequence[topic], data))
        self._received[self._sparse[topic]] += 1

    def release(self) -> Iterator[list[Entry]]:
        """Give back what is complete, one sorted list for each block.

        Raises:
            LatheError: topics are cut into different blocks.
        """
        while not self._empty:
            heads = [queue[0] for queue in self._blocks.values()]
            end = heads[0]
            for head in heads:
                if head.first != end.first or head.log_ns != end.log_ns or head.last != end.last:
                    spans = ", ".join(f"{other.topic} from {other.first}" for other in heads)
                    raise LatheError(f"topics are not cut into the same blocks: {spans}")
                if self._received.get(self._dense[head.topic], 0) < head.companions:
                    return
            entries = [queue.popleft() for queue in self._blocks.values()]
            self._empty = sum(not queue for queue in self._blocks.values())
            if self._waiting:
                entries += [entry for entry in self._waiting if entry.log_ns <= end.log_ns]
                self._waiting = [entry for entry in self._waiting if entry.log_ns > end.log_ns]
            self.blocks += 1
            self.complete = end.last
            entries.sort()
            yield entries

    def rest(self) -> list[Entry]:
        """Give back everything that is left, sorted: what an interrupted run has of its last blocks."""
        left = [*self._waiting, *(block for queue in self._blocks.values() for block in queue)]
        self._waiting = []
        for queue in self._blocks.values():
            queue.clear()
        self._empty = len(self._blocks)
        return sorted(left)
