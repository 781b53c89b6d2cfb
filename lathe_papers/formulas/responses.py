# SPDX-License-Identifier: Apache-2.0
"""Frequency responses of drives, corrections and filters in continuous time.

Papers 000 and 001 calculate with these ideal responses. A cell runs discrete systems, which have their own responses
(`lathe_machine.plants.linear.DiscretePlant.response`); the formulas of `lathe_papers.formulas.structures` accept both.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array, Complex

Response = Callable[[Array], Complex]  #: function of frequencies [rad/s], shape (n,)


def second_order(frequency: npt.ArrayLike, natural_frequency: float, damping: float, delay: float = 0.0) -> Complex:
    """Return e^{-pτ}/(1 + 2ζp/ωn + p²/ωn²), a drive with its own loops closed (spec of papers 000 and 001).

    Args:
        frequency: frequencies [rad/s], any shape; the result has the same shape.
        natural_frequency: natural frequency ωn [rad/s].
        damping: damping ratio ζ [1].
        delay: delay τ [s].
    """
    p = 1j * np.asarray(frequency, dtype=np.float64)
    return np.asarray(np.exp(-p * delay) / (1.0 + 2.0 * damping * p / natural_frequency + (p / natural_frequency) ** 2))


def lead(frequency: npt.ArrayLike, time: float) -> Complex:
    """Return e^{pT0}, the lead by ``time`` [s] in the memory (paper 000, eq. 20), at ``frequency`` [rad/s]."""
    return np.asarray(np.exp(1j * np.asarray(frequency, dtype=np.float64) * time))


def lead_lag(frequency: npt.ArrayLike, lead_time: float, lag_time: float) -> Complex:
    """Return (1 + pT1)/(1 + pT2), a series correction with T1 and T2 in s, at ``frequency`` [rad/s]."""
    p = 1j * np.asarray(frequency, dtype=np.float64)
    return np.asarray((1.0 + p * lead_time) / (1.0 + p * lag_time))


def smoothing(frequency: npt.ArrayLike, time: float) -> Array:
    """Return Q = 1/(1 + (ω·time)²), the zero-phase filter with two-sided exponential kernel, at ``frequency`` [rad/s].

    Paper 001 writes Wф = Q - 1.
    """
    return np.asarray(1.0 / (1.0 + (np.asarray(frequency, dtype=np.float64) * time) ** 2))


def in_series(
    frequency: npt.ArrayLike,
    *,
    natural_frequency: float,
    damping: float,
    mass_ratio: float,
    carriage_natural_frequency: float,
    carriage_damping: float,
) -> Complex:
    """Return the ratio of tool motion to piezo command for a piezo on the coarse carriage (paper 001, Fig. 1b).

    The piezo pushes the tool of mass m off the carriage of mass M. The position loops of the carriage act like a spring
    and a damper. With Δ the piezo's stroke, x1 the carriage, μ = m/M and u the command:

        Δ'' + x1'' + 2ζωn·Δ' + ωn²·Δ = ωn²·u
        x1'' + 2ζ1ω1·x1' + ω1²·x1 = -μ·(Δ'' + x1'')

    The result is (Δ + x1)/u. With μ = 0 this is the parallel arrangement (Fig. 1a), the piezo alone.

    Args:
        frequency: frequencies [rad/s], any shape; the result has the same shape.
        natural_frequency: ωn of the piezo with the tool, on a rigid base [rad/s].
        damping: ζ of the piezo with the tool [1].
        mass_ratio: mass ratio μ [1].
        carriage_natural_frequency: ω1 of the closed coarse drive [rad/s].
        carriage_damping: ζ1 of the closed coarse drive [1].
    """
    p = 1j * np.asarray(frequency, dtype=np.float64)
    held = p**2 + 2.0 * carriage_damping * carriage_natural_frequency * p + carriage_natural_frequency**2
    recoil = -mass_ratio * p**2 / (held + mass_ratio * p**2)  # x1/Δ
    own = natural_frequency**2 + 2.0 * damping * natural_frequency * p + p**2
    return np.asarray(natural_frequency**2 * (1.0 + recoil) / (own + recoil * p**2))
