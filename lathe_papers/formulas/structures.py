# SPDX-License-Identifier: Apache-2.0
"""Steady errors and stability of the multi-channel structures of paper 001.

Every formula is one of complex responses at the same frequencies: Q of the smoothing filter, Z = Wi/W0 of the drive
with its correction, Wpk of the piezo. They may be ideals (`lathe_papers.formulas.responses`) or those of difference
equations. Where paper 001 writes Wф, it is Q - 1.

In the iterative structure (Fig. 6) each channel's reference is the error of the channel before, and no channel
sees those after it. So each converges by itself, and the slowest decides.
"""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
import scipy

from lathe_papers.formulas.responses import Array, Complex, Response, lead, lead_lag, second_order, smoothing
from lathe_rc.errors import InputError

_GRID = 4097  # frequencies looked at before the worst is refined


def steady_error(q: npt.ArrayLike, z: npt.ArrayLike, gain: float = 1.0, cycle_phase: npt.ArrayLike = 0.0) -> Complex:
    """δ/Xd of one self-learning channel after many cycles (paper 001, eqs 3 and 5, which have γ = 1).

    With r = e^{-jνθ}, what a component turns by in a cycle, Y = r·(Q·Y + γ·δ), X = Z·Y and δ = Xd - X give

        δ/Xd = (1 - r·Q)/(1 - r·Q + γ·r·Z)        and for r = 1   (1 - Q)/(γZ + 1 - Q)

    Args:
        q: Q, shape (n,) or what broadcasts with the others; so is the result.
        z: Z, the same.
        gain: γ.
        cycle_phase: νθ [rad] of a component with ν waves per revolution and the cycle angle θ. Only its
            remainder of 2π counts: 0 for a form that repeats in each cycle; something else for ν that are not
            whole, as a form has that changes along the part.
    """
    turn = np.exp(-1j * np.asarray(cycle_phase, dtype=np.float64))
    forgotten = 1.0 - turn * np.asarray(q)
    return np.asarray(forgotten / (forgotten + gain * turn * np.asarray(z)))


def uncompensated(compensator: npt.ArrayLike) -> Complex:
    """1 - Wpk: what direct compensation leaves of a vibration Δx (paper 001, eq. 6), shape as given."""
    return np.asarray(1.0 - np.asarray(compensator, dtype=np.complex128))


def direct_compensation(coarse: npt.ArrayLike, compensator: npt.ArrayLike) -> Complex:
    """E·(1 - Wpk), the steady error E of the coarse channel with a piezo commanded by it (paper 001, eq. 7)."""
    return np.asarray(np.asarray(coarse) * uncompensated(compensator))


def iterative(*errors: npt.ArrayLike) -> Complex:
    """E1·E2·…, the steady error of self-learning channels in the iterative structure (paper 001, eqs 11-13).

    Args:
        errors: δ/Xd of each channel by itself, coarsest first; one or more, shape (n,) each.
    """
    product = np.asarray(errors[0], dtype=np.complex128)
    for error in errors[1:]:
        product = product * np.asarray(error)
    return product


def contraction(q: npt.ArrayLike, z: npt.ArrayLike, gain: float = 1.0) -> Array:
    """|Q - γZ|, the factor by which a cycle shrinks what is left to learn; shape as given."""
    return np.abs(np.asarray(q) - gain * np.asarray(z))


def cycles(factor: npt.ArrayLike, fraction: float) -> Array:
    """Cycles after which ``fraction`` of what is to be learned is left; inf where the ``factor`` of a cycle is >= 1.

    Raises:
        InputError: the fraction is not between 0 and 1.
    """
    if not 0.0 < fraction < 1.0:
        raise InputError(f"cycles to reach the fraction {fraction:g}; allowed: between 0 and 1, ends excluded")
    factors = np.asarray(factor, dtype=np.float64)
    with np.errstate(divide="ignore"):  # a factor of 0 learns in one cycle, of 1 never
        # Without 1e-9, rounding would add a cycle where a whole number of them suffices exactly.
        count = np.ceil(math.log(fraction) / np.log(factors) - 1e-9)
    return np.where(factors < 1.0, np.maximum(count, 1.0), np.inf)


