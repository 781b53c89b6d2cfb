# SPDX-License-Identifier: Apache-2.0
"""Formulas of the learning loop: stability, contraction, steady-state error.

In one cycle the loop multiplies the component of the memory at ν waves per revolution by Q(ν) - γ·Z(νΩ)
(paper 001, eqs 1-5; Z = Wi/W0 is the drive with lead and correction). It converges when sup|Q - γZ| < 1 over all ν
up to the grid's Nyquist limit. Q, Z and the interpolators are modelled as implemented, not as their continuous ideals.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from lathe_rc.control.correction import Correction, CorrectionLaw
from lathe_rc.control.interpolation import cubic_response, derivative_responses
from lathe_rc.control.q_filter import QFilter
from lathe_rc.jit import kernel
from lathe_rc.plants.linear import Constant

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Response = Callable[[Array], Complex]

_COARSE, _FINE, _PEAKS = 1025, 65, 3  # points over all waves, then around each of the worst peaks


def supremum(operator: Callable[[Array], Complex], highest: float) -> tuple[float, float]:
    """Compute the supremum of a cycle factor's magnitude, and the waves per revolution at which it occurs.

    Args:
        operator: factor of a cycle as a function of the waves per revolution, shape (n,).
        highest: highest waves per revolution.
    """
    waves = _waves_up_to(highest)
    near = _near_peaks(waves, np.abs(operator(waves)))
    if near.size == 1:
        return float("nan"), float(near[0])
    fine = np.abs(operator(near))
    return float(fine.max()), float(near[np.argmax(fine)])


@kernel
def _near_peaks(waves: Array, size: Array) -> Array:
    """Return a fine grid of waves around the highest peaks of ``size``, including peaks at the ends.

    If ``size`` is not finite somewhere, only the first such wave is returned.
    """
    last = waves.size - 1
    heights, places = np.full(_PEAKS, -np.inf), np.zeros(_PEAKS, np.int64)  # in rising order, by insertion
    for k in range(last + 1):
        if not size[k] < np.inf:
            return np.array([waves[k]])
        if k in (0, last) or (size[k] >= size[k - 1] and size[k] >= size[k + 1]):
            below = 0
            while below < _PEAKS and size[k] >= heights[below]:
                if below:
                    heights[below - 1], places[below - 1] = heights[below], places[below]
                heights[below], places[below] = size[k], k
                below += 1
    near = np.empty(_PEAKS * _FINE)
    for i in range(near.size):
        wave = waves[places[i // _FINE]] + (2.0 * (i % _FINE) / (_FINE - 1) - 1.0) * waves[1]
        near[i] = min(max(wave, 0.0), waves[last])
    return near


@lru_cache(maxsize=64)
def _waves_up_to(highest: float) -> Array:
    """Return the waves per revolution of the coarse search for peaks."""
    waves = np.linspace(0.0, highest, _COARSE)
    waves.setflags(write=False)
    return waves


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
        if law is CorrectionLaw.LEAD_LAG:
            factor = (1 + p * correction.lead) / (1 + p * correction.lag)
        else:
            angular = 1j * waves * self.nominal
            factor = (1 + a1 * p + a2 * p**2) / (1 + a1 * angular + a2 * angular**2)
        return np.asarray(cubic_response(radians) * factor)

    def corrected_drive(self, waves: Array, speed: float) -> Complex:
        """Compute Z (drive, lead, correction, interpolators) at ``waves`` per revolution and a ``speed`` [rad/s]."""
        frequency = waves * speed
        lead = self.lead_time * (speed if self.variable_lead else self.nominal) + self.constant_lead
        measured = cubic_response(frequency * self.step)
        return np.asarray(self.drive(frequency) * np.exp(1j * waves * lead) * self._correction(waves, speed) * measured)

    def operator(self, waves: Array, speed: float) -> Complex:
        """Compute the factor Q - γZ of a cycle at ``waves`` per revolution, shape (n,)."""
        q = self.q.response(2 * np.pi * waves / self.grid)
        return np.asarray(q - self.gain * self.corrected_drive(waves, speed))

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
    highest = min(loop.grid / 2, np.pi / (loop.step * speed))
    return supremum(lambda waves: loop.operator(waves, speed), highest)


_worst_of_alike = lru_cache(maxsize=256)(_worst)
