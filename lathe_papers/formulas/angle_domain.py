# SPDX-License-Identifier: Apache-2.0
"""Plant in the angle domain: differential equations in the spindle angle φ with speed-dependent coefficients.

    Σ a_i·pⁱ X(t) = Σ b_k·pᵏ Y(t)            p = d/dt      (paper 000, eq. 6)
    Σ A_i(φ)·sⁱ X(φ) = Σ B_k(φ)·sᵏ Y(φ)      s = d/dφ      (eq. 7)

p = Ω·s, but p² = Ω²·s² + (dΩ/dt)·s and so on: a power of p contains all lower powers of s as well. Three sets of
coefficients are available:

- exact: pⁱ = Σ_k P_ik·sᵏ with the Bell polynomials P_ik of Ω, dΩ/dt, ... (Faà di Bruno's formula);
- quasi-static, A_i = a_i·Ωⁱ (eq. 9): exact for first order and for constant speed;
- linearised, A_i = a_i·(Ω0ⁱ + i·Ω0ⁱ⁻¹·ΔΩ) (eq. 12).
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.signals.speed import SpeedLaw

Coefficients = Literal["exact", "quasi_static", "linearised"]

COEFFICIENTS: tuple[Coefficients, ...] = ("exact", "quasi_static", "linearised")

_LONGEST_STEP = 0.2  # longest integration step, in time constants of the fastest pole and of the fastest deviation


def speed_derivatives(law: SpeedLaw, time: Array, count: int) -> Array:
    """Return Ω, dΩ/dt, d²Ω/dt², ... at ``time`` [s], shape (count, n) [rad/s, rad/s², ...].

    Raises:
        InputError: ``count`` exceeds 2 for a tachogram, whose dΩ/dt has jumps.
    """
    if law.tachogram.size and count > 2:
        raise InputError("a tachogram has no second derivative; use harmonic deviations for plants above second order")
    known = law.at(time)[1:]
    if count <= 2:
        return known[:count]
    amplitude, frequency, phase, start = law.lines[:, :, None]
    since = time - start
    running = np.where(since >= 0.0, amplitude, 0.0)
    higher = [
        law.nominal * (running * frequency**m * np.sin(frequency * since + phase + m * np.pi / 2)).sum(axis=0)
        for m in range(2, count)
    ]
    return np.concatenate((known, np.stack(higher)))


def operator_powers(derivatives: Array, order: int) -> Array:
    """Return the matrix P with pⁱ = Σ_k P[i, k]·sᵏ, for i and k from 0 to ``order``.

    Args:
        derivatives: Ω, dΩ/dt, ..., at least ``order`` rows, shape (order, n).
        order: highest power.

    Returns:
        P, shape (order + 1, order + 1, n) [1/sⁱ].
    """
    powers = np.zeros((order + 1, order + 1, derivatives.shape[1]))
    powers[0, 0] = 1.0
    for i in range(1, order + 1):
        for k in range(1, i + 1):
            for j in range(1, i - k + 2):
                # Recursion of the partial Bell polynomials, B_ik = Σ_j C(i-1, j-1)·x_j·B_(i-j)(k-1).
                powers[i, k] += math.comb(i - 1, j - 1) * derivatives[j - 1] * powers[i - j, k - 1]
    return powers


def exact(polynomial: Array, derivatives: Array) -> Array:
    """Return the exact coefficients A_k = Σ_i a_i·P_ik from a_0, a_1, ... and Ω, dΩ/dt, ...

    Shapes: polynomial (m,), derivatives (≥ m - 1, n), result (m, n).
    """
    return np.asarray(np.einsum("i,ikn->kn", polynomial, operator_powers(derivatives, polynomial.size - 1)))


def quasi_static(polynomial: Array, speed: Array) -> Array:
    """Return the quasi-static coefficients A_i = a_i·Ωⁱ (paper 000, eq. 9).

    Shapes: polynomial (m,), speed (n,) [rad/s], result (m, n).
    """
    return np.asarray(polynomial[:, None] * speed ** np.arange(polynomial.size)[:, None])


def linearised(polynomial: Array, nominal: float, speed: Array) -> Array:
    """Return the linearised coefficients A_i = a_i·(Ω0ⁱ + i·Ω0ⁱ⁻¹·ΔΩ) (paper 000, eq. 12).

    Shapes: polynomial (m,), speed (n,) [rad/s], result (m, n).
    """
    power = np.arange(polynomial.size)[:, None]
    return np.asarray(polynomial[:, None] * nominal**power * (1.0 + power * (speed / nominal - 1.0)))


class Signal(Protocol):
    """Input Y(φ) and its derivatives, with the call signature of SciPy's splines."""

    def __call__(self, angle: Array, derivative: int, /) -> Array:
        """Return the ``derivative``-th derivative at ``angle`` [rad], shape (n,)."""


