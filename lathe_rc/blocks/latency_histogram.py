# SPDX-License-Identifier: Apache-2.0
"""Latency histograms: wall-clock durations counted by size, as text in a diagnostic report."""

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate

BINS = 32
LATENESS = "lateness of blocks"  #: key in a report: time from when a block was due until its release
PERCENT = (50, 95, 99)  #: percentages of the blocks of a run for which the lateness is reported
LATENCY = "latency of blocks"  #: key in a report: time from a block's release until every member has completed it
_EXACT_BITS = 6  # leading bits that are kept of a duration in µs
_TEXT = re.compile(r"(?:[0-9]{1,2}:[0-9]{1,15})(?: [0-9]{1,2}:[0-9]{1,15})*")


class Durations:
    """Histogram of durations with bins of powers of 2 µs.

    Attributes:
        counts: number of durations in each bin, shape (`BINS`,): bin 0 is below 1 µs, bin b from 2^(b-1) to 2^b µs; the
            last bin also contains all longer durations.
    """

    def __init__(self) -> None:
        self.counts = [0] * BINS

    def add(self, seconds: float, count: int = 1) -> None:
        """Count ``count`` equal durations [s], which must not be negative."""
        self.counts[min(int(seconds * 1e6).bit_length(), BINS - 1)] += count

    def within(self, percent: float) -> float:
        """Return the upper edge [s] of the bin up to which the percentage of the durations lies; 0 without any."""
        wanted = sum(self.counts) * percent / 100.0
        place = next((place for place, found in enumerate(accumulate(self.counts)) if found >= wanted), 0)
        return (2.0**place * 1e-6 if place < BINS - 1 else math.inf) if wanted else 0.0

    def __str__(self) -> str:
        """Return the non-empty bins, as BIN:COUNT."""
        return " ".join(f"{place}:{count}" for place, count in enumerate(self.counts) if count)

    @classmethod
    def parse(cls, text: str) -> "Durations":
        """Parse a histogram in the format of `__str__`.

        Raises:
            ValueError: the string is not a histogram.
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
    """Statistics of the lateness of the blocks of a run.

    Attributes:
        blocks: number of blocks with a due time.
        late: number of blocks released after the due time of the next one.
        worst: largest lateness [s].
        within: percentiles of the lateness [s], by per cent of the blocks.
        slipped: delay of the schedule that was not made up for [s].
    """

    blocks: int
    late: int
    worst: float
    within: Mapping[int, float]
    slipped: float

    def lines(self) -> list[str]:
        """Describe the lateness in two lines."""
        within = ", ".join(f"{percent} % within {seconds * 1e3:.3g} ms" for percent, seconds in self.within.items())
        return [
            f"{self.late} of {self.blocks} blocks late; the schedule slipped by {self.slipped:.3g} s",
            f"lateness: {within}, worst {self.worst * 1e3:.3g} ms",
        ]


class Percentiles:
    """Percentiles of durations in constant memory, from counts of rounded durations; values are up to 3 % too large.

    Attributes:
        count: number of durations.
        worst: longest duration [s].
    """

    def __init__(self) -> None:
        self.count, self.worst = 0, 0.0
        self._counts: Counter[int] = Counter()

    def add(self, seconds: float) -> None:
        """Count a duration [s], which must not be negative."""
        self.count += 1
        self.worst = max(self.worst, seconds)
        microseconds = int(seconds * 1e6)
        halvings = max(microseconds.bit_length() - _EXACT_BITS, 0)
        # Durations with equal leading bits are counted together.
        self._counts[((microseconds >> halvings) + 1 << halvings)] += 1

    def within(self, percent: float) -> float:
        """Return the shortest duration [s] not exceeded by the given percentage; 0 without durations."""
        wanted, found = self.count * percent / 100.0, 0
        for upper in sorted(self._counts):
            found += self._counts[upper]
            if found >= wanted:
                return min(upper * 1e-6, self.worst)
        return self.worst
