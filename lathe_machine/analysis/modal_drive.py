# SPDX-License-Identifier: Apache-2.0
"""Model of an electrodynamic drive with modes and lags, as its fit needs it: responses and their derivatives.

    W(p) = g·e^{-pτ}·[Σ (p_j + v_j·p/ω_j)·Q(ω_j, ζ_j) + Σ r_k/(1 + p·T_k)],    Q(ω, ζ) = ω²/(p² + 2ζω·p + ω²)

with the drive itself as first section: p_1 = 1 - Σ p_j - Σ r_k, v_1 = -(Σ v_j·ω_j + Σ r_k/T_k)/ω_1 over the others. The
static gain is g, and the relative degree 2. p_j is the participation of mode j at the position sensor, v_j that of its
velocity, of either sign (see `lathe_machine.plants.modes`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lathe_machine.plants.modes import own_velocity
from lathe_rc.arrays import Array, Complex

MILLI = 1e-3  #: unit of the delay among the searched parameters [s]
BASE = 4  #: searched parameters without modes and lags


def resonance(p: Complex, frequency: float, damping: float) -> tuple[Complex, Complex, Complex]:
    """Return Q(ω, ζ) and its derivatives by ln ω and ln ζ, shape (n,) each, at ``p`` = jω [rad/s]."""
    below = p**2 + 2.0 * damping * frequency * p + frequency**2
    value = frequency**2 / below
    lag = 2.0 * damping * frequency * p / below
    return value, value * (2.0 - lag - 2.0 * value), -value * lag


def resonance_step(time: Array, frequency: float, damping: float) -> tuple[Array, Array]:
    """Return the responses of Q(ω, ζ) and p/ω·Q(ω, ζ) to a unit step at time 0, shape (n,) each, for any damping."""
    t = np.maximum(time, 0.0) * frequency
    # Poles -ζ ± d in units of ω. At d = 0 the quotient below is 0/0; a d this small changes nothing.
    d = np.sqrt(complex(damping**2 - 1.0))
    if abs(d) < 1e-6:
        d = 1e-6 + 0.0j
    slow, fast = np.exp((d - damping) * t), np.exp((-d - damping) * t)
    velocity = ((slow - fast) / (2.0 * d)).real
    return np.asarray(1.0 - ((slow + fast) / 2.0).real - damping * velocity), np.asarray(velocity)


@dataclass(frozen=True)
class ModalDrive:
    """Drive of second order with a gain, a delay, modes and lags.

    Attributes:
        natural_frequency: ω1 [rad/s].
        damping: ζ1 [1].
        delay: τ [s].
        mode_frequency: ω_j of each mode [rad/s].
        mode_damping: ζ_j of each mode [1].
        mode_participation: p_j of each mode [1].
        gain: g [1].
        mode_velocity: v_j of each mode [1]; empty: 0, the modes are normal.
        lag_time: T_k of each lag [s].
        lag_participation: r_k of each lag [1].
    """

    natural_frequency: float
    damping: float
    delay: float
    mode_frequency: tuple[float, ...] = ()
    mode_damping: tuple[float, ...] = ()
    mode_participation: tuple[float, ...] = ()
    gain: float = 1.0
    mode_velocity: tuple[float, ...] = ()
    lag_time: tuple[float, ...] = ()
    lag_participation: tuple[float, ...] = ()

    @property
    def normal(self) -> bool:
        """Whether the modes have real residues, and there are no lags."""
        return not self.mode_velocity and not self.lag_time

    @property
    def modes(self) -> list[tuple[float, float, float, float]]:
        """Frequency [rad/s], damping, participation and participation of the velocity of each mode."""
        velocity = self.mode_velocity or (0.0,) * len(self.mode_frequency)
        return list(zip(self.mode_frequency, self.mode_damping, self.mode_participation, velocity, strict=True))

    @property
    def lags(self) -> list[tuple[float, float]]:
        """Time constant [s] and participation of each lag."""
        return list(zip(self.lag_time, self.lag_participation, strict=True))

    @property
    def sections(self) -> list[tuple[float, float, float, float]]:
        """The drive itself and its modes, as `modes`."""
        share = 1.0 - sum(self.mode_participation) - sum(self.lag_participation)
        others = self.mode_velocity or (0.0,) * len(self.mode_frequency)
        own = own_velocity(self.natural_frequency, self.mode_frequency, others, self.lag_time, self.lag_participation)
        return [(self.natural_frequency, self.damping, share, own), *self.modes]

    def response(self, frequency: Array) -> Complex:
        """Return W(jω) at frequencies [rad/s], shape (n,)."""
        p = np.asarray(1j * frequency, np.complex128)
        whole = np.zeros_like(p)
        for w, damping, share, velocity in self.sections:
            whole += (share + velocity / w * p) * resonance(p, w, damping)[0]
        for time, share in self.lags:
            whole += share / (1.0 + p * time)
        return np.asarray(self.gain * np.exp(-p * self.delay) * whole)

    def step(self, time: Array) -> Array:
        """Return the response to a unit step at time 0, shape (n,), at times [s]."""
        later, whole = time - self.delay, np.zeros(time.size)
        for w, damping, share, velocity in self.sections:
            position, rate = resonance_step(later, w, damping)
            whole += share * position + velocity * rate
        for constant, share in self.lags:
            whole += share * -np.expm1(-np.maximum(later, 0.0) / constant)
        return np.asarray(self.gain * whole)

    def derivatives(self, frequency: Array) -> Complex:
        """Return the derivatives of W(jω) by the searched parameters (see `searched`), shape (n, k)."""
        p = np.asarray(1j * frequency, np.complex128)
        delayed = self.gain * np.exp(-p * self.delay)
        (w1, z1, share, velocity), *modes = self.sections
        own, by_frequency, by_damping = resonance(p, w1, z1)
        rate = p / w1 * own  # by the velocity of the drive itself, which balances that of each other part
        moved = share + velocity * p / w1
        whole = moved * own
        none = np.zeros_like(own)
        columns = [moved * by_frequency - 2.0 * velocity * rate, moved * by_damping, none, none]
        for w, damping, share, velocity in modes:
            value, by_frequency, by_damping = resonance(p, w, damping)
            moved = share + velocity * p / w
            whole = whole + moved * value
            by_frequency = moved * by_frequency - velocity * (p / w * value + w / w1 * rate)
            columns += [by_frequency, moved * by_damping, value - own]
            if self.mode_velocity:
                columns.append(p / w * value - w / w1 * rate)
        for time, share in self.lags:
            value = 1.0 / (1.0 + p * time)
            whole = whole + share * value
            columns += [share * (rate / (w1 * time) - p * time * value**2), value - own - rate / (w1 * time)]
        columns[2], columns[3] = -p * MILLI * whole, whole / self.gain
        return np.asarray(delayed[:, None] * np.stack(columns, axis=1))

    @property
    def each(self) -> int:
        """Searched parameters of a mode."""
        return 4 if self.mode_velocity else 3

    @property
    def logarithmic(self) -> list[int]:
        """Places of the searched parameters that are logarithms."""
        modes = BASE + self.each * np.arange(len(self.mode_frequency))
        lags = BASE + self.each * len(self.mode_frequency) + 2 * np.arange(len(self.lag_time))
        return [0, 1, *modes.tolist(), *(modes + 1).tolist(), *lags.tolist()]

    def searched(self) -> Array:
        """Return ln ω1, ln ζ1, τ [ms], g, of each mode ln ω_j, ln ζ_j, p_j and v_j, of each lag ln T_k and r_k."""
        own = [self.natural_frequency, self.damping, self.delay / MILLI, self.gain]
        x = np.array(
            [*own, *(v for mode in self.modes for v in mode[: self.each]), *(v for lag in self.lags for v in lag)]
        )
        x[self.logarithmic] = np.log(x[self.logarithmic])
        return x

    def at(self, x: Array) -> "ModalDrive":
        """Return the drive of searched parameters with as many modes and lags."""
        values = x.copy()
        values[self.logarithmic] = np.exp(values[self.logarithmic])
        return self.of_values(values)

    def of_values(self, values: Array) -> "ModalDrive":
        """Return the drive of parameters in the order of `searched`, none of them a logarithm."""
        modes, lags = np.split(values[BASE:], [self.each * len(self.mode_frequency)])
        w, damping, delay, gain = values[:BASE].tolist()
        rows, pairs = modes.reshape(-1, self.each).tolist(), lags.reshape(-1, 2).tolist()
        return composed((w, damping, delay * MILLI), gain, rows, pairs)

    def sorted(self) -> "ModalDrive":
        """Return the drive with the largest participation as its own, modes by frequency and lags by time."""
        own, *modes = sorted(self.sections, key=lambda section: -abs(section[2]))
        rows = [mode[: self.each] for mode in sorted(modes)]
        return composed((own[0], own[1], self.delay), self.gain, rows, sorted(self.lags))

    def with_sections(self, modes: Sequence[Sequence[float]], lags: Sequence[Sequence[float]]) -> "ModalDrive":
        """Return the drive with other modes and lags, as `modes` and `lags`."""
        own = (self.natural_frequency, self.damping, self.delay)
        return composed(own, self.gain, [mode[: self.each] for mode in modes], lags)

    def parameters(self) -> dict[str, float | list[float]]:
        """Return the parameters of ``electrodynamic_actuator`` by name, without empty lists."""
        found: dict[str, float | list[float]] = {}
        for name in ("natural_frequency", "damping", "delay", "gain"):
            found[name] = float(getattr(self, name))
        for name in OPTIONAL:
            if values := getattr(self, name):
                found[name] = list(values)
        return found


OPTIONAL = ("mode_frequency", "mode_damping", "mode_participation", "mode_velocity", "lag_time", "lag_participation")


def composed(
    own: tuple[float, float, float], gain: float, modes: Sequence[Sequence[float]], lags: Sequence[Sequence[float]]
) -> ModalDrive:
    """Return the drive of its sections.

    Args:
        own: ω1 [rad/s], ζ1 and τ [s].
        gain: g.
        modes: frequency [rad/s], damping, participation and, unless the modes are normal, that of the velocity.
        lags: time constant [s] and participation of each.
    """
    w, z, delay = own
    frequency, damping, share, *velocity = zip(*modes, strict=True) if modes else ((), (), ())
    times, shares = zip(*lags, strict=True) if lags else ((), ())
    return ModalDrive(
        w, z, delay, frequency, damping, share,
        gain=gain, mode_velocity=velocity[0] if velocity else (), lag_time=times, lag_participation=shares,
    )  # fmt: skip
