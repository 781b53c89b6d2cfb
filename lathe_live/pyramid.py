# SPDX-License-Identifier: Apache-2.0
"""Level-of-detail pyramid: smallest and largest values per revolution, at every zoom, in bounded memory.

Each level has half as many cells as the one below it, and a cell has the extremes of the two cells under it. An extreme
is therefore seen at every level. A cell without a value is NaN, so that gaps remain gaps.
"""

from dataclasses import dataclass

import numpy as np

from lathe_rc.arrays import Array

MOST_CELLS = 2**17  #: cells of the finest level; when it is full, a cell has twice as many revolutions


@dataclass(frozen=True)
class Bands:
    """Extremes of consecutive cells.

    Attributes:
        first: index of the first revolution of the first cell.
        every: number of revolutions in a cell.
        low, high: smallest and largest values, shape (cells, channels); NaN: none.
    """

    first: int
    every: int
    low: Array
    high: Array


class Pyramid:
    """Pyramid of several channels.

    Args:
        channels: number of channels.
        most: cells of the finest level, a power of two.

    Attributes:
        first: index of the first revolution; None: there is none yet.
        every: number of revolutions in a cell of the finest level.
    """

    def __init__(self, channels: int, most: int = MOST_CELLS) -> None:
        self._most = most
        self.first: int | None = None
        self.every = 1
        self._filled = 0  # cells of the finest level
        # Level by level: smallest values, and largest with the other sign, so that both are merged by minima; shape
        # (cells, 2, channels). Levels above the finest one are computed on a query, from the cell `_changed`.
        self._levels = [np.full((1, 2, channels), np.nan)]
        self._changed = 0

    def extend(self, channels: int) -> None:
        """Add channels, which have no values so far."""
        finest = self._levels[0]
        self._levels = [np.concatenate([finest, np.full((len(finest), 2, channels), np.nan)], axis=2)]
        self._changed = 0

    def put(self, first: int, low: Array, high: Array) -> None:
        """Merge the extremes of consecutive revolutions with those that are there.

        Args:
            first: index of the first of these revolutions, at least that of the first call.
            low: smallest values, shape (revolutions, channels); NaN: none.
            high: largest values, likewise.

        Raises:
            ValueError: a revolution is before the first one.
        """
        if self.first is None:
            self.first = first
        begin, extremes = first - self.first, np.stack([low, -high], axis=1)
        if begin < 0:
            raise ValueError(f"revolution {first} is before the first one, {self.first}")
        last = begin + len(extremes) - 1
        while last // self.every >= self._most:
            self._build()
            self._levels, self.every = self._levels[1:] or self._levels, 2 * self.every
            self._filled = self._changed = -(-self._filled // 2)
        cells = np.arange(begin, last + 1) // self.every
        merged = np.fmin.reduceat(extremes, np.flatnonzero(np.diff(cells, prepend=-1)))
        self._reserve(int(cells[-1]) + 1)
        place = self._levels[0][cells[0] : cells[-1] + 1]
        np.fmin(place, merged, out=place)
        self._filled = max(self._filled, int(cells[-1]) + 1)
        self._changed = min(self._changed, int(cells[0]))

    def _reserve(self, cells: int) -> None:
        """Allocate a power of two of cells."""
        finest = self._levels[0]
        if cells > len(finest):
            self._levels = [np.full((2 ** (cells - 1).bit_length(), *finest.shape[1:]), np.nan)]
            self._levels[0][: len(finest)] = finest
            self._changed = 0

    def _build(self) -> None:
        """Compute the levels above the finest one, as far as something below them has changed."""
        level = 0
        while len(self._levels[level]) > 1:
            below, level = self._levels[level], level + 1
            if level == len(self._levels):
                self._levels.append(np.full((len(below) // 2, *below.shape[1:]), np.nan))
            begin, end = self._changed >> level, -(-self._filled >> level)
            pairs = below[2 * begin : 2 * end].reshape(-1, 2, *below.shape[1:])
            self._levels[level][begin:end] = np.fmin.reduce(pairs, axis=1)
        self._changed = self._filled

    def bands(self, first: int, last: int, cells: int) -> Bands:
        """Return the extremes of revolutions, at the finest level that needs at most a number of cells.

        Args:
            first: index of the first revolution.
            last: index of the last one; those that are not there are left out.
            cells: largest number of cells. The first and the last one may have revolutions beyond the range.
        """
        self._build()
        origin = self.first or 0
        begin = max((first - origin) // self.every, 0)
        end = min((last - origin) // self.every + 1, self._filled)
        if begin >= end:
            return Bands(first, self.every, *np.empty((2, 0, self._levels[0].shape[2])))
        level = 0
        while (end - 1 >> level) - (begin >> level) >= cells:
            level += 1
        found = self._levels[level][begin >> level : (end - 1 >> level) + 1]
        every = self.every << level
        return Bands(origin + (begin >> level) * every, every, found[:, 0].copy(), -found[:, 1])