@dataclass(frozen=True)
class Peak:
    """Where a response is largest: frequency [rad/s] and magnitude there."""

    frequency: float
    magnitude: float


def supremum(response: Response, highest: float) -> Peak:
    """Largest magnitude of a response from 0 to ``highest`` [rad/s]; of Q - γZ it has to be below 1.

    The grid of 4097 frequencies finds a resonance that is wider than ``highest``/4096.
    """
    grid = np.linspace(0.0, highest, _GRID)
    magnitude = np.abs(response(grid))
    worst = int(np.argmax(magnitude))
    ends = float(grid[max(worst - 1, 0)]), float(grid[min(worst + 1, _GRID - 1)])
    near = scipy.optimize.minimize_scalar(lambda w: -abs(response(np.array([w]))[0]), bounds=ends, method="bounded")
    # The bounded search never looks at its ends, where a response without a resonance is largest.
    if -near.fun > magnitude[worst]:
        return Peak(float(near.x), float(-near.fun))
    return Peak(float(grid[worst]), float(magnitude[worst]))


def lead_errors(q: Response, z: Response, highest: float, gain: float = 1.0) -> tuple[float, float]:
    """How much too short and too long the lead may be: the changes of T0 [s] at which sup|Q - γZ| reaches 1.

    Args:
        q: Q.
        z: Z with the lead as designed; a change d of T0 makes it Z·e^{jωd}.
        highest: largest frequency looked at [rad/s].
        gain: γ.

    Returns:
        The negative and the positive limit [s], infinite if no lead is too long.

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
        # An eighth of a half turn at the highest frequency a step: no unstable range is stepped over.
        step = sign * math.pi / 8.0 / highest
        for k in range(1, _GRID):
            if excess(k * step) >= 0.0:
                return float(scipy.optimize.brentq(excess, (k - 1) * step, k * step, xtol=1e-12))
        return sign * math.inf

    return limit(-1.0), limit(1.0)


def limit_frequency(compensator: Response, highest: float, level: float = 1.0) -> float:
    """Frequency [rad/s] up to which direct compensation leaves less than ``level``: |1 - Wpk| < level.

    With the level 1 it is where compensation begins to do harm (paper 001, eq. 8; its eq. 9, |Wpk| < 2, follows from
    that but does not suffice). With 0.5 and a drive it is what paper 001 calls the bandwidth.

    Args:
        compensator: Wpk.
        highest: largest frequency looked at [rad/s].
        level: above 0.

    Returns:
        The lowest such frequency; inf if there is none up to ``highest``.
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
    """A self-learning channel in continuous time.

    Args:
        natural_frequency: ωn of the drive [rad/s].
        damping: ζ [1].
        delay: τ [s].
        lead_time: T0 [s].
        q_time: of Q [s].
        lead_lag: T1, T2 [s] of the series correction (1 + pT1)/(1 + pT2); equal ones are none.
    """

    natural_frequency: float
    damping: float
    delay: float
    lead_time: float
    q_time: float
    lead_lag: tuple[float, float] = (0.0, 0.0)

    def drive(self, frequency: npt.ArrayLike) -> Complex:
        """Wi, or Wpk, at ``frequency`` [rad/s]."""
        return second_order(frequency, self.natural_frequency, self.damping, self.delay)

    def q(self, frequency: npt.ArrayLike) -> Array:
        """Q at ``frequency`` [rad/s]."""
        return smoothing(frequency, self.q_time)

    def z(self, frequency: npt.ArrayLike) -> Complex:
        """Z = Wi/W0 at ``frequency`` [rad/s]."""
        correction = lead(frequency, self.lead_time) * lead_lag(frequency, *self.lead_lag)
        return np.asarray(self.drive(frequency) * correction)

    def factor(self, frequency: npt.ArrayLike) -> Complex:
        """Q - Z at ``frequency`` [rad/s]."""
        return np.asarray(self.q(frequency) - self.z(frequency))

    def steady_error(self, frequency: npt.ArrayLike) -> Complex:
        """(1 - Q)/(Z + 1 - Q) at ``frequency`` [rad/s]."""
        return steady_error(self.q(frequency), self.z(frequency))
