# SPDX-License-Identifier: Apache-2.0
"""Series of any length in little memory: neighbours are put together until they fit."""

import numpy as np

from lathe_rc.messages import Samples

_MOST_VALUES = 8192


class Envelope:
    """Smallest and largest value of groups of neighbours.

    Args:
        capacity: groups that are kept, even; when they are full, two become one.

    Attributes:
        group: neighbours in a group.
        size: values so far.
    """

    def __init__(self, capacity: int = 1024) -> None:
        self.group, self.size = 1, 0
        self._low, self._high = np.full(capacity, np.nan), np.full(capacity, np.nan)

    def add(self, values: Samples) -> None:
        """Append, shape (n,); what is no finite number is left out."""
        if not values.size:
            return
        values = np.where(np.isfinite(values), values, np.nan)
        first, self.size = self.size, self.size + values.size
        while self.size > self.group * self._low.size:
            self.group *= 2
            self._low, self._high = _halved(self._low, np.fmin), _halved(self._high, np.fmax)
        place = np.arange(first, self.size) // self.group
        edges = np.flatnonzero(np.diff(place, prepend=-1))
        groups = place[edges]
        self._low[groups] = np.fmin(self._low[groups], np.fmin.reduceat(values, edges))
        self._high[groups] = np.fmax(self._high[groups], np.fmax.reduceat(values, edges))

    def curve(self) -> tuple[Samples, Samples, Samples]:
        """Place of the middle of each group, counted in values from 0, and its extremes."""
        groups = -(-self.size // self.group)
        place = np.arange(groups) * self.group + (self.group - 1) / 2
        return np.minimum(place, max(self.size - 1, 0)), self._low[:groups], self._high[:groups]

    @property
    def extremes(self) -> tuple[float, float]:
        """Smallest and largest of all; NaN without any."""
        if np.isnan(self._low).all():
            return np.nan, np.nan
        return float(np.nanmin(self._low)), float(np.nanmax(self._high))


def _halved(values: Samples, extreme: np.ufunc) -> Samples:
    pairs = extreme(values[::2], values[1::2])
    return np.concatenate([pairs, np.full(values.size - pairs.size, np.nan)])


class MeanRows:
    """Rows of a map; neighbours are averaged when there are too many.

    Args:
        width: of a row.
        capacity: rows that are kept, even.

    Attributes:
        group: rows in a group.
        size: rows so far.
    """

    def __init__(self, width: int, capacity: int = 400) -> None:
        self.group, self.size = 1, 0
        self._sums, self._capacity = np.zeros((capacity, width)), capacity

    def add(self, row: Samples) -> None:
        """Append a row, shape (width,)."""
        if self.size == self.group * self._capacity:
            self.group *= 2
            half = self._capacity // 2
            self._sums[:half] = self._sums[::2] + self._sums[1::2]
            self._sums[half:] = 0.0
        self._sums[self.size // self.group] += row
        self.size += 1

    def rows(self) -> Samples:
        """The mean of each group, shape (groups, width)."""
        groups = -(-self.size // self.group)
        counts = np.full(groups, self.group)
        if groups:
            counts[-1] = self.size - self.group * (groups - 1)
        mean: Samples = self._sums[:groups] / counts[:, None]
        return mean


class Thinned:
    """Values for a histogram: all, or if they are many, every second, fourth or so of them.

    Attributes:
        every: of how many values one is kept.
        size: values so far.
    """

    def __init__(self) -> None:
        self.every, self.size = 1, 0
        self._kept: list[float] = []

    def add(self, value: float) -> None:
        """Append; what is no finite number is left out."""
        if not np.isfinite(value):
            return
        if self.size % self.every == 0:
            if len(self._kept) == _MOST_VALUES:
                self._kept = self._kept[::2]
                self.every *= 2
            if self.size % self.every == 0:
                self._kept.append(value)
        self.size += 1

    def values(self) -> Samples:
        """Those kept."""
        return np.array(self._kept)