@dataclass(frozen=True)
class Harmonic:
    """Harmonic input sin(order·φ + phase); ``phase`` in rad."""

    order: float
    phase: float = 0.0

    def __call__(self, angle: Array, derivative: int, /) -> Array:
        """Return the ``derivative``-th derivative at ``angle`` [rad], shape (n,)."""
        return np.asarray(
            self.order**derivative * np.sin(self.order * angle + self.phase + derivative * np.pi / 2),
        )


@kernel
def _integrate(lower: Array, forcing: Array, steps: Array) -> Array:
    """Integrate x⁽ᵐ⁾ = f - Σ c_i·x⁽ⁱ⁾ from rest with the fourth-order Runge-Kutta method; return x, x', ..., x⁽ᵐ⁻¹⁾.

    ``lower`` (m, 2n + 1) and ``forcing`` (2n + 1,) contain c and f at the ends and midpoints of the ``steps`` (n,).
    """
    order = lower.shape[0]
    out = np.zeros((order, steps.size + 1))
    x, at, total, slope = np.zeros(order), np.zeros(order), np.zeros(order), np.zeros(order)
    for n in range(steps.size):
        total[:] = 0.0
        at[:] = x
        for stage in range(4):
            place = 2 * n + (stage + 1) // 2
            highest = forcing[place]
            for i in range(order):
                highest -= lower[i, place] * at[i]
            for i in range(order - 1):
                slope[i] = at[i + 1]
            slope[order - 1] = highest
            total += slope if stage in {0, 3} else 2.0 * slope  # weights 1, 2, 2, 1
            at[:] = x + steps[n] * slope * (1.0 if stage == 2 else 0.5)
        x += steps[n] / 6.0 * total
        out[:, n + 1] = x
    return out


