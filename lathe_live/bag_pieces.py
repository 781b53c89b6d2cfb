# SPDX-License-Identifier: Apache-2.0
"""Samples and messages of a bag in pieces, from any sample on."""

from bisect import bisect_left
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.stream import Feeder
from lathe_rc.blocks.ports import Sparse
from lathe_rc.messages import MAX_BLOCK, START_NS, Signals

_PIECE = 2**14  # samples of a piece


@dataclass(frozen=True)
class Piece:
    """Consecutive samples of a bag.

    Attributes:
        first: index of the first sample.
        samples: number of samples.
        dense: signals by topic.
        sparse: messages by topic.
    """

    first: int
    samples: int
    dense: Mapping[str, Signals]
    sparse: Mapping[str, list[Sparse]]

    @property
    def end(self) -> int:
        """Index after the last sample."""
        return self.first + self.samples

    def part(self, first: int, end: int) -> "Piece":
        """Return the samples from ``first`` to before ``end``, which are in this piece."""
        if (first, end) == (self.first, self.end):
            return self
        span = slice(first - self.first, end - self.first)
        dense = {topic: {name: array[span] for name, array in found.items()} for topic, found in self.dense.items()}
        sparse = {}
        for topic, found in self.sparse.items():
            a, b = (bisect_left(found, place, key=lambda message: message.index) for place in (first, end))
            sparse[topic] = found[a:b]
        return Piece(first, end - first, dense, sparse)


class _Pieces(list[Piece]):
    """Sink that collects pieces."""

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        self.append(Piece(first, samples, dense, sparse))


def pieces(source: BagSource, first: int, step_ns: int) -> Iterator[Piece]:
    """Yield the samples of a bag's cell in order, up to the last one that all topics have, or to the loss of a member.

    Args:
        source: the bag, which must stay open.
        first: index of the first sample.
        step_ns: sampling step [ns].

    Raises:
        InputError: the bag is damaged there.
        LatheError: samples are missing or repeated.
    """
    found = _Pieces()
    feeder = Feeder({topic: each.type for topic, each in source.topics.items()}, [found], _PIECE, first, source.loss)
    # The log time of a block is that of its last sample; blocks and messages before the first sample are left out.
    start_ns = START_NS + (first - MAX_BLOCK) * step_ns
    for batch in source.batches(set(feeder.types), start_ns=max(start_ns, 0)):
        feeder.add(batch)
        while found:
            yield found.pop(0)
    feeder.finish()
    yield from found
