# SPDX-License-Identifier: Apache-2.0
"""Durations of wall time that are too many to be told one by one: counted by size, as text in a diagnostic report."""

import re

BINS = 32
LATENESS = (
    "lateness of blocks"  #: key in a report: from the moment at which a block was due to that at which it was let go
)
LATENCY = "latency of blocks"  #: from there until every member has completed it
_TEXT = re.compile(r"(?:[0-9]{1,2}:[0-9]{1,15})(?: [0-9]{1,2}:[0-9]{1,15})*")


class Durations:
    """Counts by size.

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
        """From what `__str__` made, or somebody else.

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
