# SPDX-License-Identifier: Apache-2.0
"""Formulas of the learning loop: stability, contraction, steady-state error.

In one cycle the loop multiplies the component of the memory at ν waves per revolution by Q(ν) - γ·Z(νΩ)
(paper 001, eqs 1-5; Z = Wi/W0 is the drive with lead and correction). It converges when sup|Q - γZ| < 1 over all ν
up to the grid's Nyquist limit. Q, Z and the interpolators are modelled as implemented, not as their continuous ideals.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lathe_machine.control.correction import Correction, CorrectionLaw
from lathe_machine.control.interpolation import cubic_response, derivative_responses
from lathe_machine.control.q_filter import QFilter
from lathe_machine.plants.linear import Constant
from lathe_rc.analysis.cycle_factors import Response, highest_waves, poles_in_waves, supremum
from lathe_rc.arrays import Array, Complex


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
