# SPDX-License-Identifier: Apache-2.0
"""Formulas of the learning loop: stability, contraction, steady-state error.

In one cycle the loop multiplies the component of the memory at ν waves per revolution by Q(ν) - γ·Z(νΩ)
(paper 001, eqs 1-5; Z = Wi/W0 is the drive with lead and correction). It converges when sup|Q - γZ| < 1 over all ν
up to the grid's Nyquist limit. Q, Z and the interpolators are modelled as implemented, not as their continuous ideals.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from lathe_rc.analysis.resonance_grid import NO_POLES, Grid, poles_of, with_images
from lathe_rc.arrays import Array, Complex
from lathe_rc.control.correction import Correction, CorrectionLaw
from lathe_rc.control.interpolation import cubic_response, derivative_responses
from lathe_rc.control.q_filter import QFilter
from lathe_rc.plants.linear import Constant

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


@dataclass(frozen=True)
class LearningLoop:
    """Learning loop of one self-learning channel.

    Args:
        drive: frequency response from the drive's command to its position at a frequency [rad/s].
        q: zero-phase Q on the grid.
        grid: memory points per revolution.
        gain: learning gain γ.
        lead_time: T0 [s] of the lead law; the lead angle is T0·Ω for all laws except the constant one.
        constant_lead: lead angle independent of the speed [rad].
        correction: 1/W0 after the lead.
        nominal: nominal speed Ω0 [rad/s].
        variable_lead: False for the constant lead angle T0·Ω0.
        step: sampling step [s].
    """

    drive: Response
    q: QFilter
    grid: int
    gain: float
    lead_time: float
    constant_lead: float
    correction: Correction
    nominal: float
    variable_lead: bool
    step: float

    def _correction(self, waves: Array, speed: float) -> Array | Complex:
        """Compute the response of 1/W0 with the interpolation of the memory, without the lead."""
        correction, radians = self.correction, 2 * np.pi * waves / self.grid
        law = correction.law
        if law is CorrectionLaw.NONE:
            return cubic_response(radians)
        a1, a2 = correction.inverse
        p = 1j * waves * speed
        if law in (CorrectionLaw.SECOND_ORDER_INVERSE, CorrectionLaw.SECOND_ORDER_INVERSE_DYNAMIC):
            read, first, second = derivative_responses(radians)
            per_second = self.grid / (2 * np.pi) * speed
            return np.asarray(read + a1 * per_second * first + a2 * per_second**2 * second)
        if law is CorrectionLaw.FIR:
            later = np.exp(-1j * waves * self._lead(speed) * (correction.interval / self.lead_time))
            factor = np.polynomial.polynomial.polyval(later, np.array(correction.taps))
        elif law is CorrectionLaw.LEAD_LAG:
            factor = (1 + p * correction.lead) / (1 + p * correction.lag)
        else:
            angular = 1j * waves * self.nominal
            factor = (1 + a1 * p + a2 * p**2) / (1 + a1 * angular + a2 * angular**2)
        return np.asarray(cubic_response(radians) * factor)

    def _lead(self, speed: float) -> float:
        """Return the lead angle [rad]."""
        return self.lead_time * (speed if self.variable_lead else self.nominal) + self.constant_lead

    def corrected_drive(self, waves: Array, speed: float) -> Complex:
        """Compute Z (drive, lead, correction, interpolators) at ``waves`` per revolution and a ``speed`` [rad/s]."""
        frequency = waves * speed
        lead = self._lead(speed)
        measured = cubic_response(frequency * self.step)
        return np.asarray(self.drive(frequency) * np.exp(1j * waves * lead) * self._correction(waves, speed) * measured)

    def operator(self, waves: Array, speed: float) -> Complex:
        """Compute the factor Q - γZ of a cycle at ``waves`` per revolution, shape (n,)."""
        (operator,) = self.operators(waves, speed, (1.0,))
        return operator

    def operators(self, waves: Array, speed: float, scales: Sequence[float]) -> list[Complex]:
        """Compute `operator` with the drive scaled by each of some numbers; Q and Z are computed once."""
        q, z = self.q.response(2 * np.pi * waves / self.grid), self.corrected_drive(waves, speed)
        return [np.asarray(q - self.gain * scale * z) for scale in scales]

    def worst(self, speed: float) -> tuple[float, float]:
        """Compute the supremum of |Q - γZ| at ``speed`` [rad/s], and the waves per revolution at which it occurs.

        The range extends up to the Nyquist limits of grid and sampling. The result is cached for equal loops.
        """
        # A bound method of constants never changes, so the loop can be a key of the cache.
        is_constant = isinstance(getattr(self.drive, "__self__", None), Constant)
        return (_worst_of_alike if is_constant else _worst)(self, speed)

    def supremum(self, speed: float) -> float:
        """Compute the supremum of |Q - γZ| at ``speed`` [rad/s]."""
        return self.worst(speed)[0]

    def steady_error(self, waves: Array, speed: float) -> Complex:
        """Compute the steady-state error ratio δ/Xd = (1 - Q)/(γZ + 1 - Q) (paper 001, eq. 3), shape (n,)."""
        q = self.q.response(2 * np.pi * waves / self.grid)
        return np.asarray((1.0 - q) / (self.gain * self.corrected_drive(waves, speed) + 1.0 - q))


def _worst(loop: LearningLoop, speed: float) -> tuple[float, float]:
    """Compute the supremum of a loop at a speed, without a cache."""
    highest = highest_waves(loop.grid, loop.step, speed)
    return supremum(
        lambda waves: loop.operator(waves, speed), highest, poles_in_waves(loop.drive, highest, speed, loop.step)
    )


_worst_of_alike = lru_cache(maxsize=256)(_worst)
