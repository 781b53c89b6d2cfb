# SPDX-License-Identifier: Apache-2.0
"""Errors of an encoder: its disc sits beside the axis, its signals are not a circle.

    φ' = φ + e·sin(φ + ψ)                                       eccentricity, once a revolution
    x = cos(N·φ') + p,   y = (1 + g)·sin(N·φ' + a) + q          the two signals, N periods a revolution
    seen = φ' + wrapped(atan2(y, x) - N·φ')/N - what that gives at φ = 0

e is the disc's eccentricity over the radius of its track. Offsets p and q give an error of one wave in a signal period,
amplitude √(p² + q²)/N; unlike amplitudes g and a phase a that is not 90° one of two waves, √(g² + a²)/(2N), all to
first order. The index mark is on the disc, so the angle is 0 there.

Source: P. L. M. Heydemann, Applied Optics 20 (1981) 3382 (the ellipse of two signals in quadrature).
"""

from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel

_TURN = 2.0 * np.pi
_GREATEST = 0.5  # of the sum of a signal's errors, and of the eccentricity: the angle that is seen still rises


class EncoderErrors(NamedTuple):
    """Errors of an encoder's disc and signals.

    Attributes:
        eccentricity: e [rad].
        phase: ψ [rad].
        periods: N, signal periods in a revolution.
        cosine_offset, sine_offset: p and q, as parts of the amplitude.
        mismatch: g, how much larger the sine is than the cosine, as a part of it.
        skew: a [rad].
    """

    eccentricity: float = 0.0
    phase: float = 0.0
    periods: int = 1024
    cosine_offset: float = 0.0
    sine_offset: float = 0.0
    mismatch: float = 0.0
    skew: float = 0.0

    def check(self) -> None:
        """Refuse errors of no encoder.

        Raises:
            InputError: no signal period, or errors so large that the angle that is seen could fall.
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
        """Errors of the two signals."""
        return self.cosine_offset, self.sine_offset, self.mismatch, self.skew

    @property
    def table(self) -> "ErrorsTable":
        """For kernels; raises as `check`."""
        self.check()
        table = ErrorsTable(self, real=bool(self.eccentricity) or any(self._signals), zero=0.0)
        zero = np.zeros(1)
        seen_along(table, zero, zero)
        return table._replace(zero=float(zero[0]))


class ErrorsTable(NamedTuple):
    """`EncoderErrors` for kernels.

    Attributes:
        errors: of disc and signals.
        real: whether there are any.
        zero: what is seen at the angle 0, before it is set to 0 [rad].
    """

    errors: EncoderErrors
    real: bool
    zero: float


@inlined
def _raw(errors: EncoderErrors, angle: float) -> float:
    """The encoder's angle [rad], before it is set to 0 at the angle 0."""
    turned = angle + errors.eccentricity * np.sin(angle + errors.phase)
    place = errors.periods * turned
    cosine, sine = np.cos(place), np.sin(place)
    x = cosine + errors.cosine_offset
    y = (1.0 + errors.mismatch) * np.sin(place + errors.skew) + errors.sine_offset
    # The angle between the two signals and what they should be is small: it needs no counting of periods.
    return float(turned + np.arctan2(y * cosine - x * sine, x * cosine + y * sine) / errors.periods)


@inlined
def seen(table: ErrorsTable, angle: float) -> float:
    """The encoder's reading of an angle [rad]."""
    return _raw(table.errors, angle) - table.zero


@inlined
def rate(table: ErrorsTable, angle: float) -> float:
    """Derivative of the reading with respect to the angle."""
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
def seen_along(table: ErrorsTable, angle: Array, found: Array) -> None:
    """Fill the encoder's readings of angles, shape (n,)."""
    for k in range(angle.size):
        found[k] = seen(table, angle[k])
