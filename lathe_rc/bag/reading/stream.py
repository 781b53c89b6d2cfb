# SPDX-License-Identifier: Apache-2.0
"""Streaming of a bag in chunks: its signals are passed to sinks as in an offline run, with as little memory."""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from lathe_rc import messages
from lathe_rc.bag.loss import Loss
from lathe_rc.bag.reading.chunk_messages import Places
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.storage import Batch
from lathe_rc.bag.snapshot import span_of
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.ports import Sparse
from lathe_rc.blocks.wire import Decoder
from lathe_rc.cell.engine import Sink
from lathe_rc.errors import LatheError, shown
from lathe_rc.messages import START_NS, Signals

_AHEAD = 2**22  # samples that one topic may be ahead of another
_MOST_WAITING = 2**18  # messages of a sparse topic that may be waiting for blocks
_ENDLESS = 2**64  # end of the samples where no member was lost
ALL = 2**63  #: piece of `feed` with which a sink receives the whole bag as one chunk [samples]


@dataclass(frozen=True)
class BagHeader:
    """Header of a cell's bag, available once the bag has been read.

    Attributes:
        types: message type by fully qualified signal topic.
        samples: index after the last sample that all dense topics have; equals the sample count, except in a snapshot.
        left: number of samples that some topics have beyond `samples` after an interrupted recording; otherwise 0.
        step_ns: sampling step [ns]; 0 if the bag has no dense topic.
        run_id: ID of the run.
        about: strings from the bag's metadata.
        loss: loss of a member, at which reading has ended; None: the bag was read to its end.
    """

    types: Mapping[str, str]
    samples: int
    left: int
    step_ns: int
    run_id: str
    about: Mapping[str, str]
    loss: Loss | None = None


def check_next(topic: str, block: Block, end: int, step_ns: int) -> None:
    """Reject a block that does not continue the previous one, which ends before sample ``end``.

    Args:
        topic: topic of the block.
        block: the decoded block.
        end: expected index of the block's first sample.
        step_ns: sampling step so far [ns]; 0 if any step is accepted.

    Raises:
        LatheError: samples are missing or repeated, or the step changes.
    """
    if block.first_index != end:
        raise LatheError(f"{topic} goes from sample {end} to {block.first_index}; allowed: every sample, once")
    if step_ns not in (0, block.step_ns):
        raise LatheError(f"{topic}: the step changes from {step_ns} to {block.step_ns} ns at sample {end}")


class _Dense:
    """Blocks of a topic that have not been passed on yet, starting at sample ``first``."""

    def __init__(self, topic: str, msgtype: str, first: int = 0, stop: int = _ENDLESS) -> None:
        self.topic, self.type = topic, msgtype
        self.blocks: deque[Block] = deque()
        self.first = self.end = first
        self._stop = stop
        self.newest: Block | None = None
        self._decoder = Decoder(msgtype)

    def read(self, whole: bytes, places: Places) -> None:
        """Decode messages in ``whole``, given the start and end of each, shape (messages, 2).

        Raises:
            LatheError: samples are missing or repeated, or a block cannot be decoded.
        """
        # Blocks after a loss may be those of a bad sender: decoded one by one, up to the loss.
        together = [places] if self._stop == _ENDLESS else [places[k : k + 1] for k in range(len(places))]
        try:
            for some in together:
                if self.end < self._stop:
                    for block, _ in self._decoder.decode_all(whole, some):
                        self._append(block)
        except ValueError as error:
            raise LatheError(f"{self.topic}: {shown(error)}") from None

    def _append(self, block: Block) -> None:
        if self.newest is None and block.first_index < self.end:  # before the first sample that all topics have
            if block.first_index + block.samples <= self.end:
                return
            self.end = block.first_index
        check_next(self.topic, block, self.end, self.newest.step_ns if self.newest else 0)
        self.end += block.samples
        self.newest = block
        self.blocks.append(block)

    def take(self, samples: int) -> Signals:
        """Return the next samples as newly allocated arrays."""
        signals = messages.allocate(self.type, samples)
        self.take_into(signals)
        return signals

    def take_into(self, signals: Signals) -> None:
        """Fill arrays of shape (samples,) with the next samples."""
        filled, samples = 0, next(iter(signals.values())).size
        while filled < samples:
            block = self.blocks[0]
            skip = self.first - block.first_index
            count = min(block.samples - skip, samples - filled)
            for name, array in signals.items():
                array[filled : filled + count] = block.signals[name][skip : skip + count]
            filled += count
            self.first += count
            if skip + count == block.samples:
                self.blocks.popleft()


