# SPDX-License-Identifier: Apache-2.0
"""Corrections 1/W0 between the memory and the drive (papers 000 and 001).

    none                          the lead alone
    lead_lag                      (1 + pT1)/(1 + pT2) in addition to the lead
    second_order_inverse          1 + a1·p + a2·p² of the memory, with p² = Ω²s²  (s = d/dφ; exact at constant speed)
    second_order_inverse_dynamic  the same with p² = Ω²s² + (dΩ/dt)·s
    exact                         Wk2, then Wk1 (000, eqs 13-14): the drive model with constant parameters in the
                                  angle domain, then its inverse in time
    fir                           Σ hk·e^{-pkT'}: the memory read with a lead of its own for each tap hk, from T0
                                  in steps of T' back; an inverse of a response (`lathe_commission.fir_inverse`)

The drive model is e^{-pτ}/(1 + a1·p + a2·p²) with a1 = 2ζ/ωn and a2 = 1/ωn²; the lead compensates its delay τ.
"""

from dataclasses import dataclass
from enum import IntEnum

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel


class CorrectionLaw(IntEnum):
    """Correction law between memory and drive, see `lathe_machine.control.correction`."""

    NONE = 0
    LEAD_LAG = 1
    SECOND_ORDER_INVERSE = 2
    SECOND_ORDER_INVERSE_DYNAMIC = 3
    EXACT = 4
    FIR = 5


@dataclass(frozen=True)
class Correction:
    """Correction 1/W0 with its drive model.

    Args:
        law: correction law.
        natural_frequency: ωn of the drive model [rad/s].
        damping: ζ of the drive model.
        lead: T1 of the lead-lag term [s].
        lag: T2 of the lead-lag term [s]; above 0 for the law LEAD_LAG.
        taps: hk of the law FIR.
        interval: T' between its taps [s].

    Raises:
        InputError: the lead-lag term has no lag, or the FIR filter no taps.
    """

    law: CorrectionLaw
    natural_frequency: float
    damping: float
    lead: float = 0.0
    lag: float = 0.0
    taps: tuple[float, ...] = ()
    interval: float = 0.0

    def __post_init__(self) -> None:
        if self.law is CorrectionLaw.LEAD_LAG and not self.lag > 0.0:
            raise InputError(f"lag = {self.lag:g} s with correction lead_lag; allowed: above 0")
        if self.law is CorrectionLaw.FIR and not (self.taps and self.interval > 0.0):
            raise InputError(
                f"{len(self.taps)} taps in steps of {self.interval:g} s with correction fir; allowed: 1 or more, "
                "in steps above 0"
            )

    @property
    def span(self) -> float:
        """Time from the first tap to the last one of the law FIR [s]; 0 for other laws."""
        return self.interval * (len(self.taps) - 1) if self.law is CorrectionLaw.FIR else 0.0

    @property
    def inverse(self) -> tuple[float, float]:
        """Coefficients a1 [s] and a2 [s²] of the inverse drive model 1 + a1·p + a2·p²."""
        return 2.0 * self.damping / self.natural_frequency, 1.0 / self.natural_frequency**2

    @property
    def looks_ahead(self) -> int:
        """Number of grid points after the read position that the interpolation uses."""
        return 4 if self.law in (CorrectionLaw.SECOND_ORDER_INVERSE, CorrectionLaw.SECOND_ORDER_INVERSE_DYNAMIC) else 2


@kernel
def invariant(
    y: float, before: float, distance: float, rate: float, bend: float, a1: float, a2: float, nominal: float, v: Array
) -> float:
    """Compute the set point of the next sample by Wk2 and then Wk1 (law EXACT).

    Wk2 is a2Ω0²·v'' + a1Ω0·v' + v = Y with derivatives with respect to the angle (fourth-order Runge-Kutta, with Y
    linear from ``before`` to ``y`` over ``distance`` [rad]). Wk1 is v + a1·dv/dt + a2·d²v/dt², where ``rate`` and
    ``bend`` are the first and second time derivatives of the angle; v' and v'' follow from Wk2 without numerical
    differentiation. ``v`` contains v and v'.
    """
    b1, b2 = a1 * nominal, a2 * nominal**2
    middle, half = 0.5 * (before + y), 0.5 * distance
    x1, s1 = v[1], (before - v[0] - b1 * v[1]) / b2
    x2 = v[1] + half * s1
    s2 = (middle - (v[0] + half * x1) - b1 * x2) / b2
    x3 = v[1] + half * s2
    s3 = (middle - (v[0] + half * x2) - b1 * x3) / b2
    x4 = v[1] + distance * s3
    s4 = (y - (v[0] + distance * x3) - b1 * x4) / b2
    v[0] += distance / 6.0 * (x1 + 2.0 * (x2 + x3) + x4)
    v[1] += distance / 6.0 * (s1 + 2.0 * (s2 + s3) + s4)
    second = (y - v[0] - b1 * v[1]) / b2
    return float(v[0] + a1 * rate * v[1] + a2 * (rate**2 * second + bend * v[1]))
