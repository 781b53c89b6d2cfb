# SPDX-License-Identifier: Apache-2.0
"""Regression of a second-order drive: its coefficients a1 and a2 from what its filtered signals say.

    u(t - τ) = x + a1·dx/dt + a2·d²x/dt²        a1 = 2ζ/ωn, a2 = 1/ωn², τ known

Both sides pass the same low-pass (ω/(p + ω))³, whose stages give the filtered derivatives: nothing is differentiated.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import inlined

Array = npt.NDArray[np.float64]

STAGES = 3  #: first-order stages of each low-pass
_LEAST_EXCITED = 1e-6  # determinant of the normal equations, 1 for independent regressors


class LowPass(NamedTuple):
    """1/(1 + p/ω)³ by the bilinear rule, for the two signals of a drive.

    Attributes:
        bandwidth: ω [rad/s].
        keep, take: of a stage.
        position, command: their values before and after each stage, shape (4,) [m].
    """

    bandwidth: float
    keep: float
    take: float
    position: Array
    command: Array


def low_pass(bandwidth: float, step: float) -> LowPass:
    """A low-pass of a ``bandwidth`` [rad/s] at rest at 0; ``step`` in s."""
    half = 0.5 * bandwidth * step
    return LowPass(
        bandwidth, (1.0 - half) / (1.0 + half), half / (1.0 + half), np.zeros(STAGES + 1), np.zeros(STAGES + 1)
    )


@inlined
def pass_through(stages: Array, value: float, keep: float, take: float) -> None:
    """Step a low-pass of one signal."""
    new = value
    for stage in range(STAGES):
        old = stages[stage]
        stages[stage] = new
        new = keep * stages[stage + 1] + take * (new + old)
    stages[STAGES] = new


@inlined
def derivatives(stages: Array, bandwidth: float) -> tuple[float, float]:
    """First two derivatives of what has passed a low-pass."""
    first = bandwidth * (stages[STAGES - 1] - stages[STAGES])
    return first, bandwidth**2 * (stages[STAGES - 2] - 2.0 * stages[STAGES - 1] + stages[STAGES])


@inlined
def add_products(sums: Array, place: int, velocity: float, acceleration: float, rest: float) -> None:
    """Add what a sample says of dx/dt, d²x/dt² and u - x to five ``sums``, ``place`` on: vv, va, aa, vr and ar."""
    sums[place] += velocity * velocity
    sums[place + 1] += velocity * acceleration
    sums[place + 2] += acceleration * acceleration
    sums[place + 3] += velocity * rest
    sums[place + 4] += acceleration * rest


@inlined
def excited(vv: float, va: float, aa: float) -> bool:
    """Whether sums of the squares of dx/dt and d²x/dt² and of their product tell the two apart.

    That is relative to independent regressors: the units of the two differ by orders of magnitude.
    """
    return bool(vv * aa - va * va > _LEAST_EXCITED * vv * aa > 0.0)


@inlined
def coefficients(vv: float, va: float, aa: float, vr: float, ar: float) -> tuple[float, float]:
    """a1 [s] and a2 [s²] by least squares, from the same sums and those of the products with u - x."""
    determinant = vv * aa - va * va
    return (vr * aa - ar * va) / determinant, (ar * vv - vr * va) / determinant
