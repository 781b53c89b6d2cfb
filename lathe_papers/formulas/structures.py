# SPDX-License-Identifier: Apache-2.0
"""Steady errors and stability of the multi-channel structures of paper 001.

Every formula takes complex responses at the same frequencies: Q of the smoothing filter, Z = Wi/W0 of the drive with
its correction, and Wpk of the piezo. The responses may be ideal (`lathe_papers.formulas.responses`) or those of
difference equations. Wф of paper 001 is Q - 1.

In the iterative structure (Fig. 6) the reference of each channel is the error of the previous channel, and no channel
depends on later channels. Each channel therefore converges by itself, and the slowest determines the overall rate.
"""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy

from lathe_papers.formulas.responses import Response, lead, lead_lag, second_order, smoothing
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError

_GRID = 4097  # number of frequencies evaluated before the worst one is refined


def steady_error(q: npt.ArrayLike, z: npt.ArrayLike, gain: float = 1.0, cycle_phase: npt.ArrayLike = 0.0) -> Complex:
    """Return δ/Xd of one self-learning channel after many cycles (paper 001, eqs 3 and 5 for γ = 1).

    With r = e^{-jνθ}, the rotation of a component per cycle, Y = r·(Q·Y + γ·δ), X = Z·Y and δ = Xd - X give

        δ/Xd = (1 - r·Q)/(1 - r·Q + γ·r·Z)        and for r = 1   (1 - Q)/(γZ + 1 - Q)

    Args:
        q: response Q, shape (n,) or broadcastable with the other arguments, like the result.
        z: response Z, of a broadcastable shape.
        gain: learning gain γ.
        cycle_phase: νθ [rad] of a component with ν waves per revolution and the cycle angle θ. Only its
            value modulo 2π matters: 0 for a form that repeats in each cycle, nonzero for non-integer ν, as with a form
            that changes along the part.
    """
    turn = np.exp(-1j * np.asarray(cycle_phase, dtype=np.float64))
    forgotten = 1.0 - turn * np.asarray(q)
    return np.asarray(forgotten / (forgotten + gain * turn * np.asarray(z)))


def uncompensated(compensator: npt.ArrayLike) -> Complex:
    """Return 1 - Wpk, the remaining fraction of a vibration Δx under direct compensation (paper 001, eq. 6).

    The result has the shape of the argument.
    """
    return np.asarray(1.0 - np.asarray(compensator, dtype=np.complex128))


def direct_compensation(coarse: npt.ArrayLike, compensator: npt.ArrayLike) -> Complex:
    """Return E·(1 - Wpk), the steady error with a piezo commanded by the coarse channel error E (paper 001, eq. 7)."""
    return np.asarray(np.asarray(coarse) * uncompensated(compensator))


def iterative(*errors: npt.ArrayLike) -> Complex:
    """Return E1·E2·…, the steady error of self-learning channels in the iterative structure (paper 001, eqs 11-13).

    Args:
        errors: δ/Xd of each channel alone, coarsest first; at least one, shape (n,) each.
    """
    product = np.asarray(errors[0], dtype=np.complex128)
    for error in errors[1:]:
        product = product * np.asarray(error)
    return product


def contraction(q: npt.ArrayLike, z: npt.ArrayLike, gain: float = 1.0) -> Array:
    """Return |Q - γZ|, the factor by which each cycle multiplies the learning error; shape of the arguments."""
    return np.abs(np.asarray(q) - gain * np.asarray(z))


def cycles(factor: npt.ArrayLike, fraction: float) -> Array:
    """Return the cycles until ``fraction`` of the learning error remains; inf where the ``factor`` per cycle is >= 1.

    Raises:
        InputError: the fraction is not between 0 and 1.
    """
    if not 0.0 < fraction < 1.0:
        raise InputError(f"cycles to reach the fraction {fraction:g}; allowed: between 0 and 1, ends excluded")
    factors = np.asarray(factor, dtype=np.float64)
    with np.errstate(divide="ignore"):  # a factor of 0 learns in one cycle, a factor of 1 never
        # Without 1e-9, rounding would add a cycle where a whole number of cycles is exactly enough.
        count = np.ceil(math.log(fraction) / np.log(factors) - 1e-9)
    return np.where(factors < 1.0, np.maximum(count, 1.0), np.inf)


@dataclass(frozen=True)
class Peak:
    """Peak of a response: frequency [rad/s] and magnitude."""

    frequency: float
    magnitude: float


