# SPDX-License-Identifier: Apache-2.0
"""Factors of a cycle of learning: their largest magnitude, and the smallest error of the drive that makes it 1.

A law is given by its factors as functions of the waves per revolution; learning converges while all are below 1.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from lathe_rc.analysis.resonance_grid import NO_POLES, Grid, poles_of, with_images
from lathe_rc.arrays import Array, Complex

Response = Callable[[Array], Complex]

_COARSE = 1025  # points over all waves
_SCALE = 0.5  # change of the drive from which its effect on the factors is computed
_ROUNDING = 1e-9  # a smaller effect is none


def supremum(operator: Callable[[Array], Complex], highest: float, poles: Complex = NO_POLES) -> tuple[float, float]:
    """Compute the supremum of a cycle factor's magnitude, and the waves per revolution at which it occurs.

    Args:
        operator: factor of a cycle as a function of the waves per revolution, shape (n,).
        highest: highest waves per revolution.
        poles: those of the drive, see `poles_in_waves`.
    """
    grid = _waves_up_to(highest).resolving(poles)
    near = grid.near_peaks(np.abs(operator(grid.points)))
    if near.size == 1:
        return float("nan"), float(near[0])
    fine = np.abs(operator(near))
    return float(fine.max()), float(near[np.argmax(fine)])


class DriveMargin(NamedTuple):
    """Smallest error of a drive's response, at one frequency, with which learning diverges.

    Attributes:
        error: error relative to the response, of any phase [1]; inf if learning does not depend on the drive.
        waves: waves per revolution where it occurs.
        speed: speed of the spindle [rad/s].
    """

    error: float
    waves: float
    speed: float

    def __str__(self) -> str:
        """Return the error and the frequency where learning is lost."""
        return f"{self.error:.4g} at {self.waves:.3g} waves ({self.waves * self.speed / (2.0 * np.pi):.3g} Hz)"


def smallest_errors(factors: Callable[[Array, Sequence[float]], Sequence[Complex]], waves: Array) -> Array:
    """Compute the smallest relative errors of the drive at ``waves`` with which learning diverges, shape (n,).

    See `drive_margin` for the formula and the ``factors``.
    """
    given, more, less = factors(waves, (1.0, 1.0 + _SCALE, 1.0 - _SCALE))
    with np.errstate(all="ignore"):
        depends = np.abs(more - less) > _ROUNDING
        delta = np.where(depends, (2.0 * given - more - less) / (_SCALE * (more - less)), 0.0)
        beta = np.where(depends, (more * (1.0 + _SCALE * delta) - given) / _SCALE, 0.0)
        square = np.abs(beta) ** 2 - np.abs(delta) ** 2
        half, rest = np.abs(np.conj(given) * beta - delta), 1.0 - np.abs(given) ** 2
        # The quotient without cancellation; for a negative square it is the smaller of two positive roots.
        root = rest / (half + np.sqrt(half**2 + square * rest))
    return np.asarray(np.where(root >= 0.0, root, np.where(rest > 0.0, np.inf, 0.0)).min(axis=0))


def drive_margin(
    factors: Callable[[Array, Sequence[float]], Sequence[Complex]],
    highest: float,
    speed: float,
    points: Array | None = None,
    poles: Complex = NO_POLES,
) -> DriveMargin:
    """Compute the smallest relative error Δ of the drive with which a factor of a cycle reaches the magnitude 1.

    A factor of a linear law is a quotient (F0 + βΔ)/(1 + δΔ) in the response of the drive at one frequency, for Q - γZ
    with δ = 0. Over all phases of Δ its magnitude reaches 1 first at the smallest positive root m of

        (|β|² - |δ|²)·m² + 2·|conj(F0)·β - δ|·m = 1 - |F0|²

    which for δ = 0 is m = (1 - |F0|)/|β|. F0, β and δ follow from the factors with three drives.

    Args:
        factors: factors of a cycle at ``waves`` per revolution, shape (k, n), for each of some scales of the drive.
        highest: highest waves per revolution.
        speed: speed of the spindle [rad/s].
        points: waves per revolution that are evaluated, those of a measurement, shape (n,), n above 0; None: all.
        poles: those of the drive, see `poles_in_waves`.
    """
    smallest = partial(smallest_errors, factors)
    if points is None:
        grid = _waves_up_to(highest).resolving(poles)
        points = grid.near_peaks(-smallest(grid.points))
    found = smallest(points)
    worst = int(np.argmin(found))
    return DriveMargin(float(found[worst]), float(points[worst]), speed)


@lru_cache(maxsize=64)
def _waves_up_to(highest: float) -> Grid:
    """Return the waves per revolution of the coarse search for peaks."""
    waves = np.linspace(0.0, highest, _COARSE)
    waves.setflags(write=False)
    return Grid.even(waves)


def highest_waves(grid: int, step: float, speed: float) -> float:
    """Return the Nyquist limit of grid and sampling [waves per revolution], at ``speed`` [rad/s]."""
    return float(min(grid / 2, np.pi / (step * speed)))


def poles_in_waves(drive: Response, highest: float, speed: float, step: float) -> Complex:
    """Return the poles of a drive and their images up to ``highest``, in waves per revolution at a speed [rad/s]."""
    return with_images(poles_of(drive), step, highest * speed) / speed
