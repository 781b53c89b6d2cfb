# SPDX-License-Identifier: Apache-2.0
"""The order in which messages of any topics were published, whatever order they arrived in, and their log times.

DDS stamps a message with the wall time at which it was published and numbers the messages of each publisher. On one
machine the stamps of all publishers come from one clock: sorted by them, messages stand in the order of publication,
and the message on /clock that stands before one tells its simulated time.
"""

import heapq
from collections.abc import Callable, Iterator
from typing import NamedTuple

from lathe_rc.errors import LatheError

MOST_EARLY = 2**28  #: messages that may wait for the first one on /clock [B]


class Recorded(NamedTuple):
    """A message as it stands in the bag.

    Attributes:
        topic: fully qualified.
        log_ns: log time [ns].
        data: its bytes.
    """

    topic: str
    log_ns: int
    data: bytes


class Continuity:
    """Counts the messages of a topic that are missing.

    A message has a number, from 1 on for each publisher, and does not say which of them sent it.

    Args:
        whole: it is heard from the first message on; otherwise from wherever it stands.

    Attributes:
        missing: messages so far.
        first: number of the first message that was heard; 0 before it.
    """

    def __init__(self, *, whole: bool) -> None:
        self._expected = [1] if whole else []  # the next number of each publisher
        self.missing = self.first = 0

    def take(self, sequence: int, publishers: Callable[[], int]) -> None:
        """Take the number of the next message; those of one publisher rise.

        Args:
            sequence: the number.
            publishers: how many there are now; asked when it is a number that nobody was expected to send.
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
    """A message that waits; sorts as messages were published. With equal stamps, /clock comes first."""

    source_ns: int
    topic: str  # empty: /clock
    sequence: int
    data: bytes
    time_ns: int  # that /clock tells


class PublicationOrder:
    """Holds messages until nothing published before them can still come, and gives them back in order.

    Args:
        hold_ns: how much later than a message one that was published before it may come [ns].
        sim_time: log times are those of /clock; otherwise the wall time of publication.
        began_ns: wall time at which the recording began [ns]; what is older was latched.

    Attributes:
        newest_ns: latest time of publication so far [ns]; 0 before the first message.
        late: messages that came too late to stand where they belong; they stand behind what had been given back.
        left_out: messages without a time: published between the beginning and the first one heard of a /clock that
            was running already.
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
        """Take a message, published at ``source_ns`` as number ``sequence`` of its publisher."""
        self._hold(_Held(source_ns, topic, sequence, data, 0))

    def add_clock(self, source_ns: int, sequence: int, time_ns: int) -> None:
        """Take a message of /clock, which tells ``time_ns``."""
        self._hold(_Held(source_ns, "", sequence, b"", time_ns))

    def _hold(self, held: _Held) -> None:
        self.newest_ns = max(self.newest_ns, held.source_ns)
        heapq.heappush(self._heap, held)

    def release(self, seen_ns: int) -> Iterator[Recorded]:
        """The messages that are ready, in order.

        Args:
            seen_ns: all messages that had arrived before one of this time of publication have been taken [ns].

        Raises:
            LatheError: /clock goes back, or far too much waits for it.
        """
        while self._heap and self._heap[0].source_ns < seen_ns - self._hold_ns:
            yield from self._give(heapq.heappop(self._heap))

    def rest(self) -> Iterator[Recorded]:
        """The remaining messages, in order, when none published before can still come.

        Raises:
            LatheError: see `release`.
        """
        return self.release(self.newest_ns + self._hold_ns + 1)

    def finish(self) -> None:
        """Nothing comes any more, and the rest has been given back.

        Raises:
            LatheError: messages wait, and /clock has told nothing.
        """
        if self._waiting:
            raise LatheError(f"/clock told no time: {len(self._waiting)} messages are not recorded")

    def _give(self, held: _Held) -> Iterator[Recorded]:
        if held.source_ns < self._given_ns:
            self.late += 1
            if not held.topic:  # time on /clock has gone on already
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
