# SPDX-License-Identifier: Apache-2.0
"""In-memory buffer of the last seconds of a run, written to a snapshot bag at every trigger.

All times are sample indices, and a snapshot consists of complete rows of blocks. The content of a snapshot therefore
depends only on its triggers, and its messages equal those of the same samples in a recording of the whole run.
"""

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import Qos

from lathe_rc import messages
from lathe_rc.bag.snapshot import Snapshot
from lathe_rc.bag.writing.rows import Dense, Plan, RowPlan
from lathe_rc.bag.writing.writer import BagWriter, refuse_existing
from lathe_rc.cell.recorder import RecorderParameters
from lathe_rc.errors import InputError, LatheError, at_most
from lathe_rc.messages import START_NS
from lathe_rc.names import instead

_CATCH_UP = 4  # buffered messages or rows written to disk per incoming one, until a snapshot has caught up
_SPARE_ROWS = 2  # rows kept beyond the pre-trigger time: a trigger may lie in the row before the newest
_IN_FLIGHT = 16  # further rows that may be in memory, since rows arrive several at a time
_HEARD = (messages.EVENT, messages.SAFETY_STATUS)  # message types that may contain a trigger


class _Item(NamedTuple):
    """Buffered item: a message of a topic, or a row of blocks."""

    log_ns: int
    key: str | RowPlan
    data: bytes | memoryview


