# SPDX-License-Identifier: Apache-2.0
"""Conditions of hyperstability of the periodic law over the box of drives (paper 002, eqs 1 and 12-15).

A drive is a row K, a1, a2, a3, a4 of eq. 1; an array of m drives has the shape (m, 5). With the filter on y, a drive
has the transfer function

    G(p) = K·(T·p + 1)³/((p⁴ + a4·p³ + a3·p² + a2·p + a1)·(T*·p + 1)³)

and with the feedback χ* it becomes G/(1 + χ*·G), the linear part of eq. 13, whose real part has the sign of Re(1/G) +
χ*. At any frequency Re(1/G) is linear in a1 ... a4 and in 1/K, so its minimum over the box is at a corner.

The paper neglects T*, so that G is of first order at high frequencies. With T* it is of fourth order.
"""

import itertools
from dataclasses import dataclass

import control
import numpy as np

from lathe_machine.control.periodic import PeriodicGains
from lathe_machine.plants.feed_models import fourth_order
from lathe_machine.transfer import TransferFunction
from lathe_rc.arrays import Array, Complex

NAMES = ("K", "a1", "a2", "a3", "a4")
NOMINAL = np.array([19.0, 21.5, 48.0, 46.9, 10.2])  #: eq. 19
BOX = np.array([[18.6, 19.5], [18.4, 23.5], [41.4, 64.0], [45.7, 50.0], [8.5, 16.5]])  #: minimum and maximum, eq. 1

_FREQUENCIES = np.geomspace(1e-2, 1e5, 7001)  # [rad/s]
_LEVELS = np.linspace(0.0, 1.0, 11)  # levels of sat(y_F)


def corners() -> Array:
    """Return the 32 corners of the box, shape (32, 5)."""
    return np.array(list(itertools.product(*BOX)))


def plant(drive: Array) -> TransferFunction:
    """Return the transfer function of eq. 1 for one drive, shape (5,)."""
    return fourth_order(*map(float, drive))


def inverse_response(drives: Array, lead: float, lag: float, frequency: Array) -> Complex:
    """Return 1/G of each drive at ``frequency`` [rad/s], shape (m, n).

    ``frequency`` has the shape (n,); ``lead`` T and ``lag`` T* are in s.
    """
    p = 1j * frequency
    gain, a1, a2, a3, a4 = drives.T[:, :, None]
    return np.asarray(
        (p**4 + a4 * p**3 + a3 * p**2 + a2 * p + a1) * (1.0 + lag * p) ** 3 / (gain * (1.0 + lead * p) ** 3)
    )


@dataclass(frozen=True)
class Positivity:
    """Positivity condition of eq. 14 on χ*.

    Attributes:
        least_gain: smallest χ* with Re(1/G) + χ* > 0 for all drives and frequencies [1].
        drive: drive that requires ``least_gain``, shape (5,).
        frequency: frequency that requires ``least_gain`` [rad/s]; infinite if only the high-frequency limit does.
        hurwitz_gain: largest χ* up to which A* is Hurwitz for all drives [1].
    """

    least_gain: float
    drive: Array
    frequency: float
    hurwitz_gain: float

    @property
    def possible(self) -> bool:
        """Whether any χ* satisfies eq. 14."""
        return self.least_gain < self.hurwitz_gain


def _largest_hurwitz_gain(drive: Array, lead: float, lag: float) -> float:
    """Return the χ* beyond which A* has a pole in the right half-plane; infinite if there is none."""
    gain, a1, a2, a3, a4 = drive
    bottom = np.polymul([1.0, a4, a3, a2, a1], np.poly([-1.0 / lag] * 3) * lag**3 if lag else [1.0])
    loop = control.TransferFunction(gain * lead**3 * np.poly([-1.0 / lead] * 3), bottom)
    margins, *_ = control.stability_margins(loop, returnall=True)
    # Stability does not change beyond the last margin. With first order at high frequencies, all large χ* are stable.
    return float(np.max(margins)) if lag and len(margins) else np.inf


def positivity(drives: Array, lead: float, lag: float) -> Positivity:
    """Evaluate eq. 14 for several drives, shape (m, 5).

    Args:
        drives: rows of K, a1 ... a4; the corners represent the box.
        lead: time constant T [s].
        lag: time constant T* [s]; the paper assumes 0.
    """
    real = inverse_response(drives, lead, lag, _FREQUENCIES).real
    frequency = _FREQUENCIES
    if not lag:
        # p/(K·T³) + (a4 - 3/T)/(K·T³) at high frequencies
        limit = (drives[:, 4] - 3.0 / lead) / (drives[:, 0] * lead**3)
        real, frequency = np.column_stack((real, limit)), np.append(frequency, np.inf)
    which, at = np.unravel_index(np.argmin(real), real.shape)
    hurwitz = min(_largest_hurwitz_gain(drive, lead, lag) for drive in drives)
    return Positivity(-float(real[which, at]), drives[which], float(frequency[at]), hurwitz)


