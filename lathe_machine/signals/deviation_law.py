# SPDX-License-Identifier: Apache-2.0
"""Laws of the spindle's speed deviation in plain Python: formulas of time, applied as a tachogram."""

from abc import ABC, abstractmethod

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.signals import speed
from lathe_rc.signals.checks import real_numbers
from lathe_rc.signals.speed import SpeedLaw

_MOST = 2**22  # largest number of points of a tachogram


class DeviationLaw(ABC):
    """Base class of laws for the spindle's speed deviation; the constructor takes the numbers given in the scenario."""

    @abstractmethod
    def deviation(self, time: Array) -> Array:
        """Return the deviation relative to the nominal speed [1] at ``time`` [s] after sample 0, both of shape (n,)."""


def tabulated(nominal: float, law: DeviationLaw, step: float, end: float) -> SpeedLaw:
    """Tabulate a deviation law as a piecewise-linear tachogram whose last value is held.

    Args:
        nominal: nominal speed [rad/s].
        law: law of the deviation.
        step: time between two points [s].
        end: end of the tachogram [s], rounded up to a whole number of steps.

    Raises:
        InputError: there would be too many points, or the law returns a value that is not a finite number.
    """
    points = int(np.ceil(end / step)) + 1
    if points > _MOST:
        raise InputError(
            f"{end:g} s in steps of {step:g} s are {points} points; allowed: {_MOST} (a longer step or an earlier end)"
        )
    time: Array = step * np.arange(points, dtype=np.float64)
    deviation = real_numbers("deviation(time)", law.deviation(time), "times", time)
    wrong = np.flatnonzero(~np.isfinite(deviation))
    if wrong.size:
        raise InputError(f"deviation(time) = {deviation[wrong[0]]} at {time[wrong[0]]:g} s; allowed: finite numbers")
    return speed.tachogram(nominal, time, deviation.astype(np.float64))
