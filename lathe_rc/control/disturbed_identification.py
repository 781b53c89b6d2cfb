# SPDX-License-Identifier: Apache-2.0
"""Identification of a drive under a disturbance f that is unknown, but repeats with the angle.

a1 and a2 by least squares of u(t - τ) - x = a1·dx/dt + a2·d²x/dt² - f: the difference from the last revolution at the
same angle has no f. It needs a speed that varies; otherwise the equation itself counts, with a small weight, and beside
it the model that was given, the more the larger f is.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import put_scaled
from lathe_rc.control.drive_regression import add_products, coefficients, excited
from lathe_rc.jit import inlined

Array = npt.NDArray[np.float64]

_WHOLE = 3e-4  # weight of the equation itself beside its difference from the last revolution
_UNSURE = (0.3, 0.4)  # standard deviations of a1 and a2 as they are given, relative


class FitTable(NamedTuple):
    """The measurements of the drive.

    Attributes:
        given: a1 [s] and a2 [s²] as they are told, shape (2,).
        before: dx/dt, d²x/dt² and u - x of the last revolution, shape (3, n).
        sums: of the normal equations, differences first.
        means: how many, sums of dx/dt, d²x/dt², u - x and (u - x)²: a steady force counts for nothing.
        forgetting: what a revolution leaves of both.
    """

    given: Array
    before: Array
    sums: Array
    means: Array
    forgetting: float


def no_measurements(given: Array, points: int, forgetting: float) -> FitTable:
    """Nothing has been measured; ``points`` of the grid per revolution."""
    return FitTable(given, np.zeros((3, points)), np.zeros(10), np.zeros(5), forgetting)


def forget_measurements(m: FitTable) -> None:
    """Nothing has been measured again."""
    for array in (m.before, m.sums, m.means):
        array[:] = 0.0


@inlined
def sum_up(
    m: FitTable,
    here: int,
    again: bool,  # noqa: FBT001 - kernels take their arguments by position
    velocity: float,
    acceleration: float,
    rest: float,
) -> None:
    """Take dx/dt, d²x/dt² and u - x at grid point ``here``, ``again`` if they were taken a revolution ago as well."""
    sums, before = m.sums, m.before
    if again:
        v, a, r = velocity - before[0, here], acceleration - before[1, here], rest - before[2, here]
        add_products(sums, 0, v, a, r)
    add_products(sums, 5, velocity, acceleration, rest)
    mean = m.means
    mean[0] += 1.0
    mean[1] += velocity
    mean[2] += acceleration
    mean[3] += rest
    mean[4] += rest * rest
    before[0, here], before[1, here], before[2, here] = velocity, acceleration, rest


@inlined
def fitted(m: FitTable) -> tuple[float, float]:
    """a1 [s] and a2 [s²]; not above 0 if the measurements say nothing."""
    count, v, a, r, rr = m.means[0], m.means[1], m.means[2], m.means[3], m.means[4]
    whole, s = m.sums[5:].copy(), m.sums[:5].copy()
    for k, mean in enumerate((v * v, v * a, a * a, v * r, a * r)):
        whole[k] -= mean / count
    if not excited(whole[0], whole[1], whole[2]):
        return 0.0, 0.0
    a1, a2 = coefficients(whole[0], whole[1], whole[2], whole[3], whole[4])
    # The force is as large in the waves that the drive moves in as in the others, where it is what is left.
    left = _WHOLE * max(rr - r * r / count - a1 * whole[3] - a2 * whole[4], 0.0)
    sure1, sure2 = left / (_UNSURE[0] * m.given[0]) ** 2, left / (_UNSURE[1] * m.given[1]) ** 2
    s += _WHOLE * whole
    s[0] += sure1
    s[2] += sure2
    s[3] += sure1 * m.given[0]
    s[4] += sure2 * m.given[1]
    return coefficients(s[0], s[1], s[2], s[3], s[4])


@inlined
def fade(m: FitTable) -> None:
    """A revolution has ended: what was measured before counts less."""
    put_scaled(m.sums, m.forgetting, m.sums)
    put_scaled(m.means, m.forgetting, m.means)