def required_input(drives: Array, derivatives: Array, disturbance: Array) -> Array:
    """Return u°, the input that keeps y at r: (r'''' + a4·r''' + a3·r'' + a2·r' + a1·r)/K - f (eq. 5).

    Args:
        drives: rows of K, a1 ... a4, shape (m, 5).
        derivatives: r and its first four derivatives, shape (5, n) [1, 1/s, …].
        disturbance: disturbance f, shape (n,).

    Returns:
        Array of shape (m, n).
    """
    # a1 ... a4 belong to r ... r''', and the fourth derivative has the factor 1.
    weights = np.column_stack((drives[:, 1:], np.ones(len(drives)))) / drives[:, :1]
    return np.asarray(weights @ derivatives - disturbance)


def popov_bound(gains: PeriodicGains, reference_gain: float, theta: Array, step_s: float) -> float:
    """Return -η0 of eq. 15 [s] for a switch that stays at 1.

    With w = u1 - θ, the memory contributes ∫w·v = (∫w² over the last period - ∫θ² over one period)/(2·h0) + h0/2·∫v²,
    and the adaptive gain ∫(h11·I + χ*) dI ≥ -χ*²/(2·h11); the other terms are not negative.

    Args:
        gains: gains of the law, of which h0 and h11 are used.
        reference_gain: reference gain χ*.
        theta: θ = χ*·r̂ + u° over a period, shape (n,).
        step_s: sampling step of ``theta`` [s].
    """
    return float(-np.sum(theta**2) * step_s / (2.0 * gains.h0) - reference_gain**2 / (2.0 * gains.h11))


def learning_factor(drives: Array, gains: PeriodicGains, level: float, memory_filter: float, frequency: Array) -> Array:
    """Return the factor by which the memory error changes per period, |Q·(1 - h0·G/(1 + k·G))|.

    Here k = h0 + s²·(h12 + h11/p). The factor holds for the linear system with constant y_F and δ̃ = 1; where it
    exceeds 1, the memory grows at that frequency.

    Args:
        drives: rows of K, a1 ... a4, shape (m, 5).
        gains: gains of the law.
        level: level s = sat(y_F), 0 to 1.
        memory_filter: σ of Q = exp(-(σω)²/2) [s]; 0 for none.
        frequency: frequencies [rad/s], shape (n,).

    Returns:
        Array of shape (m, n).
    """
    inner = gains.h0 + level**2 * (gains.h12 + gains.h11 / (1j * frequency))
    inverse = inverse_response(drives, gains.lead, gains.lag, frequency)
    q = np.exp(-0.5 * (memory_filter * frequency) ** 2)
    return np.asarray(q * np.abs(1.0 - gains.h0 / (inverse + inner)))


@dataclass(frozen=True)
class Learning:
    """Learning behaviour of the memory over all drives and all levels of y_F.

    Attributes:
        grows_from: smallest and largest onset frequency over drives and levels [rad/s]; above the onset, the memory
            grows without the filter.
        largest: largest factor per period with the filter [1].
        drive: drive with the largest factor, shape (5,).
        level: sat(y_F) of the largest factor.
        frequency: frequency of the largest factor [rad/s].
    """

    grows_from: tuple[float, float]
    largest: float
    drive: Array
    level: float
    frequency: float


def learning(drives: Array, gains: PeriodicGains, memory_filter: float) -> Learning:
    """Evaluate the learning behaviour of the memory over all levels of y_F; arguments as in `learning_factor`."""
    bare = np.stack([learning_factor(drives, gains, level, 0.0, _FREQUENCIES) for level in _LEVELS])
    # At high frequencies the factor approaches 1 from above or below, and rounding would decide the comparison.
    above = bare > 1.0 + 1e-6
    first = _FREQUENCIES[np.argmax(above, axis=-1)][above.any(axis=-1)]
    factor = bare * np.exp(-0.5 * (memory_filter * _FREQUENCIES) ** 2)
    level, which, at = np.unravel_index(np.argmax(factor), factor.shape)
    return Learning(
        (float(first.min()), float(first.max())) if first.size else (np.inf, np.inf),
        float(factor[level, which, at]),
        drives[which],
        float(_LEVELS[level]),
        float(_FREQUENCIES[at]),
    )
