# SPDX-License-Identifier: Apache-2.0
"""Path of a tool whose tip is round across the spindle axis, and the slope at which the tool's flank would rub.

A form of radius r = R + deviation falls or rises at the angle β, tan β = r'/r. A round tip of radius ρ touches the form
beside the tip's foremost point, where both have the same normal. The centre of the tip thus follows a parallel curve,

    centre at the polar angle  φ + atan2(-ρ·sin β, r + ρ·cos β),  radius  √((r + ρ·cos β)² + (ρ·sin β)²)

and the path is that radius minus R + ρ. A tip that follows the form itself cuts too deep by ρ·(1/cos β - 1), if ρ is
small compared with the radius of curvature.

The clearance angle is the angle between the flank behind the edge and the cut surface. The fresh surface, also behind
the edge, is higher where the form falls towards the edge: the flank rubs where tan β < -tan(clearance).
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy

from lathe_machine.signals.profile import Profile
from lathe_machine.signals.profile_table import ProfileTable
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError

_TURN = 2.0 * np.pi
_POINTS = 8192  # points of the form between which the path is interpolated


@dataclass(frozen=True)
class TipPath:
    """Path of a round tip that turns a given form (implements `Profile`).

    Attributes:
        form: form of the part.
        radius: R, reference radius of the form [m].
        tip: ρ, radius of the tip [m].

    Raises:
        InputError: a radius is not positive, or, in `deviation`, the form has a concavity too narrow for the tip.
    """

    form: Profile
    radius: float
    tip: float

    def __post_init__(self) -> None:
        if not (0.0 < self.radius < np.inf and 0.0 <= self.tip < np.inf):
            raise InputError(
                f"tip of {self.tip:g} m on a part of {self.radius:g} m radius; allowed: 0 or more, on above 0"
            )

    @property
    def heights(self) -> Array:
        """Heights of the form [m]."""
        return self.form.heights

    def deviation(self, angle: Array, height: float) -> Array:
        """Return the displacement [m] of the tip's foremost point from R (implements `Profile.deviation`)."""
        at = np.linspace(0.0, _TURN, _POINTS + 1)
        values = self.form.deviation(at, height)
        values[-1] = values[0]
        spline = scipy.interpolate.CubicSpline(at, self.radius + values, bc_type="periodic")
        r, slope, bend = spline(at), spline(at, 1), spline(at, 2)
        long = np.hypot(r, slope)
        hollow = -(r * r + 2.0 * slope * slope - r * bend) / long**3  # curvature, positive in concavities
        if self.tip * hollow.max() >= 1.0:
            worst = int(np.argmax(hollow))
            raise InputError(
                f"the form is hollow with a radius of {1.0 / hollow[worst]:.4g} m at {at[worst]:.4g} rad, and a tip of "
                f"{self.tip:g} m does not get in; allowed: a smaller tip"
            )
        outwards, along = r + self.tip * r / long, -self.tip * slope / long
        centre = at + np.arctan2(along, outwards)
        path = np.hypot(outwards, along) - self.tip - self.radius
        path[-1] = path[0]
        traced = scipy.interpolate.CubicSpline(centre, path, bc_type="periodic")
        return np.asarray(traced(centre[0] + np.mod(angle - centre[0], _TURN)))


@dataclass(frozen=True)
class Fall:
    """Steepest fall of a form towards the edge.

    Attributes:
        slope: -tan β, positive where the form falls.
        angle: angle of the steepest fall [rad].
        height: height of the steepest fall [m].
    """

    slope: float
    angle: float
    height: float

    @property
    def clearance(self) -> float:
        """Clearance angle that a tool requires for this slope [rad]."""
        return math.atan(self.slope)


def steepest_fall(form: ProfileTable, radius: float, feed: float) -> Fall:
    """Find the steepest fall towards the edge on a part of ``radius`` [m], along a path with ``feed`` [m/rev]."""
    points = form.table.shape[1]
    value, slope = form.table[..., 3], form.table[..., 2] * points / _TURN
    along = np.zeros_like(value)
    if form.heights.size > 1:
        steps = np.diff(value, axis=0) / np.diff(form.heights)[:, None]
        along = np.minimum(np.concatenate((steps[:1], steps)), np.concatenate((steps, steps[-1:])))
    falls = -(slope + along * feed / _TURN) / (radius + value)
    row, place = np.unravel_index(np.argmax(falls), falls.shape)
    return Fall(float(falls[row, place]), float(place * _TURN / points), float(form.heights[row]))
