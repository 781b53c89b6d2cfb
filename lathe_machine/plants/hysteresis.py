# SPDX-License-Identifier: Apache-2.0
"""Rate-independent hysteresis of piezo ceramics, and the inverse operators that linearise it.

Input and output are relative: 1 is the half-stroke, at full voltage. The operators do not depend on time: the output
depends only on the path of the input, and within each monotone section only on the end point of that section.

Prandtl-Ishlinskii: weighted play operators in parallel with a proportional part,

    y = p0·u + Σ p_i·F_i(u),    F_i ← max(u - r_i, min(u + r_i, F_i)).

The inverse is an operator of the same kind (Kuhnen 2003, "Modeling, identification and compensation of complex
hysteretic nonlinearities"); it exists if all partial slopes p0 + p_1 + ... + p_i are positive.

Bouc-Wen with n = 1, written in u so that the rate cancels:

    y = g·(u - h),    dh = A·du - β·h·|du| - γ·|h|·du,

with g chosen so that a steady loop over ±1 ends at ±1. While u moves in one direction, h obeys a linear equation in u
whose rate changes once, where h passes 0, so a step of any length is computed exactly. The inverse solves for the
length of this step, sample by sample; it exists if dy/du = g·(1 - dh/du) is positive, that is, if 2Aβ/(β + γ) < 1.

Sources: spec/learning.md; paper 001 for the loop of 10-15 % that the linearisation must compensate.
"""

from typing import NamedTuple

import numpy as np
import scipy

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.checks import stacked

#: Ten play operators, with which the loop over ±1 has a width of 13 % of its height and ends at ±1.
THRESHOLDS = np.arange(1, 11) / 11
WEIGHTS = np.full(10, 0.04767)
PROPORTIONAL = 0.7617

_LINEAR, PLAYS, _BOUC_WEN, _BOUC_WEN_INVERSE = 0, 1, 2, 3  #: kinds of a `Law`


class OperatorTable(NamedTuple):
    """Kind and constants of a hysteresis operator for kernels; the state is a separate array."""

    kind: int
    table: Array


LINEAR = OperatorTable(_LINEAR, np.empty((0, 0)))  #: output = input; without state


@kernel
def _relax(rate: float, travel: float) -> float:
    """Compute (1 - e^{-rate·travel})/rate, which is the travel itself for a rate of 0."""
    x = rate * travel
    # Below this, the next term x/2 is less than rounding error, and the quotient of subnormal numbers would be inexact.
    if x < 1e-17:
        return travel
    return float(-np.expm1(-x) / rate)


@kernel
def _travel(rate: float, relaxed: float) -> float:
    """Compute the travel from the relaxed travel (inverse of `_relax`)."""
    x = rate * relaxed
    if x < 1e-17:
        return relaxed
    return float(-np.log1p(-x) / rate)


@kernel
def _move(h: float, travel: float, shape: Array) -> float:
    """Return the hysteretic part after ``travel`` >= 0; like ``h``, it is positive in the direction of travel."""
    a, beta, gamma = shape[0], shape[1], shape[2]
    if h < 0.0:  # opposite to the travel: the rate is β - γ until h passes 0, then β + γ
        slope = a - (beta - gamma) * h
        to_zero = _travel(beta - gamma, -h / slope)
        if travel < to_zero:
            return float(h + slope * _relax(beta - gamma, travel))
        h, travel = 0.0, travel - to_zero
    return float(h + (a - (beta + gamma) * h) * _relax(beta + gamma, travel))


@kernel
def _solve(slope: float, rate: float, target: float) -> float:
    """Solve d - slope·(1 - e^{-rate·d})/rate = target for d, for 0 <= slope < 1.

    The left side is convex and increasing, and the initial value is not below the root, so Newton's method decreases
    towards the root.
    """
    d = target / (1.0 - slope)
    while True:
        better = d - (d - slope * _relax(rate, d) - target) / (1.0 - slope * np.exp(-rate * d))
        if not better < d:
            return d
        d = better


