# SPDX-License-Identifier: Apache-2.0
"""Chunks of equal length that all topics share, assembled from the blocks of many topics.

Chunks begin at fixed samples, so that the view does not depend on the block size. They combine the blocks of several
publishers and tolerate missing blocks, since delivery to a viewer is best-effort.
"""

from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from lathe_live.rerun_signals import drawn_fields
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.engine import Sink
from lathe_rc.messages import Samples, Signals, full

_AHEAD = 4  # number of chunks that wait for late topics

_Cuts = list[tuple[int, Signals]]  # first sample and signals of a topic's blocks in a chunk, in order of arrival


def _length(signals: Mapping[str, Samples]) -> int:
    return next(iter(signals.values())).size


def _join(first: int, cuts: _Cuts) -> Signals | None:
    """Return the signals starting at a sample; None if there is a gap."""
    for begin, signals in cuts:
        if begin != first:
            return None
        first += _length(signals)
    return {name: np.concatenate([signals[name] for _, signals in cuts]) for name in cuts[0][1]}


class Pieces:
    """Assembler of chunks, which it passes to a sink in order, each with the topics that are complete in it.

    Args:
        types: message type by topic, with or without a leading slash; only plotted block types are used.
        size: length of a chunk [sample]; chunks begin at multiples of ``size``.
        sink: receives the chunks, by fully qualified topic.

    Attributes:
        first: first sample of the first chunk. A view that joins during a run begins where all topics are complete.
        lost: number of chunks passed on without some topics, or dropped.
    """

    def __init__(self, types: Mapping[str, str], size: int, sink: Sink) -> None:
        self._fields: dict[str, set[str]] = {}  # plotted fields by topic
        self._size, self._sink = size, sink
        self._waiting: defaultdict[int, defaultdict[str, _Cuts]] = defaultdict(lambda: defaultdict(list))
        self._ends: dict[str, int] = {}  # sample after the newest of each topic
        self._sparse: list[Sparse] = []
        self._next = 0
        self._begun = False
        self._late: set[str] = set()  # topics missing in chunks passed on before, not counted in lost
        self.first = self.lost = 0
        self.learn(types)

    def learn(self, types: Mapping[str, str]) -> None:
        """Add topics that later chunks wait for."""
        new = {full(topic): fields for topic, kind in types.items() if (fields := drawn_fields(kind))}
        if self._begun:
            self._late |= new.keys() - self._fields.keys()
        self._fields |= new

    def block(self, topic: str, first: int, signals: Mapping[str, Samples]) -> None:
        """Add consecutive samples of one topic; samples that arrive too late are ignored.

        Args:
            topic: topic name; unknown topics are ignored.
            first: index of the first sample.
            signals: signals by field, shape (samples,).
        """
        topic, size = full(topic), self._size
        if topic not in self._fields:
            return
        if topic not in self._ends and not self._begun:  # begin with the chunk after the topic's first sample, or later
            self._next = max(self._next, -(-first // size))
            self.first = self._next * size
            for piece in [piece for piece in self._waiting if piece < self._next]:
                del self._waiting[piece]
        if topic in self._late:
            self._late.remove(topic)
            self.lost += max(0, self._next - first // size)
        end = first + _length(signals)
        for piece in range(max(first // size, self._next), -(-end // size)):
            begin = max(first, piece * size)
            span = slice(begin - first, min(end, (piece + 1) * size) - first)
            self._waiting[piece][topic].append((begin, {name: signals[name][span] for name in self._fields[topic]}))
        self._ends[topic] = end
        # Pass on complete chunks, and chunks that have waited long enough.
        complete = min(self._ends.get(each, 0) for each in self._fields) // size
        while self._waiting and ((oldest := min(self._waiting)) < complete or len(self._waiting) > _AHEAD):
            self._emit(oldest)

    def message(self, message: Sparse) -> None:
        """Add a message at its sample."""
        self._sparse.append(message)

    def close(self) -> None:
        """Pass on the remaining chunks."""
        while self._waiting:
            self._emit(min(self._waiting), closing=True)
        if self._sparse:
            self._sink.chunk(
                self._next * self._size, 0, {}, self._messages(max(each.index for each in self._sparse) + 1)
            )

    def _emit(self, piece: int, *, closing: bool = False) -> None:
        begin = piece * self._size
        joined = {topic: _join(begin, cuts) for topic, cuts in self._waiting.pop(piece).items()}
        samples = max((_length(signals) for signals in joined.values() if signals), default=0)
        dense = {topic: signals for topic, signals in joined.items() if signals and _length(signals) == samples}
        cut = samples < self._size and not (closing and not self._waiting)  # only the last chunk may be short
        self.lost += piece - self._next + (cut or len(dense) < len(self._fields))
        self._next, self._begun = piece + 1, True
        if samples:
            self._sink.chunk(begin, samples, dense, self._messages(begin + samples))

    def _messages(self, end: int) -> dict[str, list[Sparse]]:
        """Return the messages up to a sample, by topic."""
        taken: dict[str, list[Sparse]] = {}
        for message in self._sparse:
            if message.index < end:
                taken.setdefault(full(message.topic), []).append(message)
        self._sparse = [message for message in self._sparse if message.index >= end]
        return taken