class Feeder:
    """Assembler of chunks from the messages of signal topics, for recorded bags and live topics.

    Args:
        types: message type by fully qualified topic; topics other than signal topics are ignored.
        sinks: sinks that receive the chunks.
        piece: samples per chunk.
        first: index of the first sample of all topics.
        loss: loss of a member, at which the chunks end.

    Attributes:
        types: message type by fully qualified signal topic.
        first: index of the first sample that has not been passed on.
    """

    def __init__(
        self, types: Mapping[str, str], sinks: Iterable[Sink], piece: int, first: int = 0, loss: Loss | None = None
    ) -> None:
        self.types = {topic: msgtype for topic, msgtype in types.items() if msgtype in messages.signal_types()}
        self._end = loss.first if loss else _ENDLESS
        self._dense = {
            topic: _Dense(topic, kind, first, self._end)
            for topic, kind in self.types.items()
            if kind in messages.block_types()
        }
        self._sparse: dict[str, list[tuple[int, Mapping[str, Any]]]] = {
            topic: [] for topic in self.types if topic not in self._dense
        }
        self._sinks, self._piece, self.first = list(sinks), piece, first

    @property
    def step_ns(self) -> int:
        """Sampling step [ns]; 0 before the first block."""
        return next((dense.newest.step_ns for dense in self._dense.values() if dense.newest), 0)

    @property
    def run_id(self) -> str:
        """ID of the run; empty before the first block."""
        return next((dense.newest.run_id for dense in self._dense.values() if dense.newest), "")

    def add(self, batch: Batch) -> None:
        """Add messages in order of log time, and pass on the chunks that they complete.

        Raises:
            LatheError: samples are missing, or a topic stalls while others continue.
        """
        if not self._dense:
            return  # without blocks there are no chunks in which to pass on the messages
        for topic in dict.fromkeys(batch.topics.values()):
            if topic not in self.types:
                continue
            found = batch.only({topic})
            if dense := self._dense.get(topic):
                dense.read(batch.whole, found.places[:, 2:])
            else:
                self._sparse[topic].extend(self._values(*message) for message in found)
        self._hand_on(self._piece)

    def _values(self, topic: str, log_ns: int, data: bytes) -> tuple[int, Mapping[str, Any]]:
        try:
            return log_ns, messages.values_of(self.types[topic], data)
        except ValueError as error:
            raise LatheError(f"{topic}: at {log_ns} ns: {shown(error)}") from None

    def _ends(self) -> dict[str, int]:
        """Return the sample after the last one to pass on, by topic."""
        return {topic: min(dense.end, self._end) for topic, dense in self._dense.items()}

    def _hand_on(self, samples: int) -> None:
        ends = self._ends()
        while (ready := min(ends.values())) - self.first >= samples:
            self._give(samples)
        slow = min(ends, key=lambda topic: ends[topic])
        if max(ends.values()) - ready > _AHEAD:
            raise LatheError(f"{slow} ends at sample {ready}, others at {max(ends.values())}")
        ready_ns = START_NS + ready * self.step_ns
        for topic, waiting in self._sparse.items():
            if len(waiting) > _MOST_WAITING and waiting[-_MOST_WAITING][0] > ready_ns:
                raise LatheError(f"{topic}: more than {_MOST_WAITING} messages without the blocks of their time")

    def _give(self, samples: int) -> None:
        end_ns = START_NS + (self.first + samples) * self.step_ns
        pieces = {topic: dense.take(samples) for topic, dense in self._dense.items()}
        sparse: dict[str, list[Sparse]] = {}
        for topic, waiting in self._sparse.items():
            count = next((k for k, (stamp, _) in enumerate(waiting) if stamp >= end_ns), len(waiting))
            sparse[topic] = [
                Sparse(topic, self.types[topic], (stamp - START_NS) // self.step_ns, dict(values))
                for stamp, values in waiting[:count]
                if stamp >= START_NS + self.first * self.step_ns  # none before the first sample of a late recording
            ]
            del waiting[:count]
        for sink in self._sinks:
            sink.chunk(self.first, samples, pieces, sparse)
        self.first += samples

    def finish(self) -> int:
        """Pass the remaining samples to the sinks.

        Returns:
            Number of samples that some topics have beyond the others; 0 if the recording is complete.
        """
        if not self._dense:
            return 0
        ends = self._ends().values()
        while min(ends) - self.first > self._piece:
            self._give(self._piece)
        if min(ends) > self.first:
            self._give(min(ends) - self.first)
        return max(ends) - min(ends)


class SampleReader:
    """On-demand reader of a dense topic in a bag.

    Args:
        source: the bag; must stay open while the topic is read.
        topic: fully qualified topic.
        first: index of the first sample to read.
    """

    def __init__(self, source: BagSource, topic: str, first: int = 0) -> None:
        self._dense = _Dense(topic, source.topics[topic].type, first)
        self._batches = source.batches({topic})

    def take(self, samples: int) -> Signals:
        """Return the next samples as arrays of shape (samples,); see `take_into`."""
        signals = messages.allocate(self._dense.type, samples)
        self.take_into(signals)
        return signals

    def take_into(self, signals: Signals) -> None:
        """Fill arrays of shape (samples,) with the next samples.

        Raises:
            LatheError: fewer samples are left, or some are missing.
        """
        samples = next(iter(signals.values())).size
        while self._dense.end - self._dense.first < samples:
            found = next(self._batches, None)
            if found is None:
                raise LatheError(f"{self._dense.topic} ends at sample {self._dense.end}")
            self._dense.read(found.whole, found.places[:, 2:])
        self._dense.take_into(signals)


class From:
    """Sink that passes the samples and messages from a sample on to another sink.

    Args:
        sink: the other sink.
        first: index of the first sample that it receives.
    """

    def __init__(self, sink: Sink, first: int) -> None:
        self._sink, self._first = sink, first

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Pass on the part of a chunk that is due (implements `lathe_rc.cell.engine.Sink`)."""
        left = max(self._first - first, 0)
        if left < samples:
            late = {topic: {name: array[left:] for name, array in part.items()} for topic, part in dense.items()}
            told = {topic: [each for each in found if each.index >= self._first] for topic, found in sparse.items()}
            self._sink.chunk(first + left, samples - left, late, told)


def first_of(source: BagSource) -> int:
    """Return the first sample of all dense topics: not 0 in a snapshot, or if the recorder joined a running cell.

    It is that of the loss in a bag that only has samples from the loss of a member on.

    Raises:
        InputError: the bag is damaged at the first block of a topic.
        LatheError: this block cannot be decoded.
    """
    if span := span_of(source.about):
        return span[0]
    dense = [topic for topic, each in source.topics.items() if each.type in messages.block_types()]
    nothing = source.loss.first if source.loss else 0
    return max((block.first_index for topic in dense for block in islice(source.blocks(topic), 1)), default=nothing)


def feed(path: Path, sinks: Iterable[Sink], *, piece: int = 65536, whole: bool = False) -> BagHeader:
    """Read a cell's bag and pass its signals to sinks, in chunks.

    If members of the cell were lost, reading ends there: later samples are held, or may rest on held ones.

    Args:
        path: path of the bag.
        sinks: sinks that receive every sample once, in order; topics are fully qualified.
        piece: samples per chunk; the last chunk may be shorter.
        whole: whether reading continues after the loss of a member.

    Raises:
        InputError: the path is not a bag.
        LatheError: samples are missing or repeated.
    """
    with BagSource(path, whole=whole) as source:
        types = {topic: kind.type for topic, kind in source.topics.items()}
        loss = source.loss
        feeder = Feeder(types, sinks, piece, first_of(source), loss)
        for batch in source.batches(set(feeder.types)):
            try:
                feeder.add(batch)
            except LatheError as error:
                raise type(error)(f"{path}: {error}") from None
        left = feeder.finish()
        return BagHeader(feeder.types, feeder.first, left, feeder.step_ns, feeder.run_id, dict(source.about), loss)
