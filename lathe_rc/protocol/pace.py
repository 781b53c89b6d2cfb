# SPDX-License-Identifier: Apache-2.0
"""Pace of a run against wall time: when each block is due, and how late it was released."""

from lathe_rc.cell.latency_histogram import PERCENT, Durations, Percentiles


class Pace:
    """Schedule of the blocks of a run.

    Args:
        block: wall time that a block takes [s]; 0: as fast as the members follow.
        window: blocks that may be in flight.
        judged: blocks after which `lag` judges the pace.

    Attributes:
        block: see the arguments.
        schedule: monotonic time at which sample 0 would have been, were there no slips [s].
        slipped: time that the schedule gave up because members were slow [s].
        lateness: of all blocks, by size.
    """

    def __init__(self, block: float, window: int, judged: int = 0) -> None:
        self.block, self._judged = block, judged
        self.most_late = max(1, window // 2) * block
        self.schedule = self.slipped = 0.0
        self.lateness = Durations()
        self._percentiles, self._late = Percentiles(), 0

    def due(self, blocks: int) -> float:
        """Monotonic time at which the next block may be released, after so many [s]."""
        return self.schedule + (blocks + 1) * self.block

    def count(self, late: float, blocks: int) -> None:
        """Count some blocks that are released together, the first of them ``late`` [s]."""
        for number in range(blocks):
            behind = max(late - number * self.block, 0.0)
            self.lateness.add(behind)
            self._percentiles.add(behind)
            self._late += behind > self.block

    def lag(self) -> float:
        """Part of the wanted pace that the first blocks have lost to slips; 0 before and after they are judged."""
        if self._percentiles.count < self._judged or not self._judged:
            return 0.0
        elapsed, self._judged = self._judged * self.block, 0
        return self.slipped / (elapsed + self.slipped)

    def slip(self, late: float) -> None:
        """Put the schedule off [s]: the next blocks would make up for less, and no long burst shall catch up."""
        self.schedule += late
        self.slipped += late

    def figures(self) -> dict[str, object]:
        """Figures of the run for the harness; empty if no block was due at a time."""
        if not self._percentiles.count:
            return {}
        return {
            "blocks": self._percentiles.count,
            "late": self._late,
            "worst": self._percentiles.worst,
            "within": {percent: self._percentiles.within(percent) for percent in PERCENT},
            "slipped": self.slipped,
        }