@kernel
def _needed(h: float, target: float, shape: Array) -> float:
    """Solve travel - (increase of the hysteretic part) = ``target`` >= 0 for the travel; ``h`` is as in `_move`."""
    a, beta, gamma = shape[0], shape[1], shape[2]
    travel = 0.0
    if h < 0.0:
        slope = a - (beta - gamma) * h
        to_zero = _travel(beta - gamma, -h / slope)
        if target < to_zero + h:
            return _solve(slope, beta - gamma, target)
        h, travel, target = 0.0, to_zero, target - (to_zero + h)
    return float(travel + _solve(a - (beta + gamma) * h, beta + gamma, target))


@inlined
def play(position: float, threshold: float, value: float) -> float:
    """Return the position of a play operator after the input ``value``."""
    return min(max(position, value - threshold), value + threshold)


@kernel
def plays(thresholds: Array, start: Array, value: Array) -> Array:
    """Compute the positions of play operators without weights, shape (n, m).

    Args:
        thresholds: r_i, shape (m,).
        start: positions before the first sample, shape (m,).
        value: input, shape (n,).
    """
    positions = np.empty((value.size, thresholds.size))
    for i in range(thresholds.size):
        position = start[i]
        for k in range(value.size):
            position = play(position, thresholds[i], value[k])
            positions[k, i] = position
    return positions


@kernel
def advance(kind: int, table: Array, state: Array, start: int, value: float) -> float:
    """Step an operator to the input ``value``; return the output and update ``state``.

    Args:
        kind: kind of the operator, see `OperatorTable`.
        table: constants of the operator: for plays, rows of thresholds (the first is 0) and weights (the first is p0);
            for Bouc-Wen, A, β, γ and g.
        state: array that contains the positions of the plays, or u and h, from ``start`` on.
        start: index at which the operator's own state begins; passing a slice would take longer than the step.
        value: relative input.
    """
    if kind == PLAYS:
        result = table[1, 0] * value
        for i in range(1, table.shape[1]):
            place = start + i - 1
            state[place] = play(state[place], table[0, i], value)
            result += table[1, i] * state[place]
        return float(result)
    if kind in (_BOUC_WEN, _BOUC_WEN_INVERSE):
        u, h, gain = state[start], state[start + 1], table[0, 3]
        if kind == _BOUC_WEN_INVERSE:
            rise = value / gain - (u - h)
            way = 1.0 if rise > 0.0 else -1.0
            new_u = u + way * _needed(way * h, way * rise, table[0])
        else:
            new_u = value
        way = 1.0 if new_u > u else -1.0
        h = way * _move(way * h, way * (new_u - u), table[0])
        state[start], state[start + 1] = new_u, h
        return float(new_u if kind == _BOUC_WEN_INVERSE else gain * (new_u - h))
    return value


@kernel
def _plays_along(table: Array, state: Array, start: int, value: Array, result: Array) -> None:
    """Step play operators through a block, five operators at a time for speed.

    The output of a sample is summed in the same order as by `advance`, so that the results are bit-identical.
    """
    r, p = table[0], table[1]
    for k in range(value.size):
        result[k] = p[0] * value[k]
    i = 1
    while i + 4 < r.size:
        j = start + i - 1
        a, b, c, d, e = state[j], state[j + 1], state[j + 2], state[j + 3], state[j + 4]
        ra, rb, rc, rd, re = r[i], r[i + 1], r[i + 2], r[i + 3], r[i + 4]
        pa, pb, pc, pd, pe = p[i], p[i + 1], p[i + 2], p[i + 3], p[i + 4]
        for k in range(value.size):
            u = value[k]
            a, b, c, d, e = play(a, ra, u), play(b, rb, u), play(c, rc, u), play(d, rd, u), play(e, re, u)
            result[k] = result[k] + pa * a + pb * b + pc * c + pd * d + pe * e
        state[j], state[j + 1], state[j + 2], state[j + 3], state[j + 4] = a, b, c, d, e
        i += 5
    while i < r.size:
        a, ra, pa = state[start + i - 1], r[i], p[i]
        for k in range(value.size):
            a = play(a, ra, value[k])
            result[k] += pa * a
        state[start + i - 1] = a
        i += 1


