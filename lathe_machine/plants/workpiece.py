# SPDX-License-Identifier: Apache-2.0
"""Properties of the part that affect the cut: keyways, hard spots, and compliance along the part."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined
from lathe_rc.signals.checks import stacked

_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class HardSpot:
    """Region of the part where the cutting force is multiplied by a factor.

    Attributes:
        start, width: angular window [rad].
        bottom, top: range of heights along the part [m].
        factor: multiplier of the force.
    """

    start: float
    width: float
    bottom: float
    top: float
    factor: float

    def __post_init__(self) -> None:
        _check_window("hard spot", self.start, self.width)
        if not self.bottom < self.top:
            raise InputError(f"hard spot from {self.bottom:g} to {self.top:g} m; allowed: a top above the bottom")
        if not 0.0 <= self.factor < np.inf:
            raise InputError(f"hard spot: factor {self.factor:g}; allowed: 0 or more")


def spot_rows(spots: Sequence[HardSpot]) -> Array:
    """Convert hard spots to an array for `hardness`, shape (n, 5)."""
    return np.array([astuple(spot) for spot in spots], dtype=np.float64).reshape(-1, 5)


def _check_window(what: str, start: float, width: float) -> None:
    """Check that the width of an angular window is above 0 and below a revolution."""
    if not (np.isfinite(start) and 0.0 < width < _TURN):
        raise InputError(
            f"{what}: window at {start:g} rad of {width:g} rad; allowed: a width above 0 and below a revolution"
        )


@dataclass(frozen=True)
class Workpiece:
    """Properties of the part that affect the cut.

    Attributes:
        radius: radius of the part, for the length of the cutting path [m].
        gaps: angular windows without material (keyways), as start and width of each [rad].
        hard_spots: hard spots; where spots overlap, their factors are multiplied.
        heights, compliances: c along the part [m, m/N], in place of that of the elasticity; linear between heights and
            constant beyond the ends; ``None`` if c is constant. See `lathe_machine.analysis.shaft`.

    Raises:
        InputError: a window or table is invalid.
    """

    radius: float = 0.05
    gaps: Sequence[tuple[float, float]] = ()
    hard_spots: Sequence[HardSpot] = ()
    heights: Array | None = None
    compliances: Array | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.radius < np.inf:
            raise InputError(f"part: radius {self.radius:g} m; allowed: above 0")
        for start, width in self.gaps:
            _check_window("keyway", start, width)
        if (self.heights is None) != (self.compliances is None):
            raise InputError("part: heights without compliances or the other way round; give both or none")
        if self.heights is not None and self.compliances is not None:
            stacked("part", heights=self.heights, compliances=self.compliances)
            if not self.heights.size:
                raise InputError("part: 0 heights and 0 compliances; give as many of each")
            if np.any(np.diff(self.heights) <= 0.0) or np.any(self.compliances < 0.0):
                raise InputError("part: heights have to rise, compliances must not be negative; sort or correct them")


@inlined
def _within(angle: float, start: float, width: float) -> bool:
    """Return whether an angle is in a window [rad]; windows may extend across 0."""
    since = (angle - start) / _TURN
    return bool((since - np.floor(since)) * _TURN < width)


@inlined
def missing(gaps: Array, angle: float) -> bool:
    """Return whether there is no material at an angle [rad]."""
    found = False
    for i in range(gaps.shape[0]):
        found |= _within(angle, gaps[i, 0], gaps[i, 1])
    return found


@inlined
def hardness(spots: Array, angle: float, height: float) -> float:
    """Return the force factor of hard spots at an angle [rad] and a height [m], with rows from `spot_rows`."""
    factor = 1.0
    for i in range(spots.shape[0]):
        if spots[i, 2] <= height <= spots[i, 3] and _within(angle, spots[i, 0], spots[i, 1]):
            factor *= spots[i, 4]
    return factor
