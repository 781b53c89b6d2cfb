# SPDX-License-Identifier: Apache-2.0
"""Form error, settling and effort of a run, and their figures in the tables of studies that compare laws."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lathe_rc.analysis.tolerance import LAST, judge
from lathe_rc.arrays import Array
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.wiring import Cell
from lathe_rc.messages import Signals
from lathe_rc.signals.zones import zone_at

_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Judged:
    """Evaluated run.

    Attributes:
        largest: largest error by revolution [µm].
        rms: RMS error of the last revolutions [µm].
        effort: RMS current [A].
        share: largest error over the tolerance at its place, by revolution, where zones have their own; None without.
    """

    largest: Array
    rms: float
    effort: float
    share: Array | None = None

    def excess(self, tolerance: float) -> Array:
        """Return the largest error over the tolerance [µm], by revolution."""
        return self.largest / tolerance if self.share is None else self.share

    def settled(self, tolerance: float) -> float:
        """Return the revolution, counted from 1, from which the error stays in tolerance [µm]; inf if it never does."""
        return float(judge(self.excess(tolerance), 1.0).since or np.inf)


class Judge:
    """Recorder of the evaluated signals of a run; errors in gaps of the material are excluded.

    Args:
        cell: running cell.
        samples: number of samples of the run.
    """

    heard = ("encoder.angle_true", "tool.error", "coarse/state.effort")

    def __init__(self, cell: Cell, samples: int) -> None:
        drive: Any = cell.stages["loaded_drive"].shared
        self._gaps = list(zip(drive.cut_gap_start, drive.cut_gap_width, strict=True))
        self._angle, self._error, self._current = np.empty((3, samples))
        tool: Any = cell.stages["tool"].shared
        self._zones, self._allowed = tool.zones, np.array([tool.tolerance, *tool.zone_tolerance]) * 1e6

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Store angle, error and current of a chunk."""
        part = slice(first, first + samples)
        self._angle[part] = dense["encoder"]["angle_true"]
        self._error[part] = dense["tool"]["error"]
        self._current[part] = dense["coarse/state"]["effort"]

    def kept(self) -> Judged:
        """Return error and current of the complete revolutions."""
        error = np.abs(self._error) * 1e6
        for start, width in self._gaps:
            error[np.mod(self._angle - start, _TURN) < width] = 0.0
        revolution = np.floor(self._angle / _TURN)
        starts = np.searchsorted(revolution, np.arange(revolution[-1] + 1))
        # The run ends within a revolution, whose start only marks the end of the previous one.
        largest = np.maximum.reduceat(error[: starts[-1]], starts[:-1])
        last, share = error[starts[-1 - LAST] : starts[-1]], None
        if self._zones:
            allowed = self._allowed[zone_at(self._zones, self._angle, np.zeros_like(self._angle))]
            share = np.maximum.reduceat((error / np.where(allowed > 0.0, allowed, np.inf))[: starts[-1]], starts[:-1])
        with np.errstate(over="ignore"):  # a law that diverges
            rms, effort = np.sqrt(np.mean(last[last > 0.0] ** 2)), np.sqrt(np.mean(self._current**2))
        return Judged(largest, float(rms), float(effort), share)


def worst_of(values: Array) -> Array:
    """Return the largest value over the last axis (drives or seeds); NaN, a stopped run, counts as the worst."""
    return np.asarray(np.where(np.isnan(values).any(axis=-1), np.nan, values.max(axis=-1)))


def finite(values: Array) -> list[Any]:
    """Return the values as nested lists; None for a value that is not finite."""
    return [finite(row) if row.ndim else (float(row) if np.isfinite(row) else None) for row in values]


def figure_of(value: float) -> str:
    """Return a value with three digits, as in the tables; - for a value that is not finite."""
    if not np.isfinite(value):
        return "-"
    if value == int(value):
        return str(int(value))
    return f"{value:.2f}" if value < 10.0 else f"{value:.1f}" if value < 100.0 else f"{value:.0f}"
