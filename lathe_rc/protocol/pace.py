# SPDX-License-Identifier: Apache-2.0
"""Pace of a run against wall time: the due time of each block, and its lateness."""

from lathe_rc.blocks.latency_histogram import PERCENT, Durations, Lateness, Percentiles


class Pace:
    """Schedule of the blocks of a run.

    Args:
        block: wall time per block [s]; 0: as fast as the members follow.
        window: largest number of blocks in flight.
        judged: number of blocks after which `lag` is evaluated.

    Attributes:
        block: see the arguments.
        schedule: monotonic time of sample 0 in the current schedule, slips included [s].
        slipped: total delay of the schedule due to slow members [s].
        lateness: histogram of the lateness of all blocks.
    """

    def __init__(self, block: float, window: int, judged: int = 0) -> None:
        self.block, self._window, self._judged = block, window, judged
        self.schedule = self.slipped = 0.0
        self.lateness = Durations()
        self._percentiles, self._late = Percentiles(), 0

    @property
    def most_late(self) -> float:
        """Return the largest lateness that the cell catches up [s]."""
        return max(1, self._window // 2) * self.block

    def change(self, block: float, blocks: int, now: float) -> None:
        """Continue with another wall time per block [s]: the next block, after ``blocks``, is due one from now."""
        self.block, self.schedule = block, now - blocks * block

    def due(self, blocks: int) -> float:
        """Return the monotonic time at which the next block is due, given the number of blocks before it [s]."""
        return self.schedule + (blocks + 1) * self.block

    def count(self, late: float, blocks: int) -> None:
        """Count blocks that are released together, the first of them ``late`` [s]."""
        for number in range(blocks):
            behind = max(late - number * self.block, 0.0)
            self.lateness.add(behind)
            self._percentiles.add(behind)
            self._late += behind > self.block

    def lag(self) -> float:
        """Return the fraction of the pace that the first blocks lost to slips; 0 except at the evaluation."""
        if self._percentiles.count < self._judged or not self._judged:
            return 0.0
        elapsed, self._judged = self._judged * self.block, 0
        return self.slipped / (elapsed + self.slipped)

    def slip(self, late: float) -> None:
        """Postpone the schedule after a late block, so that the cell does not catch up in a long burst."""
        self.schedule += late
        self.slipped += late

    def figures(self) -> Lateness | None:
        """Return the lateness of the blocks of the run; None for a run without a pace."""
        if not self._percentiles.count:
            return None
        within = {percent: self._percentiles.within(percent) for percent in PERCENT}
        return Lateness(self._percentiles.count, self._late, self._percentiles.worst, within, self.slipped)
