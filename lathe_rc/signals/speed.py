# SPDX-License-Identifier: Apache-2.0
"""Spindle speed laws as closed-form functions of time.

The laws depend on time alone, so angle, speed and acceleration at sample n do not depend on the samples before it:

    Ω(t) = Ω0·(1 + Σ a_i·sin(ω_i·(t − t_i) + ψ_i) + d(t)),   line i starting at t_i,

where d(t) is a piecewise-linear tachogram. A band-limited random deviation is a sum of such lines with seeded
phases. Source: paper 000, eq. (11) and the deviation of its Fig. 6.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.checks import stacked
from lathe_rc.signals.noise import random_lines

_MOST_SAMPLES = 2**53  # largest integer range of a double
_PACKED_LINES = 4  # rows of SpeedLaw.lines: amplitude [1], frequency [rad/s], phase [rad], start [s]


@inlined
def evaluate(t: float, nominal: float, lines: Array, tachogram: Array) -> tuple[float, float, float]:
    """Return angle [rad], speed [rad/s] and acceleration [rad/s²] at time ``t`` [s].

    ``lines`` has shape (4, n): relative amplitude, frequency, phase and start. ``tachogram`` has shape (3, m): time,
    relative deviation, and the integral of the deviation up to that time.
    """
    angle, speed, acceleration = t, 1.0, 0.0
    for i in range(lines.shape[1]):
        since = t - lines[3, i]
        if since >= 0.0:
            a, w, phase = lines[0, i], lines[1, i], lines[2, i]
            sine, cosine = np.sin(w * since + phase), np.cos(w * since + phase)
            angle += a / w * (np.cos(phase) - cosine)
            speed += a * sine
            acceleration += a * w * cosine
    last = tachogram.shape[1] - 1
    if last >= 0:
        if t <= tachogram[0, 0]:
            angle += tachogram[1, 0] * t
            speed += tachogram[1, 0]
        elif t >= tachogram[0, last]:
            angle += tachogram[2, last] + tachogram[1, last] * (t - tachogram[0, last])
            speed += tachogram[1, last]
        else:
            i = np.searchsorted(tachogram[0], t, side="right") - 1
            since = t - tachogram[0, i]
            slope = (tachogram[1, i + 1] - tachogram[1, i]) / (tachogram[0, i + 1] - tachogram[0, i])
            angle += tachogram[2, i] + (tachogram[1, i] + 0.5 * slope * since) * since
            speed += tachogram[1, i] + slope * since
            acceleration += slope
    return nominal * angle, nominal * speed, nominal * acceleration


@kernel
def evaluate_along(
    first: int, step: float, nominal: float, lines: Array, tachogram: Array, angle: Array, speed: Array
) -> None:
    """Fill angle [rad] and speed [rad/s], starting at sample ``first``, shape (n,); see `evaluate`."""
    if lines.shape[1] == 0 and tachogram.shape[1] == 0:  # bit-identical to `evaluate`, without its branches
        for k in range(angle.size):
            angle[k] = nominal * ((first + k) * step)
            speed[k] = nominal
    else:
        for k in range(angle.size):
            angle[k], speed[k], _ = evaluate((first + k) * step, nominal, lines, tachogram)


@kernel
def _evaluate_many(t: Array, nominal: float, lines: Array, tachogram: Array) -> Array:
    """Return the rows angle [rad], speed [rad/s] and acceleration [rad/s²] at times [s], shape (3, n)."""
    out = np.empty((3, t.size))
    for n in range(t.size):
        out[0, n], out[1, n], out[2, n] = evaluate(t[n], nominal, lines, tachogram)
    return out


@dataclass(frozen=True)
class SpeedLaw:
    """Spindle speed law: a nominal speed with harmonic and tabulated deviations.

    Args:
        nominal: nominal speed Ω0 [rad/s].
        lines: rows relative amplitude [1], frequency [rad/s], phase [rad] and start [s], shape (4, n).
        tachogram: rows time [s], relative deviation [1] and its integral from time 0 [s], shape (3, m).
    """

    nominal: float
    lines: Array = field(default_factory=lambda: np.empty((_PACKED_LINES, 0)))
    tachogram: Array = field(default_factory=lambda: np.empty((3, 0)))

    def __add__(self, other: "SpeedLaw") -> "SpeedLaw":
        """Add the deviations of two laws with the same nominal speed; at most one has a tachogram."""
        if self.nominal != other.nominal:
            raise InputError(f"speed laws of {self.nominal} and {other.nominal} rad/s cannot be added")
        if self.tachogram.size and other.tachogram.size:
            raise InputError("two tachograms cannot be added: merge their breakpoints into one")
        lines = np.concatenate((self.lines, other.lines), axis=1)
        return SpeedLaw(self.nominal, lines, self.tachogram if self.tachogram.size else other.tachogram)

    def at(self, t: npt.ArrayLike) -> Array:
        """Return the rows angle [rad], speed [rad/s] and acceleration [rad/s²] at times ``t`` [s], shape (3, n)."""
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        return _evaluate_many(times, self.nominal, self.lines, self.tachogram)

    def speed_range(self, duration: float = np.inf) -> tuple[float, float]:
        """Return the lowest and highest speed [rad/s] within ``duration`` [s], or safe bounds for an endless run."""
        lines, tachogram = self.lines, self.tachogram
        amplitude = float(np.abs(lines[0]).sum())
        below, above = (tachogram[1].min(), tachogram[1].max()) if tachogram.size else (0.0, 0.0)
        bound = self.nominal * (1 + below - amplitude), self.nominal * (1 + above + amplitude)
        fastest = float(lines[1].max(initial=0.0))
        points = duration * fastest * 8  # about 50 points per period of the fastest line
        if not lines.size or not points < 1e7:
            return bound
        times = np.linspace(0.0, duration, int(points) + 2)
        # A line that does not start from 0 makes the speed jump, so both sides are evaluated.
        kinks = np.concatenate((tachogram[0], lines[3], np.nextafter(lines[3], 0.0)))
        speed = self.at(np.union1d(times, kinks[kinks < duration]))[1]
        # Between two points, a sum of lines differs from its chord by at most h²/8 times its second derivative.
        sag = self.nominal * float(np.abs(lines[0] * lines[1] ** 2).sum()) * (times[1] - times[0]) ** 2 / 8
        return max(bound[0], speed.min() - sag), min(bound[1], speed.max() + sag)

    def largest_acceleration(self) -> float:
        """Return an upper bound on the magnitude of dΩ/dt [rad/s²]."""
        bound = float(np.abs(self.lines[0] * self.lines[1]).sum())
        if self.tachogram.shape[1] > 1:
            bound += float(np.abs(np.diff(self.tachogram[1]) / np.diff(self.tachogram[0])).max())
        return self.nominal * bound

    def samples_until(self, angle: float, step: float) -> int:
        """Return the first sample index at which the true angle reaches ``angle`` [rad]; ``step`` is in s.

        Raises:
            InputError: the spindle may stop or turn back, so the angle might never be reached, or the number of
                samples is too large to be counted.
        """
        lowest = self.speed_range()[0]
        horizon = angle / lowest if lowest > 0.0 else 2.0 * angle / self.nominal
        if lowest <= 0.0 and self.at(horizon)[0, 0] >= angle:
            # Only the time until the angle is reached matters; the spindle may turn back later.
            lowest = self.speed_range(horizon)[0]
        if lowest <= 0.0:
            raise InputError(f"spindle speed falls to {lowest:.4g} rad/s; allowed: above 0 (reduce the deviations)")
        if not horizon / step < _MOST_SAMPLES:
            raise InputError(f"that takes up to {horizon / step:.3g} samples; allowed: below {_MOST_SAMPLES}")
        # The angle increases up to the horizon, so bisection is possible.
        low, high = 0, int(horizon / step) + 2
        while low < high:
            middle = (low + high) // 2
            if self.at(middle * step)[0, 0] >= angle:
                high = middle
            else:
                low = middle + 1
        return low


def constant(nominal: float) -> SpeedLaw:
    """Return a law with the constant speed ``nominal`` [rad/s]."""
    return SpeedLaw(nominal)


def harmonic(nominal: float, amplitude: Array, frequency: Array, phase: Array, start: float = 0.0) -> SpeedLaw:
    """Return a law with harmonic speed deviations, starting at ``start`` [s].

    The arrays are relative ``amplitude`` [1], ``frequency`` [rad/s] and ``phase`` [rad], shape (n,).
    Paper 000, Fig. 6: ΔΩ = 10.5·sin(ωd·t).
    """
    lines = stacked("harmonic deviation", amplitudes=amplitude, frequencies=frequency, phases=phase)
    if np.any(frequency <= 0.0):
        raise InputError(f"harmonic deviation: frequency {frequency.min():g} rad/s; allowed: above 0")
    return SpeedLaw(nominal, np.vstack((lines, np.full(amplitude.size, start))))


def tachogram(nominal: float, time: Array, deviation: Array) -> SpeedLaw:
    """Return a law with a relative ``deviation`` [1], linear between increasing times ``time`` [s], both of shape (n,).

    The deviation is constant before the first and after the last time.
    """
    stacked("tachogram", times=time, deviations=deviation)
    if time.size and (time[0] < 0.0 or np.any(np.diff(time) <= 0.0)):
        raise InputError("tachogram: times must start at 0 s or later and increase; sort them and drop repeats")
    if not time.size:
        return SpeedLaw(nominal)
    pieces = np.diff(time) * (deviation[1:] + deviation[:-1]) / 2
    area = time[0] * deviation[0] + np.concatenate(([0.0], np.cumsum(pieces)))
    return SpeedLaw(nominal, tachogram=np.stack((time, deviation, area)))


def band_limited_random(nominal: float, rms: float, low: float, high: float, lines: int, seed: int) -> SpeedLaw:
    """Return a speed law with a random relative deviation of ``rms`` [1] between ``low`` and ``high`` [rad/s].

    Frequencies and phases of the ``lines`` sines are drawn from ``seed``, see `lathe_rc.signals.noise.random_lines`.
    """
    if rms == 0.0:
        return SpeedLaw(nominal)
    if not 0.0 < low < high:
        raise InputError(f"random deviation: band {low:g}-{high:g} rad/s; allowed: 0 < low < high")
    random = np.random.default_rng(np.random.SeedSequence([seed, 0x5BEED]))
    return SpeedLaw(nominal, np.vstack((random_lines(rms, low, high, lines, random), np.zeros(lines))))
