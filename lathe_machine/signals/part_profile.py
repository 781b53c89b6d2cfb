# SPDX-License-Identifier: Apache-2.0
"""Part profiles in plain Python: formulas of angle and height, tabulated like all profiles."""

from abc import ABC, abstractmethod

import numpy as np

from lathe_machine.signals.profile_table import ProfileTable, tabulated
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.signals.checks import real_numbers

_TURN = 2.0 * np.pi
_CLOSED = 1e-9  # largest jump from 2π to 0, relative to the largest deviation


class PartProfile(ABC):
    """Base class of part forms in plain Python; the constructor takes the numbers given in the scenario.

    The class implements `lathe_machine.signals.profile.Profile`; unless `heights` is overridden, the form is constant
    along the part.
    """

    @property
    def heights(self) -> Array:
        """Positions along the part [m], increasing, dense enough for linear interpolation; shape (m,)."""
        return np.zeros(1)

    @abstractmethod
    def deviation(self, angle: Array, height: float) -> Array:
        """Return the radius deviation [m] at ``angle`` [rad] and ``height`` [m]; 2π-periodic, arrays of shape (n,)."""


def checked(profile: PartProfile) -> ProfileTable:
    """Check a part profile and return its table.

    Raises:
        InputError: the heights are out of order, or the deviation is not finite, has another shape or is not periodic.
    """
    heights = np.asarray(profile.heights)
    if heights.ndim != 1 or not heights.size or not np.all(np.isfinite(heights)) or np.any(np.diff(heights) <= 0.0):
        raise InputError(f"heights of shape {heights.shape}; allowed: one or more finite positions that increase")
    angle = np.linspace(0.0, _TURN, 361)
    for height in heights.tolist():
        deviation = real_numbers("deviation(angle, height)", profile.deviation(angle, height), "angles", angle)
        wrong = np.flatnonzero(~np.isfinite(deviation))
        if wrong.size:
            raise InputError(
                f"deviation = {deviation[wrong[0]]} m at {angle[wrong[0]]:.4g} rad, height {height:g} m; allowed: "
                "finite numbers"
            )
        gap = abs(float(deviation[-1] - deviation[0]))
        if gap > _CLOSED * max(float(np.abs(deviation).max()), 1e-6):
            raise InputError(
                f"deviation jumps by {gap:.4g} m from 2π to 0 rad at height {height:g} m; allowed: a periodic form"
            )
    return tabulated(profile)