@kernel
def advance_along(kind: int, table: Array, state: Array, start: int, value: Array, result: Array) -> None:
    """Step an operator through a block: fill ``result`` from ``value``, shape (n,); the arrays must not overlap."""
    if kind == PLAYS:
        _plays_along(table, state, start, value, result)
    else:
        for k in range(value.size):
            result[k] = advance(kind, table, state, start, value[k])


class Hysteresis:
    """Base class of hysteresis operators, which have a state.

    Attributes:
        law: kind and constants, for kernels that step the operator by `advance`.
        state: state of the operator, shape (n,).
        steepest: largest possible slope dy/du.
    """

    def __init__(self, law: OperatorTable, state: Array, steepest: float) -> None:
        self.law, self.state, self.steepest = law, state, steepest

    def block(self, value: Array, result: Array) -> None:
        """Step through a block of relative inputs: fill ``result`` from ``value``, shape (n,)."""
        advance_along(*self.law, self.state, 0, value, result)


def check_thresholds(thresholds: Array) -> None:
    """Check that the thresholds of play operators are positive and increasing.

    Raises:
        InputError: the thresholds are not positive and increasing.
    """
    rising = (thresholds[:1] > 0.0).all() and (thresholds[1:] > thresholds[:-1]).all()
    if not rising or not np.isfinite(thresholds).all():
        raise InputError(f"play thresholds {thresholds.tolist()}; allowed: above 0 and increasing")


def _weighted(
    thresholds: Array, weights: Array, proportional: float, state: Array
) -> tuple[OperatorTable, Array, float]:
    """Return the law, state and steepest slope of play operators in a given state."""
    table = np.empty((2, thresholds.size + 1))
    # The contributions of moving plays add up, so the steepest slope is the largest partial sum.
    table[:, 0], table[0, 1:], table[1, 1:] = (0.0, proportional), thresholds, weights
    return OperatorTable(PLAYS, table), state, float(np.cumsum(table[1]).max())


class PrandtlIshlinskii(Hysteresis):
    """Prandtl-Ishlinskii operator: weighted play operators in parallel with a proportional part.

    Args:
        thresholds: r_i, half-widths of the plays, positive and increasing, shape (n,).
        weights: p_i, shape (n,).
        proportional: p0.

    Raises:
        InputError: the thresholds do not increase, or there is no inverse.
    """

    def __init__(
        self, thresholds: Array = THRESHOLDS, weights: Array = WEIGHTS, proportional: float = PROPORTIONAL
    ) -> None:
        stacked("plays", thresholds=thresholds, weights=weights)
        check_thresholds(thresholds)
        slopes = proportional + np.append(0.0, np.cumsum(weights))
        if not (np.all(slopes > 0.0) and np.all(np.isfinite(slopes))):
            raise InputError(
                f"play weights: slope {slopes[np.argmin(slopes > 0.0)]:g} after {np.argmin(slopes > 0.0)} plays; "
                "allowed: above 0 for p0 and each sum p0 + p1 + ... (else there is no inverse)"
            )
        self.thresholds, self.weights, self.proportional = thresholds, weights, proportional
        super().__init__(*_weighted(thresholds, weights, proportional, np.zeros(thresholds.size)))

    def identified(self, scale: float) -> "PrandtlIshlinskii":
        """Return a model at rest with the play weights multiplied by ``scale``, as from an inexact identification."""
        return PrandtlIshlinskii(self.thresholds, self.weights * scale, self.proportional)

    def inverse(self) -> "PrandtlIshlinskiiInverse":
        """Return the inverse operator, starting at the current state."""
        return PrandtlIshlinskiiInverse(self)


