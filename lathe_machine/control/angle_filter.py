# SPDX-License-Identifier: Apache-2.0
"""Kalman filter for angle, speed and acceleration of a spindle from its encoder counts.

    φ' = Ω,  Ω' = α,  α' = γ,  γ' = white noise

A count bounds the angle to an interval. If the spindle passes several counts in a sample, each sample measures the
angle to one count, and the middle of the interval is the measurement. If a count lasts several samples, only its edges
are measurements, but more accurate ones: the edge was passed within the last sample. Such an encoder does not resolve
γ, and α' is modelled as white noise instead.

The intensity of the noise follows from the expected deviation of the speed: with the relative amplitude d at the
frequency w, its derivative of order k is d·Ω0·w^k and lasts about 1/w. The filter is then as fast as the counts allow.

The filter models the rounding to a count as white noise. This is wrong where the counts per sample c are near a ratio
p/m of small integers: the rounding then repeats every m samples except for a beat of m·|c - p/m| per sample, which the
filter follows if the beat is slow enough. The time of the last edge (`lathe_machine.signals.edge_time`) gives the angle
at each sample to the turn in a tick of its clock, for any c.
"""

from collections.abc import Collection
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.jit import inlined, kernel

_TURN = 2.0 * np.pi
_ROUNDING = 1e-18  # [rad²] variance of an ideal encoder
_LEAST_SPREAD = 0.2  # of the speed before the first sample, relative to the nominal one
# Largest beat that the filter follows, over its bandwidth; by simulation at 16 and 64 kHz, 1000 and 3000 rpm.
_FOLLOWED = 1.75


class AngleFilterTable(NamedTuple):
    """Parameters and state of the angle filter for kernels.

    Attributes:
        step: sampling step [s].
        quantum: angle of a count, or of a tick of the edges' clock, by which a reading is rounded down [rad]; 0 for an
            ideal encoder.
        order: number of states: 4, or 3 without γ.
        intensity: noise intensity of the last state, per second.
        state: φ [rad], Ω [rad/s], α [rad/s²], γ [rad/s³], shape (4,).
        covariance: covariance of the state, shape (4, 4).
        before: measured angle of the last sample [rad], NaN before the first, shape (1,).
    """

    step: float
    quantum: float
    order: int
    intensity: float
    state: Array
    covariance: Array
    before: Array


def angle_filter(
    step: float, counts: int, nominal: float, deviation: float, frequency: float, edge_clock: float = 0.0
) -> AngleFilterTable:
    """Create an angle filter in its initial state.

    Args:
        step: sampling step [s].
        counts: encoder counts per revolution; 0 for an ideal encoder.
        nominal: nominal speed Ω0 [rad/s].
        deviation: expected amplitude of the speed deviation, relative to Ω0.
        frequency: highest expected frequency of the deviation [rad/s].
        edge_clock: resolution of the time stamps of the encoder's edges [s]; 0: there are none.
    """
    quantum = _TURN / counts if counts else 0.0
    if edge_clock:
        quantum = min(quantum, nominal * edge_clock)
    order = 4 if quantum <= nominal * step else 3
    spread = deviation * nominal * frequency ** np.arange(4.0)  # of Ω and its derivatives
    variances = np.array([quantum, _LEAST_SPREAD * nominal, spread[1], spread[2]]) ** 2
    variances[order:] = 0.0
    intensity = float(spread[order - 1] ** 2 / frequency)
    state = np.array([0.0, nominal, 0.0, 0.0])
    return AngleFilterTable(step, quantum, order, intensity, state, np.diag(variances), np.array([np.nan]))


def counts_per_sample(filter_: AngleFilterTable, speed: float) -> float:
    """Compute the encoder counts per sample at a speed [rad/s]; 0 for an ideal encoder."""
    return speed * filter_.step / filter_.quantum if filter_.quantum else 0.0


def followed_ratio(filter_: AngleFilterTable, low: float, high: float, ratios: Collection[Fraction]) -> Fraction | None:
    """Find a ratio of counts per sample whose beat is slow enough to be followed by the filter.

    Args:
        filter_: angle filter in its initial state.
        low: lowest speed of the spindle [rad/s].
        high: highest speed of the spindle [rad/s].
        ratios: ratios of counts per sample to check.

    Returns:
        The ratio with the smallest product of numerator and denominator; None if no ratio is near.
    """
    if not filter_.quantum:
        return None
    passed = counts_per_sample(filter_, float(filter_.state[1]))
    width = filter_.quantum * min(passed, 1.0)  # of a reading; one reading per 1/c samples if c is below 1
    power = width**2 / 12.0 * filter_.step / min(passed, 1.0)
    bandwidth = (filter_.intensity / power) ** (0.5 / filter_.order)  # [rad/s]
    beat = _FOLLOWED * bandwidth * filter_.step / _TURN  # per sample
    slowest, fastest = counts_per_sample(filter_, low), counts_per_sample(filter_, high)
    near = [each for each in ratios if slowest - beat / each.denominator < each < fastest + beat / each.denominator]
    return min(near, key=lambda each: (each.numerator * each.denominator, each), default=None)


@inlined
def _advance(step: float, p: Array) -> None:
    """Propagate the covariance to the next sample, F·P·Fᵀ in place."""
    # Each row adds only rows below it, which are still unchanged; then the columns likewise.
    half, sixth = 0.5 * step * step, step * step * step / 6.0
    for j in range(4):
        p[0, j] += step * p[1, j] + half * p[2, j] + sixth * p[3, j]
        p[1, j] += step * p[2, j] + half * p[3, j]
        p[2, j] += step * p[3, j]
    for i in range(4):
        p[i, 0] += step * p[i, 1] + half * p[i, 2] + sixth * p[i, 3]
        p[i, 1] += step * p[i, 2] + half * p[i, 3]
        p[i, 2] += step * p[i, 3]


@kernel
def follow(m: AngleFilterTable, measured: float) -> None:
    """Update the state with the measured angle of the next sample [rad]."""
    step, state, p = m.step, m.state, m.covariance
    if np.isnan(m.before[0]):
        state[0] = measured + 0.5 * m.quantum  # the middle of the count
        m.before[0] = measured
        return
    state[0], state[1], state[2] = at(m, step)
    _advance(step, p)
    p[m.order - 1, m.order - 1] += m.intensity * step
    passed = state[1] * step
    every = m.quantum <= abs(passed)
    if every or measured != m.before[0]:
        # If a count lasts several samples, its edge is known to within the angle of one sample.
        width = m.quantum if every else passed
        spread = p[0, 0] + width * width / 12.0 + _ROUNDING
        off = (measured + 0.5 * width - state[0]) / spread
        for i in range(4):
            state[i] += p[i, 0] * off
        # From the last element to the first: row 0, used by all others, changes last.
        for i in range(3, -1, -1):
            for j in range(3, i - 1, -1):
                p[i, j] -= p[0, i] * p[0, j] / spread
                p[j, i] = p[i, j]
    m.before[0] = measured


@kernel
def at(m: AngleFilterTable, later: float) -> tuple[float, float, float]:
    """Predict angle [rad], speed [rad/s] and acceleration [rad/s²] at a time ``later`` [s] after the last sample."""
    angle, speed, acceleration, jerk = m.state[0], m.state[1], m.state[2], m.state[3]
    turned = later * (speed + later * (acceleration / 2.0 + later * jerk / 6.0))
    return angle + turned, speed + later * (acceleration + later * jerk / 2.0), acceleration + later * jerk
