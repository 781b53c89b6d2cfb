# SPDX-License-Identifier: Apache-2.0
"""Angle, speed and acceleration of a spindle from the counts of its encoder: a Kalman filter.

    φ' = Ω,  Ω' = α,  α' = white noise

A count says that the angle lies within it. Where the spindle passes several counts in a sample, each sample measures
the angle to a count, and its middle is the measurement. Where a count lasts several samples, only its edges do, but
better: the edge was passed within the last sample.

The intensity of the noise follows from what the speed is expected to do: a deviation of relative amplitude d at the
frequency w has the third derivative d·Ω0·w² at most, which lasts about 1/w. The filter is then as fast as the counts
allow: its bandwidth is about (intensity/(variance of a measurement·time between two))^(1/6).
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]

_TURN = 2.0 * np.pi
_ROUNDING = 1e-18  # [rad²] variance of an ideal encoder
_LEAST_SPREAD = 0.2  # of the speed before the first sample, relative to the nominal one


class AngleFilterTable(NamedTuple):
    """The filter for kernels.

    Attributes:
        step: sampling step [s].
        quantum: angle of a count [rad]; 0: ideal.
        intensity: of the noise of dα/dt [rad²/s⁵].
        state: angle [rad], speed [rad/s], acceleration [rad/s²], shape (3,).
        covariance: of the state: φφ, φΩ, φα, ΩΩ, Ωα, αα, shape (6,).
        before: the measured angle of the last sample [rad], NaN before the first, shape (1,).
    """

    step: float
    quantum: float
    intensity: float
    state: Array
    covariance: Array
    before: Array


def angle_filter(step: float, counts: int, nominal: float, deviation: float, frequency: float) -> AngleFilterTable:
    """A filter before its first sample.

    Args:
        step: sampling step [s].
        counts: of the encoder per revolution; 0: ideal.
        nominal: speed Ω0 [rad/s].
        deviation: expected amplitude of the speed deviation, relative to Ω0.
        frequency: up to which it is expected [rad/s].
    """
    count = _TURN / counts if counts else 0.0
    acceleration = deviation * nominal * frequency
    spread = np.array([count**2, 0.0, 0.0, (_LEAST_SPREAD * nominal) ** 2, 0.0, acceleration**2])
    intensity = (acceleration * frequency) ** 2 / frequency
    return AngleFilterTable(step, count, intensity, np.array([0.0, nominal, 0.0]), spread, np.array([np.nan]))


@kernel
def follow(m: AngleFilterTable, measured: float) -> None:
    """Take the measured angle of the next sample [rad]; the state is then that of this sample."""
    step, state, p = m.step, m.state, m.covariance
    if np.isnan(m.before[0]):
        state[0] = measured + 0.5 * m.quantum
        m.before[0] = measured
        return
    half = 0.5 * step * step
    state[0] += step * state[1] + half * state[2]
    state[1] += step * state[2]
    p00 = p[0] + 2.0 * step * p[1] + 2.0 * half * p[2] + step * step * p[3] + 2.0 * step * half * p[4]
    p00 += half * half * p[5]
    p01 = p[1] + step * p[2] + step * p[3] + (step * step + half) * p[4] + half * step * p[5]
    p02 = p[2] + step * p[4] + half * p[5]
    p11 = p[3] + 2.0 * step * p[4] + step * step * p[5]
    p12 = p[4] + step * p[5]
    p22 = p[5] + m.intensity * step
    passed = state[1] * step
    every = m.quantum <= abs(passed)
    if every or measured != m.before[0]:
        width = m.quantum if every else passed
        spread = p00 + width * width / 12.0 + _ROUNDING
        off = measured + 0.5 * width - state[0]
        k0, k1, k2 = p00 / spread, p01 / spread, p02 / spread
        state[0] += k0 * off
        state[1] += k1 * off
        state[2] += k2 * off
        p22 -= k2 * p02
        p12 -= k1 * p02
        p11 -= k1 * p01
        p02 -= k0 * p02
        p01 -= k0 * p01
        p00 -= k0 * p00
    m.before[0] = measured
    p[0], p[1], p[2], p[3], p[4], p[5] = p00, p01, p02, p11, p12, p22


@kernel
def at(m: AngleFilterTable, later: float) -> tuple[float, float]:
    """Angle [rad] and speed [rad/s] so much ``later`` than the last sample [s], or earlier, at its acceleration."""
    angle, speed, acceleration = m.state[0], m.state[1], m.state[2]
    return angle + later * (speed + 0.5 * later * acceleration), speed + later * acceleration
