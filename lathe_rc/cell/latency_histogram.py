# SPDX-License-Identifier: Apache-2.0
"""Latency histograms: durations of wall time, counted by size, as text in a diagnostic report."""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

BINS = 32
LATENESS = (
    "lateness of blocks"  #: key in a report: from the moment at which a block was due to that at which it was let go
)
PERCENT = (50, 95, 99)  #: of the blocks of a run, whose lateness is told
LATENCY = "latency of blocks"  #: from there until every member has completed it
_EXACT_BITS = 6  # of a duration in µs
_TEXT = re.compile(r"(?:[0-9]{1,2}:[0-9]{1,15})(?: [0-9]{1,2}:[0-9]{1,15})*")


class Durations:
    """Histogram of durations, whose bins are powers of 2 µs.

    Attributes:
        counts: number of durations in each bin, shape (`BINS`,): bin 0 below 1 µs, bin b from 2^(b-1) to 2^b µs; the
            last has all that are longer.
    """

    def __init__(self) -> None:
        self.counts = [0] * BINS

    def add(self, seconds: float, count: int = 1) -> None:
        """Count ``count`` equal durations [s]; none may be negative."""
        self.counts[min(int(seconds * 1e6).bit_length(), BINS - 1)] += count

    def __str__(self) -> str:
        """Bins that are not empty, as BIN:COUNT."""
        return " ".join(f"{place}:{count}" for place, count in enumerate(self.counts) if count)

    @classmethod
    def parse(cls, text: str) -> "Durations":
        """Read a histogram that `__str__` has written, or another program.

        Raises:
            ValueError: it is none.
        """
        found = cls()
        if text and not _TEXT.fullmatch(text):
            raise ValueError(f"{text[:64]!r} is no list of BIN:COUNT")
        for pair in text.split():
            place, count = map(int, pair.split(":"))
            if place >= BINS:
                raise ValueError(f"bin {place}; allowed: below {BINS}")
            found.counts[place] += count
        return found


@dataclass(frozen=True)
class Lateness:
    """How late the blocks of a run were let go.

    Attributes:
        blocks: that were due at some time.
        late: those of them that were let go after the next one was due as well.
        worst: largest lateness [s].
        within: lateness [s] that so many per cent of the blocks did not exceed, by per cent.
        slipped: what the schedule gave up to make up for [s].
    """

    blocks: int
    late: int
    worst: float
    within: Mapping[int, float]
    slipped: float


class Percentiles:
    """Durations, kept by size, so that percentiles are up to 3 % too large and as many as you like take no memory.

    Attributes:
        count: of all.
        worst: the longest [s].
    """

    def __init__(self) -> None:
        self.count, self.worst = 0, 0.0
        self._counts: Counter[int] = Counter()

    def add(self, seconds: float) -> None:
        """Count a duration [s], which may not be negative."""
        self.count += 1
        self.worst = max(self.worst, seconds)
        microseconds = int(seconds * 1e6)
        halvings = max(microseconds.bit_length() - _EXACT_BITS, 0)
        # What is equal down to its leading bits is counted together.
        self._counts[((microseconds >> halvings) + 1 << halvings)] += 1

    def within(self, percent: float) -> float:
        """The shortest duration [s] that at least so many per cent did not exceed; 0 if there is none at all."""
        wanted, found = self.count * percent / 100.0, 0
        for upper in sorted(self._counts):
            found += self._counts[upper]
            if found >= wanted:
                return min(upper * 1e-6, self.worst)
        return self.worst