def supremum(response: Response, highest: float) -> Peak:
    """Return the peak of a response from 0 to ``highest`` [rad/s]; for Q - γZ, the magnitude must be below 1.

    The grid of 4097 frequencies resolves resonances wider than ``highest``/4096.
    """
    grid = np.linspace(0.0, highest, _GRID)
    magnitude = np.abs(response(grid))
    worst = int(np.argmax(magnitude))
    ends = float(grid[max(worst - 1, 0)]), float(grid[min(worst + 1, _GRID - 1)])
    near = scipy.optimize.minimize_scalar(lambda w: -abs(response(np.array([w]))[0]), bounds=ends, method="bounded")
    # The bounded search never evaluates the ends, where a response without a resonance peaks.
    if -near.fun > magnitude[worst]:
        return Peak(float(near.x), float(-near.fun))
    return Peak(float(grid[worst]), float(magnitude[worst]))


def lead_errors(q: Response, z: Response, highest: float, gain: float = 1.0) -> tuple[float, float]:
    """Return the limits of the lead error: the negative and positive changes of T0 [s] at which sup|Q - γZ| = 1.

    Args:
        q: response Q of the smoothing filter.
        z: response Z with the lead as designed; a change d of T0 turns it into Z·e^{jωd}.
        highest: highest frequency of the search [rad/s].
        gain: learning gain γ.

    Returns:
        The negative and the positive limit [s]; the positive limit is infinite if no lead is too long.

    Raises:
        InputError: the loop does not converge as designed.
    """

    def factor(change: float, frequency: Array) -> Complex:
        return np.asarray(q(frequency) - gain * z(frequency) * lead(frequency, change))

    def excess(change: float) -> float:
        return supremum(partial(factor, change), highest).magnitude - 1.0

    if excess(0.0) >= 0.0:
        raise InputError(f"sup|Q - γZ| = {excess(0.0) + 1.0:.4g} with the lead as designed; allowed: below 1")

    def limit(sign: float) -> float:
        # The phase at the highest frequency changes by π/8 per step, so that no unstable range is missed.
        step = sign * math.pi / 8.0 / highest
        for k in range(1, _GRID):
            if excess(k * step) >= 0.0:
                return float(scipy.optimize.brentq(excess, (k - 1) * step, k * step, xtol=1e-12))
        return sign * math.inf

    return limit(-1.0), limit(1.0)


def limit_frequency(compensator: Response, highest: float, level: float = 1.0) -> float:
    """Return the frequency [rad/s] up to which direct compensation leaves less than ``level``: |1 - Wpk| < level.

    With a level of 1, compensation increases the vibration from this frequency on (paper 001, eq. 8; eq. 9, |Wpk| < 2,
    is necessary but not sufficient). With a level of 0.5 and the response of a drive, the result is the bandwidth as in
    paper 001.

    Args:
        compensator: response Wpk of the piezo.
        highest: highest frequency of the search [rad/s].
        level: remaining fraction, above 0.

    Returns:
        The lowest frequency at which the level is reached; inf if there is none up to ``highest``.
    """

    def excess(frequency: float) -> float:
        return float(abs(uncompensated(compensator(np.array([frequency])))[0])) - level

    grid = np.linspace(0.0, highest, _GRID)
    above = np.flatnonzero(np.abs(uncompensated(compensator(grid))) >= level)
    if not above.size:
        return math.inf
    first = int(above[0])
    return float(scipy.optimize.brentq(excess, grid[first - 1], grid[first])) if first else 0.0


@dataclass(frozen=True)
class Channel:
    """Self-learning channel in continuous time.

    Args:
        natural_frequency: natural frequency ωn of the drive [rad/s].
        damping: damping ratio ζ of the drive [1].
        delay: delay τ of the drive [s].
        lead_time: lead T0 [s].
        q_time: time constant of Q [s].
        lead_lag: T1, T2 [s] of the series correction (1 + pT1)/(1 + pT2); equal values disable it.
    """

    natural_frequency: float
    damping: float
    delay: float
    lead_time: float
    q_time: float
    lead_lag: tuple[float, float] = (0.0, 0.0)

    def drive(self, frequency: npt.ArrayLike) -> Complex:
        """Return the response of the drive, Wi or Wpk, at ``frequency`` [rad/s]."""
        return second_order(frequency, self.natural_frequency, self.damping, self.delay)

    def q(self, frequency: npt.ArrayLike) -> Array:
        """Return the response of the smoothing filter Q at ``frequency`` [rad/s]."""
        return smoothing(frequency, self.q_time)

    def z(self, frequency: npt.ArrayLike) -> Complex:
        """Return the response of the corrected drive, Z = Wi/W0, at ``frequency`` [rad/s]."""
        correction = lead(frequency, self.lead_time) * lead_lag(frequency, *self.lead_lag)
        return np.asarray(self.drive(frequency) * correction)

    def factor(self, frequency: npt.ArrayLike) -> Complex:
        """Return the factor per cycle, Q - Z, at ``frequency`` [rad/s]."""
        return np.asarray(self.q(frequency) - self.z(frequency))

    def steady_error(self, frequency: npt.ArrayLike) -> Complex:
        """Return the steady error (1 - Q)/(Z + 1 - Q) at ``frequency`` [rad/s]."""
        return steady_error(self.q(frequency), self.z(frequency))
