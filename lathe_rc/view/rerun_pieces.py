# SPDX-License-Identifier: Apache-2.0
"""Blocks of many topics, as they come, made into pieces of one length that all topics share.

For a bag this fixes where the pieces begin, so that a picture does not depend on how the bag was cut. Live, it joins
what several publishers send, and goes on where something is missing: a viewer has no claim on every block.
"""

from collections.abc import Mapping

from lathe_rc import messages
from lathe_rc.cell.engine import Sink
from lathe_rc.cell.stage import Sparse
from lathe_rc.messages import Samples, Signals, full
from lathe_rc.view.rerun_signals import wanted

_AHEAD = 4  # pieces that wait for the topics that are late


class _Part:
    """The part of a piece that has come of one topic."""

    def __init__(self, msgtype: str, size: int) -> None:
        fields = wanted(msgtype)
        self.signals: Signals = {
            name: array for name, array in messages.allocate(msgtype, size).items() if name in fields
        }
        self.end = 0  # samples that are there without a gap
        self.broken = False

    def add(self, start: int, signals: Mapping[str, Samples], source: slice) -> None:
        """Copy samples to ``start``; unless they follow those that are there, the part stays incomplete."""
        self.broken |= start != self.end
        count = source.stop - source.start
        for name, array in self.signals.items():
            array[start : start + count] = signals[name][source]
        self.end = start + count


class Pieces:
    """Hands pieces on to a sink: in order, with the topics that are complete in them.

    Args:
        types: message type by topic, with or without a leading slash; only block types that are drawn are kept.
        size: samples in a piece; pieces begin at its multiples.
        sink: gets them, by fully qualified topic.

    Attributes:
        first: sample that the first piece begins with. A view that joins amid a run begins where all topics are whole.
        lost: pieces that were handed on without some topic, or not at all.
    """

    def __init__(self, types: Mapping[str, str], size: int, sink: Sink) -> None:
        self._types: dict[str, str] = {}
        self._size, self._sink = size, sink
        self._waiting: dict[int, dict[str, _Part]] = {}
        self._ends: dict[str, int] = {}  # sample after the newest of each topic
        self._sparse: list[Sparse] = []
        self._next = 0
        self._begun = False
        self._late: set[str] = set()  # topics that pieces have been handed on without, uncounted
        self.first = self.lost = 0
        self.learn(types)

    def learn(self, types: Mapping[str, str]) -> None:
        """Wait for these topics as well from now on."""
        new = {full(topic): kind for topic, kind in types.items() if wanted(kind)}
        if self._begun:
            self._late |= new.keys() - self._types.keys()
        self._types |= new

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        del samples
        for found in sparse.values():
            self._sparse += found
        for topic, signals in dense.items():
            self.block(topic, first, signals)

    def block(self, topic: str, first: int, signals: Mapping[str, Samples]) -> None:
        """Take consecutive samples of one topic; those that come too late are passed over.

        Args:
            topic: of those given at the start; others are passed over.
            first: index of the first sample.
            signals: by field, shape (samples,).
        """
        topic = full(topic)
        msgtype = self._types.get(topic)
        if msgtype is None:
            return
        if topic not in self._ends and not self._begun:
            self._join(first)
        if topic in self._late:
            self._late.remove(topic)
            self.lost += max(0, self._next - first // self._size)
        samples, taken = next(iter(signals.values())).size, 0
        while taken < samples:
            piece, start = divmod(first + taken, self._size)
            count = min(self._size - start, samples - taken)
            if piece >= self._next:
                parts = self._waiting.setdefault(piece, {})
                if topic not in parts:
                    parts[topic] = _Part(msgtype, self._size)
                parts[topic].add(start, signals, slice(taken, taken + count))
            taken += count
        self._ends[topic] = first + samples
        self._hand_on()

    def message(self, message: Sparse) -> None:
        """Take a message at a chosen sample."""
        self._sparse.append(message)

    def close(self) -> None:
        """Hand on what is left."""
        while self._waiting:
            self._give(min(self._waiting), closing=True)
        if self._sparse:
            self._sink.chunk(self._next * self._size, 0, {}, self._messages(None))

    def _join(self, first: int) -> None:
        """Begin no earlier than with the piece after a sample."""
        self._next = max(self._next, -(-first // self._size))
        self.first = self._next * self._size
        self._waiting = {piece: parts for piece, parts in self._waiting.items() if piece >= self._next}

    def _hand_on(self) -> None:
        """Hand on what nothing more can come for, and what has waited long enough."""
        complete = min(self._ends.get(topic, 0) for topic in self._types) // self._size
        while self._waiting and ((oldest := min(self._waiting)) < complete or len(self._waiting) > _AHEAD):
            self._give(oldest)

    def _give(self, piece: int, *, closing: bool = False) -> None:
        whole = {topic: part for topic, part in self._waiting.pop(piece).items() if not part.broken}
        samples = max((part.end for part in whole.values()), default=0)
        dense = {
            topic: {name: array[:samples] for name, array in part.signals.items()}
            for topic, part in whole.items()
            if part.end == samples
        }
        cut = samples < self._size and not (closing and not self._waiting)  # only the last may be short
        self.lost += piece - self._next + (cut or len(dense) < len(self._types))
        self._next, self._begun = piece + 1, True
        if samples:
            self._sink.chunk(piece * self._size, samples, dense, self._messages(piece * self._size + samples))

    def _messages(self, end: int | None) -> dict[str, list[Sparse]]:
        """Those up to a sample, by topic; None: all."""
        taken: dict[str, list[Sparse]] = {}
        left = []
        for message in self._sparse:
            if end is None or message.index < end:
                taken.setdefault(full(message.topic), []).append(message)
            else:
                left.append(message)
        self._sparse = left
        return taken
