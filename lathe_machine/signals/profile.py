# SPDX-License-Identifier: Apache-2.0
"""Part profiles as formulas: radius deviation as a function of spindle angle and position along the part."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError, at_most
from lathe_rc.signals.checks import stacked


class Profile(Protocol):
    """Protocol of the desired form of a part."""

    @property
    def heights(self) -> Array:
        """Positions along the part [m], increasing, dense enough for linear interpolation; shape (m,)."""

    def deviation(self, angle: Array, height: float) -> Array:
        """Return the radius deviation [m] at ``angle`` [rad] (shape (n,)) and ``height`` [m]; 2π-periodic."""


@dataclass(frozen=True)
class Harmonics:
    """Part form as a sum of harmonics, Σ A_i·sin(i·φ + φ_i) (paper 000, eq. 5)."""

    order: Array
    amplitude: Array
    phase: Array

    def __post_init__(self) -> None:
        stacked("harmonic profile", orders=self.order, amplitudes=self.amplitude, phases=self.phase)

    @property
    def heights(self) -> Array:
        """Heights of the form [m]: only 0, since the form is constant along the part."""
        return np.zeros(1)

    def deviation(self, angle: Array, height: float) -> Array:
        """Return the radius deviation [m] of the sum of harmonics (implements `Profile.deviation`)."""
        waves = self.amplitude[:, None] * np.sin(np.outer(self.order, angle) + self.phase[:, None])
        return np.asarray(waves.sum(axis=0))


@dataclass(frozen=True)
class Piston:
    """Part form of an oval-barrel piston skirt.

    Args:
        ovality: difference of the two diameters at the ends of the skirt [m].
        ovality_middle: difference of the two diameters at the widest place [m].
        barrel: decrease of the radius from the widest place to the farther end of the skirt [m].
        length: length of the skirt [m].
        widest: distance of the widest place from the start of the skirt [m].
    """

    ovality: float
    ovality_middle: float
    barrel: float
    length: float
    widest: float

    @property
    def heights(self) -> Array:
        """65 heights along the skirt [m]; linear interpolation between them has an error below 3e-4·``barrel``."""
        return np.linspace(0.0, self.length, 65)

    def deviation(self, angle: Array, height: float) -> Array:
        """Return -barrel·z² - (ovality(z)/4)·(1 - cos 2φ), with z = 0 at the widest place and 1 at the farther end."""
        z = (height - self.widest) / max(self.widest, self.length - self.widest)
        ovality = self.ovality_middle + (self.ovality - self.ovality_middle) * z * z
        return np.asarray(-self.barrel * z * z - ovality / 4.0 * (1.0 - np.cos(2.0 * angle)))


@dataclass(frozen=True)
class Polygon:
    """Regular polygon with rounded corners, as the deviation from the mean of its smallest and largest radii.

    Args:
        sides: number of sides, 3 or more.
        inscribed_radius: radius of the inscribed circle [m].
        corner_radius: radius of the corners [m], above 0 and at most the inscribed radius.
    """

    sides: int
    inscribed_radius: float
    corner_radius: float

    def __post_init__(self) -> None:
        if self.sides < 3:
            raise InputError(f"polygon: {self.sides} sides; allowed: 3 or more")
        if not 0.0 < self.corner_radius <= self.inscribed_radius:
            raise InputError(
                f"polygon: corner radius {self.corner_radius:g} m; allowed: above 0 and at most the inscribed "
                f"radius {at_most(self.inscribed_radius)} m"
            )

    @property
    def heights(self) -> Array:
        """Heights of the form [m]: only 0, since the part is a prism."""
        return np.zeros(1)

    def deviation(self, angle: Array, height: float) -> Array:
        """Return the radius of the outline minus the mean of its extremes [m]; angle 0 is the middle of a side."""
        half = math.pi / self.sides
        from_side = np.abs(np.mod(angle + half, 2 * half) - half)
        # The corner's circle touches the side at the foot of the normal through its centre.
        centre = (self.inscribed_radius - self.corner_radius) / math.cos(half)
        touch = math.atan2((self.inscribed_radius - self.corner_radius) * math.tan(half), self.inscribed_radius)
        from_corner = half - from_side
        across = np.sqrt(np.maximum(self.corner_radius**2 - (centre * np.sin(from_corner)) ** 2, 0.0))
        corner = centre * np.cos(from_corner) + across
        side = self.inscribed_radius / np.cos(np.minimum(from_side, touch))
        radius = np.where(from_side <= touch, side, corner)
        return np.asarray(radius - (self.inscribed_radius + centre + self.corner_radius) / 2.0)
