# SPDX-License-Identifier: Apache-2.0
"""Inverse of a drive with one resonance, which takes the place of that of second order once it has proved better.

    W(p) = e^{-pτ}·B(p)/A(p),   A = 1 + a1·p + a2·p² + a3·p³ + a4·p⁴,   B = 1 + b1·p + b2·p²
    A/B = q0 + q1·p + q2·p² + (s0 + s1·p)/B

The polynomial acts on a signal and its first two derivatives. The rest is a filter of two states in time, so the third
and the fourth derivative are not needed. The filter is integrated by the trapezoidal rule; its states are y and dy/dt
of b2·d²y/dt² + b1·dy/dt + y = s0·x + s1·dx/dt.

A new model is a candidate for a revolution: its filters settle beside those in use. Then the model is judged
by measurements that it was not fitted to. If it is adopted, the memory over the angle receives the difference of both
responses to the form, at the nominal speed.

Source: spec/resonance.md; rational feed-forward: Bolder, Oomen, van Zundert.
"""

from typing import NamedTuple

import numpy as np

from lathe_machine.control.identification import pass_through
from lathe_machine.control.rational_fit import (
    A1,
    A2,
    A3,
    A4,
    ADOPTED,
    B1,
    B2,
    COEFFICIENTS,
    JudgeTable,
    RationalFitTable,
    add_revolution,
    better,
    fitted_model,
    no_rational_measurements,
    safe,
)
from lathe_rc.arrays import Array, Integers
from lathe_rc.jit import inlined, kernel

_Q0, _Q1, _Q2, _S0, _S1 = range(5)  # indices in a quotient
FORM, OBSERVER, LEARNER, STEADY = range(4)  #: signals with a filter of their own; the last: the form at nominal speed
# Indices in the integer state: whether the rational model is in use, whether there is a candidate, number of logged
# verdicts, present sample.
_USED, _CANDIDATE, _LOGGED, _SAMPLE = range(4)
_LOG = 64  # verdicts that the log keeps
_FIRST_FIT = 4  # revolutions to the first fit; in earlier ones the command differs by the form that is being learned


class RationalTable(NamedTuple):
    """Rational inverse in use and its candidate, for kernels.

    Attributes:
        fits: whether models are fitted.
        half: half a sampling step [s].
        model: coefficients of A and B in use, and of the candidate, shape (2, 6) [s, s², s³, s⁴, s, s²].
        quotient: q0, q1, q2, s0 and s1 of both, shape (2, 5).
        rests: states y, dy/dt and input of the filters, and their signal, by model and signal, shape (2, 4, 4).
        fit: accumulated measurements.
        log: sample and verdict of each adoption and refusal, shape (n, 2); the newest at their number modulo n.
        state: integer state, indexed by the module's constants.
    """

    fits: bool
    half: float
    model: Array
    quotient: Array
    rests: Array
    fit: RationalFitTable
    log: Integers
    state: Integers


def rational_inverse(
    given: Array | None, *, step: float, points: int, bandwidth: float, judge: JudgeTable | None
) -> RationalTable:
    """Create the inverse in its initial state.

    Args:
        given: model in use from the start, shape (6,); None: that of second order, until one proves better.
        step: sampling step [s].
        points: grid points per revolution.
        bandwidth: that of the fit [rad/s].
        judge: memory loop for the margin of models; None: no model is fitted.
    """
    model, quotient, state = np.zeros((2, COEFFICIENTS)), np.zeros((2, 5)), np.zeros(4, np.int64)
    if given is not None:
        model[0], state[_USED] = given, 1
        divide(given, quotient[0])
    fit = no_rational_measurements(bandwidth, step, points if judge else 1, judge)
    rests, log = np.zeros((2, 4, 4)), np.zeros((_LOG, 2), np.int64)
    return RationalTable(judge is not None, 0.5 * step, model, quotient, rests, fit, log, state)


@inlined
def divide(model: Array, quotient: Array) -> None:
    """Fill the ``quotient`` of A/B, shape (5,), from a ``model``, shape (6,)."""
    q2 = model[A4] / model[B2]
    q1 = (model[A3] - q2 * model[B1]) / model[B2]
    q0 = (model[A2] - q2 - q1 * model[B1]) / model[B2]
    quotient[_Q0], quotient[_Q1], quotient[_Q2] = q0, q1, q2
    quotient[_S0], quotient[_S1] = 1.0 - q0, model[A1] - q1 - q0 * model[B1]


@inlined
def _inverted(
    model: Array, quotient: Array, rest: Array, half: float, value: float, first: float, second: float
) -> float:
    """Advance the filter of a ``model`` by two ``half`` steps [s]; return the response of A/B to a signal."""
    b1, b2 = model[B1], model[B2]
    v = quotient[_S0] * value + quotient[_S1] * first
    rate = rest[1] * (b2 - half * (b1 + half)) + half * (v + rest[2] - 2.0 * rest[0])
    rate /= b2 + half * (b1 + half)
    rest[0] += half * (rest[1] + rate)
    rest[1], rest[2], rest[3] = rate, v, value
    return float(quotient[_Q0] * value + quotient[_Q1] * first + quotient[_Q2] * second + rest[0])


