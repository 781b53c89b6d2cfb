# SPDX-License-Identifier: Apache-2.0
"""Bag order of signal messages: by log time, then topic, then index, independent of the order of arrival."""

from collections import Counter
from collections.abc import Collection, Mapping
from typing import NamedTuple

from lathe_rc.bag.writing.rows import Dense, Plan, RowBuffer
from lathe_rc.bag.writing.writer import MessageSink
from lathe_rc.blocks.block import Block
from lathe_rc.errors import LatheError
from lathe_rc.messages import START_NS, Samples, Signals

_BUFFER = 2**22  # size of a buffer, unless a single row is larger [B]


class _Single(NamedTuple):
    """Message at a single sample, or a block outside its row; sorts in bag order."""

    log_ns: int
    topic: str
    sequence: int
    data: bytes


class Merger:
    """Merger of all signal topics into bag order.

    A row of blocks is written once every dense topic has delivered its block and every source has delivered its sparse
    messages up to the end of the row; each block states how many there are. No message with an earlier time can follow
    after that. The arrival of later messages is not a sufficient criterion, because a source publishes on several
    topics, and DDS preserves the order within a topic, but not between topics.

    Args:
        writer: output to one or more bags, to which the topics have been added.
        dense: message type and source by fully qualified dense topic.
        sparse: source by fully qualified sparse topic.
        run_id: ID of the run.
        step_ns: sampling step [ns].
        samples: samples per block; the last block may be shorter.
        first: index of the first sample.

    Attributes:
        rows: number of rows written so far.
        samples: number of samples written so far, per dense topic.
        log_ns: time of the last sample written [ns].
        complete: whether the last block of every topic has been written.
    """

    def __init__(
        self,
        writer: MessageSink,
        dense: Mapping[str, tuple[str, str]],
        sparse: Mapping[str, str],
        *,
        run_id: str,
        step_ns: int,
        samples: int,
        first: int = 0,
    ) -> None:
        self._first, self._start_ns = first, START_NS + first * step_ns
        self._writer, self._run_id, self._step_ns, self._length = writer, run_id, step_ns, samples
        self._topics = [Dense(topic, *dense[topic], writer.channel(topic)) for topic in sorted(dense)]
        self._places = {each.topic: place for place, each in enumerate(self._topics)}
        self._ends = [0] * len(self._topics)  # number of rows delivered by each topic
        self._late = len(self._topics)  # number of topics that have not delivered the next row
        self._final: int | None = None  # index of the last row
        self._finals = 0  # number of topics that have delivered the last row
        self._plan = Plan(self._topics, run_id, step_ns, samples)
        self._buffer_rows = max(_BUFFER // self._plan.rows.size, 1)  # rows per buffer
        self._buffers: dict[int, RowBuffer] = {}  # by buffer number
        self._free: list[RowBuffer] = []
        self._tail: RowBuffer | None = None  # the last row, if it is shorter
        self._sparse = sparse
        self._repeats: Counter[tuple[str, int, bytes]] = Counter()
        self._sequence = dict.fromkeys(sparse, 0)
        self._written: Counter[str] = Counter()  # number of sparse messages written, by source
        self._needs: list[tuple[int, str, int]] = []  # row, source, and messages it has sent up to the row's end
        self._waiting: list[_Single] = []
        self._lost: set[str] = set()  # lost sources
        self.rows = self.samples = 0
        self.log_ns = START_NS
        self.complete = False

    # ---- input ---------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Return whether all topics have delivered the next row, so that `release` may write it."""
        return not self._late

    def add_block(self, topic: str, block: Block, data: bytes | None = None) -> None:
        """Add a block.

        Args:
            topic: fully qualified topic.
            block: the decoded block.
            data: serialized message of the block, if there is one.

        Raises:
            LatheError: the block belongs to another run, or the topics are divided into different blocks.
        """
        place = self._places[topic]
        if block.run_id != self._run_id:
            raise LatheError(f"{topic}: block of run {block.run_id!r} from {block.source}; expected {self._run_id!r}")
        row = self._check(place, block.first_index, block.samples, last=block.last)
        buffer, within = self._find(row, block.samples)
        buffer.put(place, within, block, data)
        source = self._topics[place].source
        if block.companions > self._written[source] and source not in self._lost:
            self._needs.append((row, source, block.companions))
        self._brought(place, row + 1)

    def add_blocks(self, topic: str, first: int, signals: Signals, companions: Samples, *, last: bool) -> None:
        """Add consecutive blocks whose sparse messages have all been added.

        Args:
            topic: fully qualified topic.
            first: index of the first sample.
            signals: arrays of shape (n,) by field name.
            companions: number of sparse messages stated by each block, shape (blocks,).
            last: whether the run ends with these blocks.

        Raises:
            LatheError: see `add_block`.
        """
        place, samples, done = self._places[topic], next(iter(signals.values())).size, 0
        while done < samples:
            length = min(self._length, samples - done)
            row = self._check(place, first + done, length, last=last and done + length == samples)
            buffer, within = self._find(row, length)
            count = min((samples - done) // length, len(buffer.bytes) - within)
            stop = done + count * length
            if last and stop == samples and count > 1:
                self._end(place, row + count - 1)
            part = {name: array[done:stop] for name, array in signals.items()}
            numbers = companions[done // self._length :][:count]
            buffer.put_many(place, within, part, numbers, last=last and stop == samples)
            self._brought(place, row + count)
            done = stop

    def add_sparse(self, topic: str, log_ns: int, data: bytes) -> None:
        """Add a sparse message."""
        # A restarted node republishes its newest messages; duplicates of waiting messages are dropped.
        if self._repeats[topic, log_ns, data]:
            self._repeats[topic, log_ns, data] -= 1
            return
        self._sequence[topic] += 1
        self._waiting.append(_Single(log_ns, topic, self._sequence[topic], data))

    def restarted(self, source: str) -> None:
        """Register the restart of a source, whose waiting sparse messages will arrive a second time."""
        self._repeats |= Counter(
            (each.topic, each.log_ns, each.data) for each in self._waiting if self._sparse[each.topic] == source
        )

    def forget(self, sources: Collection[str]) -> None:
        """Stop waiting for sparse messages from lost sources."""
        self._lost.update(sources)
        self._needs = [need for need in self._needs if need[1] not in sources]

    def _lacks(self, row: int, source: str, messages: int) -> bool:
        """Return whether sparse messages from a source, up to the end of a row, are still missing."""
        end_ns = self._start_ns + (row + 1) * self._length * self._step_ns
        came = sum(each.log_ns < end_ns and self._sparse[each.topic] == source for each in self._waiting)
        return self._written[source] + came < messages

    def _check(self, place: int, first: int, samples: int, *, last: bool) -> int:
        """Return the row of a topic's next block, after checking that the block fits this row."""
        row = self._ends[place]
        short = samples != self._length and not (last and (self._tail is None or self._tail.plan.samples == samples))
        expected = self._first + row * self._length
        if first != expected or short or (self._final is not None and row > self._final):
            raise LatheError(
                f"topics are not cut into the same blocks: {self._topics[place].topic} brings {samples} samples "
                f"from {first}; expected {self._length} from {expected}, fewer only at the end of the run"
            )
        if last:
            self._end(place, row)
        return row

    def _end(self, place: int, row: int) -> None:
        if self._final not in (None, row) or any(end > row + 1 for end in self._ends):
            raise LatheError(
                f"topics are not cut into the same blocks: {self._topics[place].topic} ends with block {row}, "
                "others elsewhere"
            )
        self._final = row
        self._finals += 1

    def _brought(self, place: int, end: int) -> None:
        # Only a topic that has not yet delivered the next row can complete it, so callers need not check all topics for
        # each block.
        if self._ends[place] == self.rows:
            self._late -= 1
        self._ends[place] = end

    def _find(self, row: int, samples: int) -> tuple[RowBuffer, int]:
        """Return the buffer of a row, and the row's index in this buffer."""
        if samples != self._length:
            if self._tail is None:
                self._tail = RowBuffer(Plan(self._topics, self._run_id, self._step_ns, samples), 1)
                self._tail.begin(self._first + row * self._length)
            return self._tail, 0
        number, within = divmod(row, self._buffer_rows)
        buffer = self._buffers.get(number)
        if buffer is None:
            buffer = self._free.pop() if self._free else RowBuffer(self._plan, self._buffer_rows)
            self._buffers[number] = buffer
            buffer.begin(self._first + number * self._buffer_rows * self._length)
        return buffer, within

    # ---- output --------------------------------------------------------------------------------------

    def _at(self, row: int) -> tuple[RowBuffer, int]:
        """Return the buffer and index of a row whose blocks have been received."""
        return self._find(row, self._length if row != self._final or self._tail is None else self._tail.plan.samples)

    def release(self) -> None:
        """Write all complete rows.

        Raises:
            LatheError: the topics do not all end with the same block, or writing to the disk fails.
        """
        ready = min(self._ends)
        if self._needs:
            self._needs = [need for need in self._needs if self._lacks(*need)]
            ready = min([ready, *(row for row, _, _ in self._needs)])
        if self._final is not None and ready > self._final and self._finals < len(self._topics):
            raise LatheError("topics are not cut into the same blocks: not all end with the same one (`last`)")
        while self.rows < ready:
            self._write(*self._at(self.rows), self._together(ready))
        self._late = sum(end == ready for end in self._ends)

    def _together(self, ready: int) -> int:
        """Return the end of the rows to write at once: rows of one buffer with no sparse message between them."""
        end = min(ready, (self.rows // self._buffer_rows + 1) * self._buffer_rows)
        # The short last row has a buffer of its own, because its byte layout differs.
        if self._tail is not None and self.rows != self._final and end > (self._final or 0):
            end -= 1
        if self._waiting:
            earliest = min(single.log_ns for single in self._waiting)
            end = min(end, (earliest - self._start_ns) // self._step_ns // self._length)
        return max(end, self.rows + 1)

    def _write(self, buffer: RowBuffer, within: int, end: int) -> None:
        """Write rows of one buffer up to row ``end``, after the sparse messages due before the first row."""
        first = self.rows
        first_ns = self._start_ns + (first * self._length + buffer.plan.samples - 1) * self._step_ns
        due = sorted(single for single in self._waiting if single.log_ns <= first_ns) if self._waiting else []
        if due:
            self._waiting = [single for single in self._waiting if single.log_ns > first_ns]
            self._written.update(self._sparse[single.topic] for single in due)
        if due and due[-1].log_ns == first_ns:
            # Messages with equal times are ordered by topic, so this row must be split into its messages.
            due += [_Single(first_ns, each.topic, 0, buffer.message(k, within)) for k, each in enumerate(self._topics)]
            first += 1
        for single in sorted(due):
            self._writer.write(single.topic, single.log_ns, single.data)
        if first < end:
            skip = first - self.rows
            data = buffer.bytes[within + skip : within + end - self.rows].reshape(-1).data
            self._writer.write_rows(buffer.plan.rows, first_ns + skip * buffer.plan.rows.period_ns, data)
        self.rows, self.samples = end, (end - 1) * self._length + buffer.plan.samples
        self.log_ns = self._start_ns + (self.samples - 1) * self._step_ns
        self.complete = self._final is not None and end > self._final
        # A used buffer already has its template and step; a new one would cost a copy of the template for each row.
        if end % self._buffer_rows == 0 and buffer is not self._tail:
            self._free.append(self._buffers.pop(end // self._buffer_rows - 1))

    def write_rest(self) -> None:
        """Write all remaining messages in bag order, such as the last blocks of an interrupted run.

        Raises:
            LatheError: writing to the disk fails.
        """
        left, self._waiting = self._waiting, []
        for place, end in enumerate(self._ends):
            for row in range(self.rows, end):
                buffer, within = self._at(row)
                stamp = self._start_ns + (row * self._length + buffer.plan.samples - 1) * self._step_ns
                left.append(_Single(stamp, self._topics[place].topic, 0, buffer.message(place, within)))
        for single in sorted(left):
            self._writer.write(single.topic, single.log_ns, single.data)
