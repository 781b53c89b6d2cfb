# SPDX-License-Identifier: Apache-2.0
"""Effects of parameters on a goal, computed from the rows of a sweep, and the yield: the share of cells within a limit.

Let y be the goal of the n cells that have one, with the parameter's values in m bins b of n_b cells each:

    between = Σ n_b·(mean_b(y) - mean(y))²      within = Σ_b Σ (y - mean_b(y))²      total = between + within
    share   = (between - (m - 1)·within/(n - m)) / total

The share is the fraction of the variance of y that knowing the parameter alone explains (first order; ε², Kelley
1935). The fraction that m random bins would explain is subtracted, so that the result may be slightly negative. A
complete grid has no random part: with one bin per value, share = between/total is exact.

If some cells have no result, the parameters of the others depend on each other, and a parameter without any effect
explains what it predicts of the others. The total effect does not: over all pairs (j, k) of cells with a goal that
differ in this parameter alone,

    total effect = mean of (y_j - y_k)² / 2 / variance of y

It is the share of the variance that a new draw of the parameter alone changes, and 0 for a parameter without effect. If
all cells have a goal, it is Sobol's total index (Jansen 1999). A complete grid and a Saltelli sample have such pairs;
from the nearest neighbours in other samples it cannot be estimated: their points avoid each other.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

Samples = NDArray[np.float64]
Index = NDArray[np.int64]

_MOST_BINS, _IN_BIN = 64, 10  # largest number of bins for a variance share, and the mean number of cells in one
LEAST = 8  #: fewest cells from which effects are computed
_WIDE = 30.0  # ratio of the largest to the smallest value above which an axis is logarithmic


@dataclass(frozen=True, eq=False)
class Axis:
    """Parameter of a sweep and its values in the cells.

    Attributes:
        name: target of the parameter.
        label: name with the unit.
        values: values in the cells, shape (n,); for strings, the index into ``texts``; NaN where there is none.
        log: whether the parameter was varied on a logarithmic range.
        texts: strings for the values 0, 1, ...; empty for numeric values.
        tied: whether the parameter is derived by a formula.
    """

    name: str
    label: str
    values: Samples
    log: bool = False
    texts: Sequence[str] = ()
    tied: bool = False

    @property
    def distinct(self) -> Samples:
        """Distinct values in ascending order."""
        return np.unique(self.values[np.isfinite(self.values)])


@dataclass(frozen=True, eq=False)
class Bins:
    """Bins of the values of an axis.

    Attributes:
        index: bin index of each cell; -1 where the cell has no value.
        low, mid, high: lower end, middle and upper end of each bin.
    """

    index: Index
    low: Samples
    mid: Samples
    high: Samples

    @property
    def count(self) -> int:
        """Number of bins of the axis."""
        return self.mid.size


def is_wide(values: Samples) -> bool:
    """Return whether positive numbers span such a wide range that a logarithmic axis is clearer."""
    known = values[np.isfinite(values)]
    return bool(known.size and known.min() > 0.0 and known.max() > _WIDE * known.min())


def bins(axis: Axis, exact: int, most: int) -> Bins:
    """Return one bin per distinct value if there are at most ``exact`` values, else ``most`` bins of equal width.

    On a logarithmic range the bins have equal widths in the logarithm.
    """
    distinct = axis.distinct
    scaled = np.log(distinct) if axis.log else distinct
    if distinct.size <= exact or axis.texts:
        index = np.where(np.isfinite(axis.values), np.searchsorted(distinct, axis.values), -1)
        middle = scaled
        # Edges lie half-way between values; the outer bins are as wide on their outer side as on their inner one.
        step = np.diff(middle) if middle.size > 1 else np.array([1.0])
        edges = np.concatenate(
            [[middle[0] - step[0] / 2], middle[:-1] + np.diff(middle) / 2, [middle[-1] + step[-1] / 2]]
        )
        low, high = edges[:-1], edges[1:]
    else:
        edges = np.linspace(scaled[0], scaled[-1], most + 1)
        with np.errstate(invalid="ignore"):
            place = np.searchsorted(edges, np.log(axis.values) if axis.log else axis.values, side="right") - 1
        index = np.where(np.isfinite(axis.values), np.minimum(place, most - 1), -1)  # the last bin includes both ends
        low, high = edges[:-1], edges[1:]
        middle = (low + high) / 2
    if axis.log:
        low, middle, high = np.exp(low), np.exp(middle), np.exp(high)
    return Bins(index.astype(np.int64), low, middle, high)


def is_grid(axes: Sequence[Axis], goal: Samples) -> bool:
    """Return whether the cells form a complete grid.

    In a complete grid every combination of the values is equally frequent, and every cell has a goal value.
    """
    free = [axis for axis in axes if not axis.tied]
    if not free or not np.isfinite(goal).all() or not all(np.isfinite(axis.values).all() for axis in free):
        return False
    # Most samples return here, before their rows are sorted. The product is in floating point, so it cannot overflow.
    if float(np.prod([float(axis.distinct.size) for axis in free])) > goal.size:
        return False
    combinations, counts = np.unique(np.stack([axis.values for axis in free]), axis=1, return_counts=True)
    whole = int(np.prod([axis.distinct.size for axis in free]))
    return combinations.shape[1] == whole and bool((counts == counts[0]).all())


def _quantile_bins(values: Samples, count: int) -> Index:
    """Return quantile bins with about equal numbers of cells; equal values share a bin."""
    place = np.searchsorted(np.sort(values), values, side="left")
    return np.unique(place * count // values.size, return_inverse=True)[1].astype(np.int64)


@dataclass(frozen=True)
class Effect:
    """Effect of a parameter on a goal.

    Attributes:
        share: share of the goal's variance explained by the parameter alone; None for too few cells or a constant goal.
        rank: Spearman's rank correlation, -1 to 1; None likewise, and for strings without an order.
        total: total effect; None likewise, and if no two cells differ in the parameter alone.
        error: half the width of the 95 % confidence interval of the total effect; 0 for a grid.
    """

    share: float | None
    rank: float | None
    total: float | None = None
    error: float = 0.0


def effect(axis: Axis, goal: Samples, *, exact: bool = False) -> Effect:
    """Return the effect of a parameter on a goal.

    Args:
        axis: the parameter.
        goal: goal of each cell, shape (n,); NaN where a cell has none.
        exact: whether the cells are a complete grid, see `is_grid`.
    """
    known = np.isfinite(goal) & np.isfinite(axis.values)
    y, x = goal[known], axis.values[known]
    levels = np.unique(x).size
    if y.size < LEAST or levels < 2 or np.ptp(y) == 0.0:
        return Effect(None, None)
    limit = int(np.clip(y.size // _IN_BIN, 2, _MOST_BINS))
    exact = exact and not axis.tied  # a tied parameter is no axis of the grid
    whole = exact or bool(axis.texts) or levels <= limit
    index = np.unique(x, return_inverse=True)[1] if whole else _quantile_bins(x, limit)
    counts = np.bincount(index)
    means = np.bincount(index, weights=y) / counts
    total = float(((y - y.mean()) ** 2).sum())
    between = float((counts * (means - y.mean()) ** 2).sum())
    if not exact:
        if counts.size >= y.size:  # one cell in each bin: no variance within bins from which to estimate chance
            return Effect(None, None)
        between -= (counts.size - 1) * max(total - between, 0.0) / (y.size - counts.size)
    ordered = not axis.texts or set(axis.texts) == {"false", "true"}
    rank = float(scipy.stats.spearmanr(x, y).statistic) if ordered else None
    return Effect(between / total, rank)


def groups(axes: Sequence[Axis], seeds: Samples) -> list[Index]:
    """Return for each parameter the groups of cells that differ in it alone, as one number per cell.

    Args:
        axes: all parameters.
        seeds: seeds of the cells, shape (n,).
    """
    found = []
    for axis in axes:
        others = [each.values for each in axes if each is not axis and not each.tied]
        found.append(np.unique(np.stack([seeds, *others]), axis=1, return_inverse=True)[1].ravel().astype(np.int64))
    return found


def total_effect(group: Index, goal: Samples, *, exact: bool = False, lot: int = 1) -> tuple[float, float] | None:
    """Return the total effect of a parameter and half the width of its 95 % interval; None if there are too few pairs.

    Args:
        group: cells that differ in the parameter alone, see `groups`; shape (n,).
        goal: goal of each cell, shape (n,); NaN where a cell has none.
        exact: whether the cells are a complete grid, of which some may have no goal.
        lot: number of cells that depend on the same drawn point.
    """
    known = np.isfinite(goal)
    y = goal[known]
    if y.size < LEAST or np.ptp(y) == 0.0:
        return None
    y = (y - y.mean()) / y.std()
    counts = np.bincount(group[known])
    some = counts > 1
    if some.sum() < LEAST and not exact:
        return None
    count = counts[some]
    means = np.bincount(group[known], y) / np.maximum(counts, 1)
    squares = np.bincount(group[known], (y - means[group[known]]) ** 2)[some]
    if exact:  # each cell is a pair with itself as well
        return float((count * squares).sum() / (counts**2).sum()), 0.0
    found = float((count * squares).sum() / (count * (count - 1)).sum())
    # Errors of the mean, by pairs, and of the variance, by the squared deviations of independent points.
    errors = (squares / (count - 1)).std() / math.sqrt(count.size), found * (y * y).std() / math.sqrt(y.size / lot)
    return found, 1.96 * math.hypot(*errors)


@dataclass(frozen=True, eq=False)
class Yield:
    """Yield of a sweep: share of the cells whose goal is within a limit.

    Attributes:
        goal: goal values of all cells that have one, ascending.
        cells: number of all cells; a failed cell is never within a limit.
        above: whether large goals are better than small ones.
    """

    goal: Samples
    cells: int
    above: bool = False

    def share(self, limit: float) -> float:
        """Return the share of all cells whose goal is at most (if `above`, at least) the limit."""
        return self._within(limit) / self.cells

    def interval(self, limit: float) -> tuple[float, float]:
        """Return the 95 % confidence interval (Wilson) of the share, provided that the cells are a random sample."""
        found = scipy.stats.binomtest(self._within(limit), self.cells).proportion_ci(0.95, method="wilson")
        return float(found.low), float(found.high)

    def _within(self, limit: float) -> int:
        if self.above:
            return int(self.goal.size - np.searchsorted(self.goal, limit, side="left"))
        return int(np.searchsorted(self.goal, limit, side="right"))

    def point(self, share: float) -> float | None:
        """Return the tightest limit met by a given share of all cells; None if too few cells have a goal value."""
        needed = int(np.ceil(share * self.cells - 1e-9))  # rounding must not require an additional cell
        if not 0 < needed <= self.goal.size:
            return None
        return float(self.goal[self.goal.size - needed] if self.above else self.goal[needed - 1])

    def curve(self, most: int) -> tuple[Samples, Samples]:
        """Return the yield curve: limits and shares at up to ``most`` points, including the first and last cell."""
        place = np.unique(np.linspace(0, self.goal.size - 1, min(most, self.goal.size)).round().astype(np.int64))
        kept = self.goal.size - place if self.above else place + 1
        return self.goal[place], kept / self.cells