class Snapshots:
    """Buffer of the latest messages, written to a bag at every trigger; a `MessageSink` that expects bag order.

    A trigger whose pre-trigger time overlaps or touches the newest snapshot extends that snapshot, so no sample is
    written twice, and at most one bag is open. A snapshot is closed as soon as no trigger can extend it any more.

    Args:
        folder: folder of the snapshot bags; must not exist yet.
        table: parameters of the recorder.
        name: name of the recorder.
        namespace: namespace of the cell, ending with a slash; removed from node names.
        told: callback for each snapshot, when it is opened and again when it is closed.

    Attributes:
        folder: folder of the snapshot bags.
        bags: number of bags closed so far.
        held: total size of the buffered messages [B].

    Raises:
        InputError: the folder exists.
    """

    def __init__(
        self,
        folder: Path,
        table: RecorderParameters,
        *,
        name: str,
        namespace: str = "/",
        told: Callable[[Snapshot], None] = lambda _: None,
    ) -> None:
        refuse_existing(folder)
        self.folder, self._table, self._name, self._namespace, self._told = folder, table, name, namespace, told
        self._pre, self._post = (math.ceil(round(s * table.sample_rate, 6)) for s in (table.pre, table.post))
        self._margin_ns = (self._pre + _SPARE_ROWS * table.block_size) * table.step_ns
        self._about: dict[str, str] = {}
        self._topics: dict[str, tuple[str, Qos]] = {}
        self._latched: dict[str, bytes | memoryview] = {}  # newest latched message that has left the buffer, by topic
        self._kept: deque[_Item] = deque()  # already written to an open snapshot, or not needed by it
        self._waiting: deque[_Item] = deque()  # not yet written to an open snapshot
        self._open: tuple[Snapshot, BagWriter] | None = None
        self._newest_ns = self._flushed_ns = START_NS - table.step_ns
        self._interrupted = False
        self.bags = 0
        self.held = 0

    # ---- before the start ---------------------------------------------------------------------------

    def prepare(self, dense: Mapping[str, tuple[str, str]], nodes: Collection[str]) -> int:
        """Check that snapshots of a cell are possible, and create their folder.

        Args:
            dense: message type and source by fully qualified dense topic.
            nodes: node names that triggers may refer to.

        Returns:
            Memory needed for the pre-trigger time [B].

        Raises:
            InputError: the memory exceeds the limit in the table, a trigger names an unknown node, or the folder cannot
                be created.
        """
        self._check_triggers(nodes)
        needed = self._needed(dense)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be made ({error.strerror})") from None
        return needed

    def _needed(self, dense: Mapping[str, tuple[str, str]]) -> int:
        table = self._table
        topics = [Dense(topic, *dense[topic], 0) for topic in sorted(dense)]
        row = Plan(topics, table.run_id, table.step_ns, table.block_size).template.size
        rows = -(-self._pre // table.block_size) + _SPARE_ROWS + _IN_FLIGHT
        if rows * row > table.memory:
            most = (table.memory // row - _SPARE_ROWS - _IN_FLIGHT) * table.block_size * table.step
            allowed = f"allows pre = {at_most(most, 3)} s: shorten pre or raise memory"
            if most < 0.0:
                allowed = f"allows none: raise memory to {(_SPARE_ROWS + _IN_FLIGHT) * row} B or more"
            raise InputError(
                f"{self._name}.pre = {table.pre:g} s takes {rows * row} B of memory, {row} B for {table.block_size} "
                f"samples of all topics; {self._name}.memory = {table.memory} B {allowed}"
            )
        return rows * row

    def _check_triggers(self, nodes: Collection[str]) -> None:
        for pattern in self._table.triggers:
            node, colon, _ = pattern.partition(": ")
            if colon and not any(fnmatchcase(name, node) for name in nodes):
                known = instead(node, sorted(nodes))
                raise InputError(f"{self._name}.triggers = {pattern!r}: no node {node!r} in the cell; {known}")

    # ---- input ---------------------------------------------------------------------------------------

    def tell(self, about: Mapping[str, str]) -> None:
        """Store strings for the metadata of every snapshot bag."""
        self._about.update(about)
        if self._open is not None:
            self._open[1].tell(about)

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a topic to every snapshot bag."""
        self._topics[topic] = msgtype, qos
        if self._open is not None:
            self._open[1].add_topic(topic, msgtype, qos)

    def channel(self, topic: str) -> int:
        """Return the channel number of a topic; the channels of a file are numbered from 1."""
        return list(self._topics).index(topic) + 1

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Buffer a message; an event or an alarm may trigger a snapshot.

        Raises:
            LatheError: writing to the disk fails, or the buffer exceeds its limit.
        """
        self._take(_Item(log_ns, topic, data))
        if self._table.triggers and self._topics[topic][0] in _HEARD:
            self._hear(topic, data)

    def write_rows(self, plan: RowPlan, first_ns: int, data: bytes | memoryview) -> None:
        """Buffer rows of blocks.

        Raises:
            LatheError: writing to the disk fails, or the buffer exceeds its limit.
        """
        # All rows are copied at once: the caller reuses its memory, and the rows stay in the buffer for some seconds.
        whole = memoryview(bytes(data))
        for row, start in enumerate(range(0, len(data), plan.size)):
            self._take(_Item(first_ns + row * plan.period_ns, plan, whole[start : start + plan.size]))

    def _hear(self, topic: str, data: bytes) -> None:
        msgtype = self._topics[topic][0]
        try:
            heard = messages.decode(msgtype, data)
        except ValueError as error:
            raise LatheError(f"{topic}: {error}") from None
        what = heard.action if msgtype == messages.EVENT else f"{heard.monitor} {heard.subject}".strip()
        cause = f"{heard.source.removeprefix(self._namespace)}: {what}"
        if any(fnmatchcase(cause, pattern) for pattern in self._table.triggers):
            self.trigger(cause, int(heard.sample_index))

    def _take(self, item: _Item) -> None:
        if not isinstance(item.key, str) or self._topics[item.key][0] in messages.signal_types():
            self._newest_ns = max(self._newest_ns, item.log_ns)
        self.held += len(item.data)
        if self._open is None:
            self._kept.append(item)
        else:
            # Only a few items are written per incoming one: the whole pre-trigger time at once would delay the cell.
            self._waiting.append(item)
            self._catch_up(_CATCH_UP)
            if self._newest_ns > self._stamp(self._open[0].last) + self._margin_ns:
                self._end()
        self._forget()
        if self.held > self._table.memory:
            raise LatheError(
                f"{self._name}: {self.held} B are kept for pre = {self._table.pre:g} s; allowed: memory = "
                f"{self._table.memory} B: shorten pre or raise memory"
            )

    def _forget(self) -> None:
        """Drop buffered items that are too old for any further trigger."""
        oldest_ns = self._newest_ns - self._margin_ns
        while self._kept and self._kept[0].log_ns < oldest_ns:
            item = self._kept.popleft()
            self.held -= len(item.data)
            if isinstance(item.key, str) and self._topics[item.key][0] == messages.CELL_STATE:
                self._latched[item.key] = item.data

    # ---- triggers -----------------------------------------------------------------------------------

    def _stamp(self, sample: int) -> int:
        return START_NS + sample * self._table.step_ns

    @property
    def next_sample(self) -> int:
        """Index of the sample after the newest one received."""
        return (self._newest_ns - START_NS) // self._table.step_ns + 1

    def trigger(self, cause: str, sample: int | None = None) -> Snapshot:
        """Start a snapshot around a sample, or extend the open one.

        Args:
            cause: human-readable cause of the trigger.
            sample: index of the sample; None: the next sample.

        Raises:
            LatheError: the bag cannot be created.
        """
        at, block = self.next_sample if sample is None else sample, self._table.block_size
        first = max(at - self._pre, 0) // block * block
        last = ((at + self._post) // block + 1) * block - 1
        if self._open is not None and first > self._open[0].last + 1:
            self._end()
        if self._open is not None:
            found = self._open[0]
            found.add(at, cause, at + self._post, last)
            return found
        found = Snapshot(self.folder / f"sample_{at:010}", first, last)
        found.add(at, cause, at + self._post, last)
        self._begin(found)
        return found

    def _begin(self, snapshot: Snapshot) -> None:
        table = self._table
        try:
            bag = BagWriter(snapshot.path, compression=table.compression, chunk_size=table.chunk_size, about={})
        except InputError as error:
            raise LatheError(str(error)) from None
        self._open = snapshot, bag
        self._waiting, self._kept = self._kept, self._waiting
        for topic, (msgtype, qos) in self._topics.items():
            bag.add_topic(topic, msgtype, qos)
        bag.tell({**self._about, **snapshot.about()})
        for topic, data in self._latched.items():
            bag.write(topic, self._stamp(snapshot.first), data)
        self._told(snapshot)

    # ---- output --------------------------------------------------------------------------------------

    def _write(self, item: _Item, snapshot: Snapshot, bag: BagWriter) -> None:
        """Write an item if it belongs to a snapshot; an earlier latched message is given the first sample's time."""
        first_ns = self._stamp(snapshot.first)
        if isinstance(item.key, RowPlan):
            if item.log_ns >= first_ns:
                bag.write_rows(item.key, item.log_ns, item.data)
        elif item.log_ns >= first_ns or self._topics[item.key][0] == messages.CELL_STATE:
            bag.write(item.key, max(item.log_ns, first_ns), item.data)

    def _catch_up(self, count: int) -> None:
        """Write at most ``count`` of the items that the open snapshot still lacks."""
        assert self._open is not None, "its callers have looked"
        snapshot, bag = self._open
        last_ns = self._stamp(snapshot.last)
        while count and self._waiting and self._waiting[0].log_ns <= last_ns:
            item = self._waiting.popleft()
            self._kept.append(item)
            self._write(item, snapshot, bag)
            count -= 1

    def _end(self) -> None:
        """Close the open snapshot with the samples available."""
        assert self._open is not None, "its callers have looked"
        (snapshot, bag), self._open = self._open, None
        waiting, self._waiting = self._waiting, deque()
        self._kept.extend(waiting)
        end = min(self.next_sample, snapshot.last + 1)
        snapshot.samples, snapshot.whole = max(end - snapshot.first, 0), end > snapshot.wanted and not self._interrupted
        try:
            for item in waiting:
                if item.log_ns <= self._stamp(snapshot.last):
                    self._write(item, snapshot, bag)
            bag.tell(snapshot.about())
        finally:
            bag.close()
        self.bags += 1
        self._told(snapshot)

    def flush(self) -> None:
        """Hand messages to the operating system, also the buffered ones if none have arrived since the last flush.

        Raises:
            LatheError: writing to the disk fails.
        """
        if self._open is not None:
            if self._newest_ns == self._flushed_ns:
                self._catch_up(len(self._waiting))
            self._open[1].flush()
        self._flushed_ns = self._newest_ns

    def interrupt(self, cause: str) -> None:
        """Trigger a snapshot for an aborted run, if any signal has been received; the snapshot counts as incomplete.

        Raises:
            LatheError: the bag cannot be created.
        """
        if self.next_sample:
            self.trigger(cause)
            self._interrupted = True

    def close(self) -> None:
        """Close the open snapshot, and remove the folder if it is empty.

        Raises:
            LatheError: writing to the disk fails.
        """
        if self._open is not None:
            self._end()
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()