@dataclass(frozen=True)
class AngleDomain:
    """Plant and spindle, simulated in the angle domain and, as the reference solution, in the time domain.

    Both simulations start from rest at angle 0. If the numerator differentiates, the jump of Y at the start moves the
    plant immediately in the time domain, but not in the angle domain: compare them after this transient has decayed.

    Args:
        denominator: coefficients a_0, a_1, ..., a_n of eq. 6, n >= 1 [sⁱ].
        numerator: coefficients b_0, b_1, ..., b_m of eq. 6, m <= n [sᵏ].
        law: spindle speed, above 0.
        angle: angles at which the response is computed [rad], increasing from 0, shape (points,).

    Raises:
        InputError: invalid plant, angle or speed.
    """

    denominator: Array
    numerator: Array
    law: SpeedLaw
    angle: Array

    def __post_init__(self) -> None:
        order = self.denominator.size - 1
        if order < 1 or not 1 <= self.numerator.size <= order + 1 or self.denominator[-1] == 0.0:
            raise InputError(
                f"plant of {self.denominator.size} coefficients a and {self.numerator.size} b; allowed: two a or more, "
                "the last not 0, and at most as many b"
            )
        if self.angle.size < 2 or self.angle[0] != 0.0 or np.any(np.diff(self.angle) <= 0.0):
            raise InputError("angles; allowed: two or more, increasing from 0")
        if self.law.speed_range()[0] <= 0.0:
            raise InputError("the spindle may stand still or turn back; allowed: speeds above 0 (reduce the deviation)")

    @cached_property
    def _parts(self) -> int:
        """Number of integration steps in each interval of ``angle``."""
        poles = np.roots(self.denominator[::-1])
        fastest = max(np.abs(poles).max(), self.law.lines[1].max(initial=0.0))
        widest = np.diff(self.angle).max() * fastest / self.law.speed_range()[0]
        return math.ceil(float(widest) / _LONGEST_STEP)

    @cached_property
    def _nodes(self) -> Array:
        """Angles at the ends and midpoints of all integration steps [rad]."""
        place = np.arange((self.angle.size - 1) * 2 * self._parts + 1) / (2 * self._parts)
        return np.interp(place, np.arange(self.angle.size), self.angle)

    @cached_property
    def _time(self) -> Array:
        """Times at which the spindle reaches the angles of `_nodes` [s], computed by Newton's method from a table."""
        step = float(np.diff(self._nodes).max()) / self.law.nominal
        table = np.arange(self.law.samples_until(float(self.angle[-1]), step) + 2) * step
        time = np.interp(self._nodes, self.law.at(table)[0], table)
        for _ in range(4):  # each doubles the table's few correct digits; four leave only rounding error
            angle, speed, _ = self.law.at(time)
            time -= (angle - self._nodes) / speed
        return np.asarray(time)

    @cached_property
    def _derivatives(self) -> Array:
        return speed_derivatives(self.law, self._time, self.denominator.size - 1)

    def _set(self, polynomial: Array, coefficients: Coefficients) -> Array:
        if coefficients == "exact":
            return exact(polynomial, self._derivatives)
        if coefficients == "quasi_static":
            return quasi_static(polynomial, self._derivatives[0])
        return linearised(polynomial, self.law.nominal, self._derivatives[0])

    def response(self, signal: Signal, coefficients: Coefficients) -> Array:
        """Return X(φ) of eq. 7 at ``angle``, shape (points,), in the unit of Y.

        Args:
            signal: Y(φ), smooth between consecutive values of ``angle``.
            coefficients: name of the coefficient set.

        Raises:
            InputError: the linearised A_n is not positive everywhere, so that its equation has no solution.
        """
        left, right = self._set(self.denominator, coefficients), self._set(self.numerator, coefficients)
        if np.any(left[-1] / self.denominator[-1] <= 0.0):
            raise InputError(
                f"linearised coefficients: A_{left.shape[0] - 1} falls to 0 where the speed falls by "
                f"1/{left.shape[0] - 1}; reduce the deviation"
            )
        forcing = np.zeros(self._nodes.size)
        for k, row in enumerate(right):
            forcing += row * signal(self._nodes, k)
        steps = np.diff(self._nodes[::2])
        return np.asarray(_integrate(left[:-1] / left[-1], forcing / left[-1], steps)[0, :: self._parts])

    def truth(self, signal: Signal) -> Array:
        """Return X(t) of eq. 6 at the times when the spindle is at ``angle``, shape (points,).

        The equation is solved in time with its constant coefficients and needs no derivative of Y: with
        Σ a_i·pⁱ w = Y, the response is X = Σ b_k·pᵏ w.
        """
        ends = self._time[::2]
        # The midpoint of a step in time is not that of the step in angle, so Runge-Kutta needs separate midpoints.
        time = np.empty_like(self._time)
        time[::2], time[1::2] = ends, (ends[1:] + ends[:-1]) / 2.0
        forcing = signal(self.law.at(time)[0], 0) / self.denominator[-1]
        lower = np.repeat(self.denominator[:-1, None] / self.denominator[-1], time.size, axis=1)
        inner = _integrate(lower, forcing, np.diff(ends))
        highest = forcing[::2] - (lower[:, ::2] * inner).sum(axis=0)
        inner = np.vstack((inner, highest))[: self.numerator.size, :: self._parts]
        return np.asarray(self.numerator @ inner)


def harmonic_errors(domain: AngleDomain, order: float, settled: float) -> dict[Coefficients, float]:
    """Return the largest error of X per coefficient set, over all phases ψ and all angles from ``settled`` [rad] on.

    The input is Y = sin(order·φ + ψ).
    """
    signals = Harmonic(order), Harmonic(order, np.pi / 2)
    truth = [domain.truth(signal) for signal in signals]
    # Each phase mixes the errors of sine and cosine; at an angle, the worst phase gives their root sum of squares.
    errors = {
        kind: np.hypot(*(domain.response(signal, kind) - true for signal, true in zip(signals, truth, strict=True)))
        for kind in COEFFICIENTS
    }
    return {kind: float(error[domain.angle >= settled].max()) for kind, error in errors.items()}