@inlined
def _in_use(
    m: RationalTable, signal: int, half: float, second_order: float, value: float, first: float, second: float
) -> float:
    """Return the response of the model in use; that of ``second_order`` until one is adopted."""
    if not m.state[_USED]:
        m.rests[0, signal, 3] = value
        return second_order
    return _inverted(m.model[0], m.quotient[0], m.rests[0, signal], half, value, first, second)


@inlined
def inverted(m: RationalTable, signal: int, second_order: float, value: float, first: float, second: float) -> float:
    """Return the response of the inverse model in use to a signal [m]; advance its filters by a sample.

    Args:
        m: rational inverse.
        signal: which one, `FORM`, `OBSERVER` or `LEARNER`.
        second_order: response of the model of second order [m].
        value: its value [m].
        first: its first derivative [m/s].
        second: its second derivative [m/s²].
    """
    if m.state[_CANDIDATE]:
        _inverted(m.model[1], m.quotient[1], m.rests[1, signal], m.half, value, first, second)
    return _in_use(m, signal, m.half, second_order, value, first, second)


@inlined
def changed(m: RationalTable, step: float, second_order: float, value: float, first: float, second: float) -> float:
    """Return the response of the candidate minus that of the model in use to the form at the nominal speed [m].

    Arguments as of `inverted`; the filters are advanced by a ``step`` [s].
    """
    half = 0.5 * step
    more = _inverted(m.model[1], m.quotient[1], m.rests[1, STEADY], half, value, first, second)
    return more - _in_use(m, STEADY, half, second_order, value, first, second)


@inlined
def is_rational(m: RationalTable) -> bool:
    """Return whether the rational model is in use."""
    return bool(m.state[_USED])


@inlined
def at_sample(m: RationalTable, sample: int, position: float, command: float) -> None:
    """Pass the position and the command that it follows [m], known at a ``sample``, to the fit."""
    m.state[_SAMPLE] = sample
    if m.fits:
        low = m.fit.low
        pass_through(low.position, position, low.keep, low.take)
        pass_through(low.command, command, low.keep, low.take)


@inlined
def begin_at(m: RationalTable, position: float) -> None:
    """Set the filters to rest at the first measured position [m]."""
    m.fit.low.position[:] = m.fit.low.command[:] = position
    for signal in (OBSERVER, LEARNER):
        _rest(m, 0, signal, position)


@inlined
def _rest(m: RationalTable, row: int, signal: int, value: float) -> None:
    """Set the filter of a model and a signal to rest at a ``value`` of the signal [m]."""
    rest = m.rests[row, signal]
    rest[0] = rest[2] = m.quotient[row, _S0] * value
    rest[1], rest[3] = 0.0, value


@kernel
def proved(m: RationalTable, second_order: Array) -> bool:
    """Return whether a candidate errs less in the revolution that has ended than the model in use."""
    if not m.state[_USED]:  # A and B = 1 of the second order
        m.model[0, A1], m.model[0, A2] = second_order[0], second_order[1]
    return bool(m.state[_CANDIDATE] and better(m.fit, m.model[1], m.model[0]))


@kernel
def refit(m: RationalTable, revolutions: int) -> None:
    """Add the last of some ``revolutions`` to the measurements, and fit the next candidate."""
    add_revolution(m.fit, m.model[0])
    m.state[_CANDIDATE] = 0
    if revolutions < _FIRST_FIT or not fitted_model(m.fit, m.model[0], m.model[1]):
        return
    verdict = safe(m.fit, m.model[1])
    if verdict != ADOPTED:
        _log(m, verdict)
        return
    m.state[_CANDIDATE] = 1
    divide(m.model[1], m.quotient[1])
    for signal in (FORM, OBSERVER, LEARNER):
        _rest(m, 1, signal, m.rests[0, signal, 3])


@inlined
def use_candidate(m: RationalTable) -> None:
    """Put the candidate in the place of the model in use."""
    m.state[_USED] = 1
    for k in range(COEFFICIENTS):
        m.model[0, k] = m.model[1, k]
    for k in range(m.quotient.shape[1]):
        m.quotient[0, k] = m.quotient[1, k]
    for signal in range(m.rests.shape[1]):
        for k in range(m.rests.shape[2]):
            m.rests[0, signal, k] = m.rests[1, signal, k]
    _log(m, ADOPTED)


@inlined
def _log(m: RationalTable, verdict: int) -> None:
    """Log the verdict on a model, a refusal unless it has the ground of the one before."""
    if verdict != ADOPTED and verdict == m.log[(m.state[_LOGGED] - 1) % _LOG, 1]:
        return
    row = m.state[_LOGGED] % _LOG
    m.log[row, 0], m.log[row, 1] = m.state[_SAMPLE], verdict
    m.state[_LOGGED] += 1


def verdicts(m: RationalTable, first: int, end: int) -> list[tuple[int, int]]:
    """Return sample and verdict of the models that were adopted or refused from sample ``first`` on, before ``end``."""
    logged = int(m.state[_LOGGED])
    rows = (m.log[k % _LOG].tolist() for k in range(max(0, logged - _LOG), logged))
    return [(sample, verdict) for sample, verdict in rows if first <= sample < end]


@inlined
def forget_candidate(m: RationalTable) -> None:
    """Discard the candidate, whose measurements have a gap."""
    m.state[_CANDIDATE] = 0
