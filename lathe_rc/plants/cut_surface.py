# SPDX-License-Identifier: Apache-2.0
"""The surface that the edge leaves, remembered over the angle until it is met again a revolution later.

Over the angle, so that it is found again at any speed: what the edge leaves between two samples goes to the grid points
between their angles.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import inlined, kernel

Array = npt.NDArray[np.float64]

# Places in what is known of the last sample: its place on the grid, what it left, the next grid point.
_PLACE, _LEFT, _NEXT = 0, 1, 2


class SurfaceTable(NamedTuple):
    """A remembered surface, for kernels.

    Attributes:
        ring: by grid point, modulo its size, which is a power of two [m].
        last: the last sample's place on the grid, what it left there, and the next grid point; NaN before the first.
    """

    ring: Array
    last: Array


def blank(grid: int) -> SurfaceTable:
    """Nothing has been cut; ``grid`` points in a revolution."""
    # A power of two, so that a mask wraps the index; a sample may be up to a revolution long.
    return SurfaceTable(np.zeros(1 << (2 * grid + 2).bit_length()), np.array([np.nan, 0.0, 0.0]))


@inlined
def goes_on(last: Array, place: float, grid: int) -> bool:
    """Whether ``place`` [grid point] is less than a revolution beyond that of the last sample, and not before it."""
    return bool(0.0 <= place - (place if np.isnan(last[_PLACE]) else last[_PLACE]) < grid)


@kernel
def read(ring: Array, place: float) -> float:
    """The remembered surface [m] at ``place`` [grid point]."""
    i = int(np.floor(place))
    mask = ring.size - 1
    left = ring[i & mask]
    return float(left + (ring[(i + 1) & mask] - left) * (place - i))


@kernel
def remember(ring: Array, last: Array, place: float, left: float) -> None:
    """Lay down what the edge left [m] between the last sample and this one, at ``place`` [grid point]."""
    mask = ring.size - 1
    if np.isnan(last[_PLACE]):
        last[_PLACE], last[_LEFT], last[_NEXT] = place, left, np.ceil(place)
    while last[_NEXT] <= place:
        u = 0.0
        if place > last[_PLACE]:
            u = (last[_NEXT] - last[_PLACE]) / (place - last[_PLACE])
        ring[int(last[_NEXT]) & mask] = last[_LEFT] + (left - last[_LEFT]) * u
        last[_NEXT] += 1.0
    last[_PLACE], last[_LEFT] = place, left
