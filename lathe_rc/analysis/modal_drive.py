# SPDX-License-Identifier: Apache-2.0
"""Model of an electrodynamic drive with resonant modes, as its fit needs it: responses and their derivatives.

    W(p) = e^{-pτ}·[(1 - Σp_j)·Q(ω1, ζ1) + Σ p_j·Q(ω_j, ζ_j)],    Q(ω, ζ) = ω²/(p² + 2ζω·p + ω²)

The static gain is 1. p_j is the participation of mode j at the position sensor, of either sign.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lathe_rc.arrays import Array, Complex

MILLI = 1e-3  #: unit of the delay among the searched parameters [s]
BASE = 3  #: searched parameters without modes
EACH = 3  #: searched parameters of a mode


def resonance(p: Complex, frequency: float, damping: float) -> tuple[Complex, Complex, Complex]:
    """Return Q(ω, ζ) and its derivatives by ln ω and ln ζ, shape (n,) each, at ``p`` = jω [rad/s]."""
    below = p**2 + 2.0 * damping * frequency * p + frequency**2
    value = frequency**2 / below
    lag = 2.0 * damping * frequency * p / below
    return value, value * (2.0 - lag - 2.0 * value), -value * lag


def resonance_step(time: Array, frequency: float, damping: float) -> Array:
    """Return the response of Q(ω, ζ) to a unit step at time 0, shape (n,), for any damping."""
    t = np.maximum(time, 0.0) * frequency
    # Poles -ζ ± d in units of ω. At d = 0 the quotient below is 0/0; a d this small changes nothing.
    d = np.sqrt(complex(damping**2 - 1.0))
    if abs(d) < 1e-6:
        d = 1e-6 + 0.0j
    slow, fast = np.exp((d - damping) * t), np.exp((-d - damping) * t)
    return np.asarray(1.0 - ((slow + fast) / 2.0 + damping * (slow - fast) / (2.0 * d)).real)


@dataclass(frozen=True)
class ModalDrive:
    """Drive of second order with a delay and modes.

    Attributes:
        natural_frequency: ω1 [rad/s].
        damping: ζ1 [1].
        delay: τ [s].
        mode_frequency: ω_j of each mode [rad/s].
        mode_damping: ζ_j of each mode [1].
        mode_participation: p_j of each mode [1].
    """

    natural_frequency: float
    damping: float
    delay: float
    mode_frequency: tuple[float, ...] = ()
    mode_damping: tuple[float, ...] = ()
    mode_participation: tuple[float, ...] = ()

    @property
    def modes(self) -> list[tuple[float, float, float]]:
        """Frequency [rad/s], damping and participation of each mode."""
        return list(zip(self.mode_frequency, self.mode_damping, self.mode_participation, strict=True))

    def response(self, frequency: Array) -> Complex:
        """Return W(jω) at frequencies [rad/s], shape (n,)."""
        p = np.asarray(1j * frequency, np.complex128)
        whole = (1.0 - sum(self.mode_participation)) * resonance(p, self.natural_frequency, self.damping)[0]
        for mode_frequency, mode_damping, share in self.modes:
            whole += share * resonance(p, mode_frequency, mode_damping)[0]
        return np.asarray(np.exp(-p * self.delay) * whole)

    def step(self, time: Array) -> Array:
        """Return the response to a unit step at time 0, shape (n,), at times [s]."""
        later = time - self.delay
        own = resonance_step(later, self.natural_frequency, self.damping)
        whole = (1.0 - sum(self.mode_participation)) * own
        for mode_frequency, mode_damping, share in self.modes:
            whole += share * resonance_step(later, mode_frequency, mode_damping)
        return np.asarray(whole)

    def derivatives(self, frequency: Array) -> Complex:
        """Return the derivatives of W(jω) by the searched parameters (see `searched`), shape (n, 3 + 3·modes)."""
        p = np.asarray(1j * frequency, np.complex128)
        delayed = np.exp(-p * self.delay)
        rest = 1.0 - sum(self.mode_participation)
        own, by_frequency, by_damping = resonance(p, self.natural_frequency, self.damping)
        whole = rest * own
        columns = [rest * by_frequency, rest * by_damping, np.zeros_like(own)]
        for mode_frequency, mode_damping, share in self.modes:
            value, mode_by_frequency, mode_by_damping = resonance(p, mode_frequency, mode_damping)
            whole = whole + share * value
            columns += [share * mode_by_frequency, share * mode_by_damping, value - own]
        columns[2] = -p * MILLI * whole
        return np.asarray(delayed[:, None] * np.stack(columns, axis=1))

    def searched(self) -> Array:
        """Return ln ω1, ln ζ1, τ [ms], and ln ω_j, ln ζ_j, p_j of each mode, shape (3 + 3·modes,)."""
        modes = [value for w, z, share in self.modes for value in (np.log(w), np.log(z), share)]
        return np.array([np.log(self.natural_frequency), np.log(self.damping), self.delay / MILLI, *modes])

    @classmethod
    def of_searched(cls, x: Array) -> "ModalDrive":
        """Return the drive of searched parameters (see `searched`)."""
        modes = x[BASE:].reshape(-1, EACH)
        return cls(
            natural_frequency=float(np.exp(x[0])),
            damping=float(np.exp(x[1])),
            delay=float(x[2]) * MILLI,
            mode_frequency=tuple(np.exp(modes[:, 0]).tolist()),
            mode_damping=tuple(np.exp(modes[:, 1]).tolist()),
            mode_participation=tuple(modes[:, 2].tolist()),
        )

    def with_modes(self, modes: Sequence[tuple[float, float, float]]) -> "ModalDrive":
        """Return the drive with other modes, as in `modes`."""
        columns = zip(*modes, strict=True) if modes else ((), (), ())
        return ModalDrive(self.natural_frequency, self.damping, self.delay, *columns)

    def sorted(self) -> "ModalDrive":
        """Return the drive with its modes in order of their frequencies."""
        return self.with_modes(sorted(self.modes))

    def parameters(self) -> dict[str, float | list[float]]:
        """Return the parameters of ``electrodynamic_actuator`` by name; those of modes only if there are any."""
        found: dict[str, float | list[float]] = {
            "natural_frequency": self.natural_frequency,
            "damping": self.damping,
            "delay": self.delay,
        }
        if self.mode_frequency:
            found["mode_frequency"] = list(self.mode_frequency)
            found["mode_damping"] = list(self.mode_damping)
            found["mode_participation"] = list(self.mode_participation)
        return found
