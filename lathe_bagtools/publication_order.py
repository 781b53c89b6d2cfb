# SPDX-License-Identifier: Apache-2.0
"""Publication order and log times of messages on any topics, independent of their order of arrival.

DDS stamps each message with the wall time of its publication and numbers the messages of each publisher. On one
computer, the stamps of all publishers come from the same clock: messages sorted by stamp are in publication order, and
the simulated time of a message is given by the preceding message on /clock.
"""

import heapq
from collections.abc import Callable, Iterator
from typing import NamedTuple

from lathe_rc.errors import LatheError

MOST_EARLY = 2**28  #: total size of messages that may wait for the first message on /clock [B]


class Recorded(NamedTuple):
    """Message with its log time in the bag.

    Attributes:
        topic: fully qualified topic.
        log_ns: log time [ns].
        data: serialized message.
    """

    topic: str
    log_ns: int
    data: bytes


class Continuity:
    """Counter of the missing messages of a topic.

    Messages are numbered from 1 for each publisher, but do not identify the publisher.

    Args:
        whole: whether reception starts with the first message; otherwise it may start with any message.

    Attributes:
        missing: number of missing messages so far.
        first: sequence number of the first message received; 0 before that.
    """

    def __init__(self, *, whole: bool) -> None:
        self._expected = [1] if whole else []  # next sequence number of each publisher
        self.missing = self.first = 0

    def take(self, sequence: int, publishers: Callable[[], int]) -> None:
        """Register the sequence number of the next message; the numbers of one publisher increase.

        Args:
            sequence: sequence number of the message.
            publishers: function that returns the current number of publishers; called only for an unexpected number.
        """
        expected = self._expected
        self.first = self.first or sequence
        if sequence not in expected:
            below = [number for number in expected if number < sequence]
            if not below or len(expected) < publishers():
                expected.append(sequence)
            else:
                nearest = max(below)
                self.missing += sequence - nearest
                expected[expected.index(nearest)] = sequence
        expected[expected.index(sequence)] = sequence + 1


class _Held(NamedTuple):
    """Message waiting for its turn; sorts by publication time, with /clock first among equal stamps."""

    source_ns: int
    topic: str  # empty for /clock
    sequence: int
    data: bytes
    time_ns: int  # simulated time given by /clock


class PublicationOrder:
    """Buffer that holds messages until no earlier publication can still arrive, and returns them in order.

    Args:
        hold_ns: longest delay with which a message may arrive after one that was published later [ns].
        sim_time: whether log times are those on /clock; otherwise they are the wall times of publication.
        began_ns: wall time of the start of the recording [ns]; older messages were latched.

    Attributes:
        newest_ns: latest publication time so far [ns]; 0 before the first message.
        late: number of messages that arrived too late for their place in the order; they follow those already returned.
        left_out: number of messages without a simulated time, because they were published after the start of the
            recording, but before the first message received from a /clock that was already running.
    """

    def __init__(self, *, hold_ns: int, sim_time: bool, began_ns: int) -> None:
        self._hold_ns, self._sim_time, self._began_ns = hold_ns, sim_time, began_ns
        self._heap: list[_Held] = []
        self._given_ns = self._log_ns = 0
        self._time_ns: int | None = None
        self._waiting: list[_Held] = []  # for the first message on /clock
        self._waiting_bytes = 0
        self.newest_ns = self.late = self.left_out = 0

    def add(self, topic: str, source_ns: int, sequence: int, data: bytes) -> None:
        """Add a message that its publisher sent at ``source_ns`` with sequence number ``sequence``."""
        self._hold(_Held(source_ns, topic, sequence, data, 0))

    def add_clock(self, source_ns: int, sequence: int, time_ns: int) -> None:
        """Add a message from /clock with the simulated time ``time_ns``."""
        self._hold(_Held(source_ns, "", sequence, b"", time_ns))

    def _hold(self, held: _Held) -> None:
        self.newest_ns = max(self.newest_ns, held.source_ns)
        heapq.heappush(self._heap, held)

    def release(self, seen_ns: int) -> Iterator[Recorded]:
        """Yield the messages that are ready, in publication order.

        Args:
            seen_ns: publication time of a message [ns]; all messages that arrived before it must have been added.

        Raises:
            LatheError: /clock goes backwards, or too many messages wait for it.
        """
        while self._heap and self._heap[0].source_ns < seen_ns - self._hold_ns:
            yield from self._give(heapq.heappop(self._heap))

    def rest(self) -> Iterator[Recorded]:
        """Yield the remaining messages in order, once no earlier publication can still arrive.

        Raises:
            LatheError: see `release`.
        """
        return self.release(self.newest_ns + self._hold_ns + 1)

    def finish(self) -> None:
        """Check at the end of the recording, after `rest`, that no message is still waiting for /clock.

        Raises:
            LatheError: messages are waiting, and no message on /clock was received.
        """
        if self._waiting:
            raise LatheError(f"/clock told no time: {len(self._waiting)} messages are not recorded")

    def _give(self, held: _Held) -> Iterator[Recorded]:
        if held.source_ns < self._given_ns:
            self.late += 1
            if not held.topic:  # time on /clock has already advanced
                return
        self._given_ns = max(self._given_ns, held.source_ns)
        if not self._sim_time:
            self._log_ns = max(self._log_ns, held.source_ns)
            yield Recorded(held.topic, self._log_ns, held.data)
        elif not held.topic:
            yield from self._tick(held)
        elif self._time_ns is not None:
            yield Recorded(held.topic, self._time_ns, held.data)
        else:
            self._wait(held)

    def _tick(self, clock: _Held) -> Iterator[Recorded]:
        if self._time_ns is not None and clock.time_ns < self._time_ns:
            raise LatheError(
                f"/clock goes back from {self._time_ns * 1e-9:.9f} to {clock.time_ns * 1e-9:.9f} s: a bag holds one run"
            )
        self._time_ns = clock.time_ns
        for held in self._waiting:
            if clock.sequence == 1 or held.source_ns < self._began_ns:
                yield Recorded(held.topic, clock.time_ns, held.data)
            else:
                self.left_out += 1
        self._waiting.clear()

    def _wait(self, held: _Held) -> None:
        self._waiting.append(held)
        self._waiting_bytes += len(held.data)
        if self._waiting_bytes > MOST_EARLY:
            raise LatheError(f"more than {MOST_EARLY} B of messages wait for a time on /clock")
