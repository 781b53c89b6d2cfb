# SPDX-License-Identifier: Apache-2.0
"""Formulas of the learning loop: stability, contraction, steady error.

The loop maps what the memory holds at ν waves per revolution to (Q(ν) - γ·Z(νΩ))·itself in a cycle
(paper 001, eqs 1-5; Z = Wi/W0 is the drive with the lead). It converges when sup|Q - γZ| < 1 over all ν up to
the grid's Nyquist limit. Q, Z and the interpolators are taken as they run, not as their continuous ideals.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Response = Callable[[Array], Complex]

_COARSE, _FINE = 257, 65  # points over all waves, then around the worst of them


def q_response(q: Array, radians: Array) -> Array:
    """Response of a zero-phase filter with weights q_0, q_±1, ... at ``radians`` per point, shape (n,)."""
    lags = np.arange(1, q.size)
    return np.asarray(q[0] + 2.0 * np.cos(np.outer(radians, lags)) @ q[1:])


def cubic_response(radians: Array) -> Array:
    """Response of Lagrange cubic interpolation at ``radians`` per point, mean over the place between points.

    The interpolator also makes images at multiples of the sampling rate less this frequency; the drive
    attenuates those and they are left out here.
    """
    u, weight = np.polynomial.legendre.leggauss(8)
    u, weight = (u + 1.0) / 2.0, weight / 2.0
    taps = np.stack(
        (
            -u * (1 - u) * (2 - u) / 6,
            (1 - u * u) * (2 - u) / 2,
            u * (1 + u) * (2 - u) / 2,
            -u * (1 - u * u) / 6,
        )
    )
    distance = np.arange(-1, 3)[:, None] - u
    phase = np.cos(distance[None] * radians[:, None, None])
    return np.asarray((phase * taps * weight).sum(axis=(1, 2)))


@dataclass(frozen=True)
class LearningLoop:
    """One self-learning channel.

    Args:
        drive: response of the drive's position to its command at a frequency [rad/s].
        q: weights of Q on the grid.
        grid: memory points per revolution.
        gain: learning gain γ.
        lead_time: T0 [s]; the lead angle is T0·Ω for the variable law.
        nominal: nominal speed Ω0 [rad/s].
        variable_lead: False for the constant lead angle T0·Ω0.
        step: sampling step [s].
    """

    drive: Response
    q: Array
    grid: int
    gain: float
    lead_time: float
    nominal: float
    variable_lead: bool
    step: float

    def corrected_drive(self, waves: Array, speed: float) -> Complex:
        """Z at ``waves`` per revolution and spindle ``speed`` [rad/s]: drive, lead and both interpolators."""
        frequency = waves * speed
        lead = self.lead_time * (speed if self.variable_lead else self.nominal)
        interpolators = cubic_response(2 * np.pi * waves / self.grid) * cubic_response(frequency * self.step)
        return np.asarray(self.drive(frequency) * np.exp(1j * waves * lead) * interpolators)

    def operator(self, waves: Array, speed: float) -> Complex:
        """Q - γZ, the factor of a cycle, at ``waves`` per revolution, shape (n,)."""
        q = q_response(self.q, 2 * np.pi * waves / self.grid)
        return np.asarray(q - self.gain * self.corrected_drive(waves, speed))

    def supremum(self, speed: float) -> float:
        """Supremum of the magnitude of Q - γZ at ``speed`` [rad/s], over all waves up to the Nyquist limits."""
        highest = min(self.grid / 2, np.pi / (self.step * speed))
        waves = np.linspace(0.0, highest, _COARSE)
        worst = waves[np.argmax(np.abs(self.operator(waves, speed)))]
        beside = highest / (_COARSE - 1)
        near = np.linspace(max(worst - beside, 0.0), min(worst + beside, highest), _FINE)
        return float(np.abs(self.operator(near, speed)).max())

    def steady_error(self, waves: Array, speed: float) -> Complex:
        """δ/Xd = (1 - Q)/(γZ + 1 - Q), what is left after many cycles (paper 001, eq. 3), shape (n,)."""
        q = q_response(self.q, 2 * np.pi * waves / self.grid)
        return np.asarray((1.0 - q) / (self.gain * self.corrected_drive(waves, speed) + 1.0 - q))