class PrandtlIshlinskiiInverse(Hysteresis):
    """Inverse of `PrandtlIshlinskii` in closed form; itself a weighted sum of play operators.

    Args:
        forward: operator to invert. The inverse adopts its current state, so it is at rest if ``forward`` is at rest.
    """

    def __init__(self, forward: PrandtlIshlinskii) -> None:
        r, p, slopes = forward.thresholds, forward.weights, forward.proportional + np.cumsum(forward.weights)
        before = slopes - p  # slope before play i moves
        before[:1] = forward.proportional
        # At the point where play i begins to move, the output has travelled r'_i and the input r_i.
        thresholds = np.cumsum(before * np.diff(r, prepend=0.0))
        beyond = np.append(np.cumsum((p * forward.state)[::-1])[::-1][1:], 0.0)[: r.size]
        state = slopes * forward.state + beyond
        super().__init__(*_weighted(thresholds, -p / (slopes * before), 1.0 / forward.proportional, state))


class BoucWen(Hysteresis):
    """Bouc-Wen hysteresis operator with n = 1, in the form y = g·(u - h).

    Args:
        a: A, initial slope of h; with the other defaults, 0.33 gives a loop of 13 %.
        beta: β.
        gamma: γ.
        gain: g; None for the gain with which a steady loop over ±1 ends at ±1.

    Raises:
        InputError: h grows without bound, or there is no inverse.
    """

    def __init__(self, a: float = 0.33, beta: float = 0.7, gamma: float = 0.3, gain: float | None = None) -> None:
        if not (a > 0.0 and -beta < gamma <= beta):
            raise InputError(f"Bouc-Wen A = {a:g}, β = {beta:g}, γ = {gamma:g}; allowed: A > 0 and -β < γ <= β")
        self._fall = 2.0 * a * beta / (beta + gamma)
        if not self._fall < 1.0:
            raise InputError(
                f"Bouc-Wen A = {a:g}, β = {beta:g}, γ = {gamma:g}: 2Aβ/(β + γ) = {self._fall:g}; allowed: below 1 "
                "(else the loop turns back on itself and there is no inverse)"
            )
        self.a, self.beta, self.gamma = a, beta, gamma
        self.gain = 1.0 / (1.0 - self._end_of_loop()) if gain is None else gain
        table = np.array([[a, beta, gamma, self.gain]])
        super().__init__(OperatorTable(_BOUC_WEN, table), np.zeros(2), self.gain)

    def _end_of_loop(self) -> float:
        """Return the hysteretic part at the end of a steady loop over ±1, where a travel of 2 inverts its sign."""
        shape = np.array([self.a, self.beta, self.gamma])
        # It stays below A/(β + γ), apart from rounding.
        bound = 2.0 * self.a / (self.beta + self.gamma)
        return float(scipy.optimize.brentq(lambda h: _move(-h, 2.0, shape) - h, 0.0, bound, xtol=1e-15))

    @property
    def flattest(self) -> float:
        """Smallest possible slope dy/du."""
        return self.gain * (1.0 - self._fall)

    def identified(self, scale: float) -> "BoucWen":
        """Return a model at rest with A multiplied by ``scale``, as from an inexact identification."""
        return BoucWen(self.a * scale, self.beta, self.gamma, self.gain)

    def inverse(self) -> "BoucWenInverse":
        """Return the inverse operator, starting at the current state."""
        return BoucWenInverse(self)


class BoucWenInverse(Hysteresis):
    """Inverse of `BoucWen`, which solves for the step in u at each sample.

    Args:
        forward: operator to invert; the inverse adopts its current state.
    """

    def __init__(self, forward: BoucWen) -> None:
        super().__init__(
            OperatorTable(_BOUC_WEN_INVERSE, forward.law.table), forward.state.copy(), 1.0 / forward.flattest
        )
