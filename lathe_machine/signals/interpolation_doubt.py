# SPDX-License-Identifier: Apache-2.0
"""How far a form may be off between the points of its table.

The points of a file say nothing about the form between them, so the interpolation is judged where it can be: every
second angle, and every second height, is left out and compared with the interpolation of the others. The error of the
whole table is that error divided by 2 to the power of the order of the interpolation: 4 for cubic splines over the
angle, 2 for straight lines along the part (de Boor, *A Practical Guide to Splines*, chapters III to V). The order shows
in the error with three of four points left out. Where it is lower, as at a kink, in a step, or in noise, or where the
points are too few to show it, the error stands as it was found. A wave that all points miss is not found.

The rows of a formula are joined by straight lines, too; their error is computed, half-way between two rows.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from lathe_machine.signals.measured_profile import Measured
from lathe_machine.signals.profile import Profile
from lathe_machine.signals.profile_table import ByContent, kept
from lathe_rc.arrays import Array

Places = npt.NDArray[np.signedinteger[Any]]

_TURN = 2.0 * np.pi
_ANGLES = _TURN * np.arange(720) / 720  # at which a formula is compared
_CUBIC, _LINEAR = 4, 2  # highest orders of the two interpolations
_SMOOTH = 0.5  # an order that is lower by more is that of a form that is not smooth, or of too few points
_KNOTS = 3  # least points of a periodic spline


class Doubt(NamedTuple):
    """Largest error of the interpolation of a form, estimated [m]; NaN: too few points to tell."""

    angle: float
    height: float

    @property
    def whole(self) -> float:
        """Sum of both, as far as they are known [m]."""
        return float(np.nansum(self))


def doubt(form: Profile) -> Doubt:
    """Estimate how far a form is off between its points; for files, cached as their tables are."""
    return _doubt(ByContent(form))


@lru_cache(maxsize=8)
def _doubt(given: ByContent) -> Doubt:
    form = given.profile
    if isinstance(form, Measured):
        return Doubt(*kept(b"doubt" + given.content, lambda: np.array(_of_points(form))).tolist())
    rows = np.array([form.deviation(_ANGLES, height) for height in form.heights.tolist()])
    between = [form.deviation(_ANGLES, height) for height in (form.heights[:-1] + np.diff(form.heights) / 2).tolist()]
    apart = np.array(between).reshape(-1, _ANGLES.size) - (rows[:-1] + rows[1:]) / 2.0
    return Doubt(0.0, float(np.abs(apart).max(initial=0.0)))


def _of_points(form: Measured) -> tuple[float, float]:
    """Return the doubts over the angle and along the part [m]."""
    angle, heights, radius = form.angle, form.heights, form.radius

    def around(knots: Places, at: Places) -> Array:
        places, rows = np.append(angle[knots], angle[knots[0]] + _TURN), radius[:, np.append(knots, knots[0])]
        spline = scipy.interpolate.CubicSpline(places, rows, axis=1, bc_type="periodic")
        return np.asarray(spline(angle[at] + _TURN * (angle[at] < places[0])) - radius[:, at])

    def along(knots: Places, at: Places) -> Array:
        return np.asarray(scipy.interpolate.interp1d(heights[knots], radius[knots], axis=0)(heights[at]) - radius[at])

    def error(points: int, every: int, first: int, *, periodic: bool) -> float:
        """Return the largest error with only one in ``every`` points kept; NaN if these are too few."""
        knots, at = np.arange(first, points, every), np.arange(first + every // 2, points, every)
        if not periodic:
            at = at[at < knots[-1]] if knots.size else at[:0]
        if not at.size or (knots.size < _KNOTS and periodic):
            return np.nan
        return float(np.abs((around if periodic else along)(knots, at)).max())

    def estimate(points: int, order: int, *, periodic: bool) -> float:
        """Return the error of all points from those of a half and of a quarter of them."""
        half, quarter = (
            float(np.fmax.reduce([error(points, every, first, periodic=periodic) for first in range(every)]))
            for every in (2, 4)
        )
        if not half > 0.0 or not quarter > 0.0:
            return half
        seen = np.log2(quarter / half)
        return half / 2.0 ** min(seen, order) if seen > order - _SMOOTH else half

    return estimate(angle.size, _CUBIC, periodic=True), (
        estimate(heights.size, _LINEAR, periodic=False) if heights.size > 1 else 0.0
    )
