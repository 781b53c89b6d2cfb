# SPDX-License-Identifier: Apache-2.0
"""Encoder errors: eccentricity of the disc, and offset, amplitude and phase errors of the signals.

    φ' = φ + e·sin(φ + ψ)                                       eccentricity, once per revolution
    x = cos(N·φ') + p,   y = (1 + g)·sin(N·φ' + a) + q          the two signals, N periods per revolution
    seen = φ' + wrapped(atan2(y, x) - N·φ')/N - s0              with s0 such that seen = 0 at φ = 0

e is the disc's eccentricity divided by the radius of its track. To first order, offsets p and q cause an error with one
cycle per signal period and amplitude √(p² + q²)/N; an amplitude mismatch g and a phase error a cause an error with two
cycles per signal period and amplitude √(g² + a²)/(2N). The index mark is on the disc, so the angle is 0 there.

Source: P. L. M. Heydemann, Applied Optics 20 (1981) 3382 (the ellipse of two signals in quadrature).
"""

from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel

_TURN = 2.0 * np.pi
_ROUNDS = 64  # most steps of a root search, enough for a bisection
_CLOSE = 1e-9  # [rad] last step of Newton's method
_GREATEST = 0.5  # limit of the signal errors and the eccentricity, below which the reading is monotone


class EncoderErrors(NamedTuple):
    """Errors of an encoder's disc and signals.

    Attributes:
        eccentricity: e [rad].
        phase: ψ [rad].
        periods: N, signal periods per revolution.
        cosine_offset, sine_offset: p and q, relative to the amplitude.
        mismatch: g, relative excess of the sine's amplitude over the cosine's.
        skew: a, phase error [rad].
    """

    eccentricity: float = 0.0
    phase: float = 0.0
    periods: int = 1024
    cosine_offset: float = 0.0
    sine_offset: float = 0.0
    mismatch: float = 0.0
    skew: float = 0.0

    def check(self) -> None:
        """Check that the errors are small enough for a monotone reading.

        Raises:
            InputError: there is no signal period, or the errors are so large that the reading could decrease while the
                angle increases.
        """
        if not self.periods >= 1:
            raise InputError(f"encoder: {self.periods} signal periods in a revolution; allowed: 1 or more")
        if not abs(self.eccentricity) <= _GREATEST:
            raise InputError(f"encoder: eccentricity {self.eccentricity:g} rad; allowed: up to {_GREATEST:g} rad")
        whole = sum(map(abs, self._signals))
        if not whole <= _GREATEST:
            raise InputError(
                f"encoder: errors of the signals that come to {whole:g}; allowed: offsets, mismatch and skew of up to "
                f"{_GREATEST:g} together"
            )

    @property
    def _signals(self) -> tuple[float, float, float, float]:
        """Offsets, amplitude mismatch and phase error of the two encoder signals."""
        return self.cosine_offset, self.sine_offset, self.mismatch, self.skew

    @property
    def table(self) -> "ErrorsTable":
        """Return the table of the encoder errors for kernels; raises the errors of `check`."""
        self.check()
        table = ErrorsTable(self, real=bool(self.eccentricity) or any(self._signals), zero=0.0)
        zero = np.zeros(1)
        seen_along(table, zero, zero)
        return table._replace(zero=float(zero[0]))


class ErrorsTable(NamedTuple):
    """Encoder errors for kernels (see `EncoderErrors`).

    Attributes:
        errors: errors of disc and signals.
        real: whether there are any errors.
        zero: reading at the angle 0, before zeroing [rad].
    """

    errors: EncoderErrors
    real: bool
    zero: float


@inlined
def _raw(errors: EncoderErrors, angle: float) -> float:
    """Return the encoder's reading of an angle before zeroing [rad]."""
    turned = angle + errors.eccentricity * np.sin(angle + errors.phase)
    place = errors.periods * turned
    cosine, sine = np.cos(place), np.sin(place)
    x = cosine + errors.cosine_offset
    y = (1.0 + errors.mismatch) * np.sin(place + errors.skew) + errors.sine_offset
    # The angle between the actual and the ideal signals is small, so no periods need to be counted.
    return float(turned + np.arctan2(y * cosine - x * sine, x * cosine + y * sine) / errors.periods)


@inlined
def seen(table: ErrorsTable, angle: float) -> float:
    """Return the encoder's reading of an angle [rad]."""
    return _raw(table.errors, angle) - table.zero


@inlined
def rate(table: ErrorsTable, angle: float) -> float:
    """Return the derivative of the encoder's reading with respect to the angle."""
    errors = table.errors
    turned = angle + errors.eccentricity * np.sin(angle + errors.phase)
    place = errors.periods * turned
    x, y = (
        np.cos(place) + errors.cosine_offset,
        (1.0 + errors.mismatch) * np.sin(place + errors.skew) + errors.sine_offset,
    )
    along = x * (1.0 + errors.mismatch) * np.cos(place + errors.skew) + y * np.sin(place)
    return float((1.0 + errors.eccentricity * np.cos(angle + errors.phase)) * along / (x * x + y * y))


@kernel
def place_of(table: ErrorsTable, reading: float, low: float, high: float) -> float:
    """Return the angle of a reading [rad], between two angles that enclose it, by Newton's method."""
    angle = high
    for _ in range(_ROUNDS):
        off = seen(table, angle) - reading
        if off >= 0.0:
            high = angle
        else:
            low = angle
        found = angle - off / rate(table, angle)
        if not low < found < high:
            found = 0.5 * (low + high)
        off, angle = abs(found - angle), found
        if off < _CLOSE:
            break
    return angle


@kernel
def seen_along(table: ErrorsTable, angle: Array, found: Array) -> None:
    """Fill ``found`` with the encoder's readings of angles [rad], shape (n,)."""
    for k in range(angle.size):
        found[k] = seen(table, angle[k])
