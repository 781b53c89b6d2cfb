# SPDX-License-Identifier: Apache-2.0
"""Series of any length in bounded memory: neighbouring values are combined when there are too many."""

import numpy as np

from lathe_rc.messages import Samples


class _Groups:
    """Groups of neighbouring values; when there are too many groups, pairs are merged.

    Args:
        capacity: largest number of groups, even.
        shape: shape of a value.
        how: ufuncs that combine the values of a group, each with its identity element.

    Attributes:
        group: number of values per group.
        size: number of values so far.
    """

    def __init__(self, capacity: int, shape: tuple[int, ...], *how: tuple[np.ufunc, float]) -> None:
        self.group, self.size = 1, 0
        self._capacity = capacity
        self._how = [(ufunc, empty, np.full((capacity, *shape), empty)) for ufunc, empty in how]

    def add(self, values: Samples) -> None:
        """Append values, shape (n, *shape)."""
        first, self.size = self.size, self.size + len(values)
        while self.size > self.group * self._capacity:
            self.group *= 2
            for ufunc, empty, kept in self._how:
                kept[: self._capacity // 2] = ufunc(kept[::2], kept[1::2])
                kept[self._capacity // 2 :] = empty
        # A single call of reduceat handles all new values; a segment begins at each change of group.
        place = np.arange(first, self.size) // self.group
        edges = np.flatnonzero(np.diff(place, prepend=-1))
        groups = place[edges]
        for ufunc, _, kept in self._how:
            kept[groups] = ufunc(kept[groups], ufunc.reduceat(values, edges))

    def _kept(self) -> list[Samples]:
        groups = -(-self.size // self.group)
        return [kept[:groups] for _, _, kept in self._how]


class Envelope(_Groups):
    """Smallest and largest value of groups of neighbours; values that are not finite are omitted.

    Args:
        capacity: largest number of groups, even.
    """

    def __init__(self, capacity: int = 1024) -> None:
        super().__init__(capacity, (), (np.fmin, np.nan), (np.fmax, np.nan))

    def add(self, values: Samples) -> None:
        """Append values, shape (n,)."""
        if values.size:
            super().add(np.where(np.isfinite(values), values, np.nan))

    def curve(self) -> tuple[Samples, Samples, Samples]:
        """Return the middle of each group, counted in values from 0, and the extremes of each group."""
        low, high = self._kept()
        place = np.arange(low.size) * self.group + (self.group - 1) / 2
        return np.minimum(place, max(self.size - 1, 0)), low, high

    @property
    def extremes(self) -> tuple[float, float]:
        """Return the smallest and the largest value; NaN without values."""
        low, high = self._kept()
        return float(np.fmin.reduce(low, initial=np.nan)), float(np.fmax.reduce(high, initial=np.nan))


class MeanRows(_Groups):
    """Rows of a map; neighbouring rows are averaged when there are too many.

    Args:
        width: length of a row.
        capacity: largest number of rows, even.
    """

    def __init__(self, width: int, capacity: int = 400) -> None:
        super().__init__(capacity, (width,), (np.add, 0.0))

    def rows(self) -> Samples:
        """Return the mean of each group, shape (groups, width)."""
        (sums,) = self._kept()
        counts = np.minimum(self.size - np.arange(len(sums)) * self.group, self.group)  # the last group may be smaller
        mean: Samples = sums / counts[:, None]
        return mean
