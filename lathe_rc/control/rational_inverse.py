# SPDX-License-Identifier: Apache-2.0
"""Inverse of a drive with one resonance, which takes the place of that of second order once it has proved better.

    W(p) = e^{-pτ}·B(p)/A(p),   A = 1 + a1·p + a2·p² + a3·p³ + a4·p⁴,   B = 1 + b1·p + b2·p²
    A/B = q0 + q1·p + q2·p² + (s0 + s1·p)/B

The polynomial acts on a signal and its first two derivatives. The rest is a filter of two states in time, so the third
and the fourth derivative are not needed. The filter is integrated by the trapezoidal rule; its states are y and dy/dt
of b2·d²y/dt² + b1·dy/dt + y = s0·x + s1·dx/dt.

A new model is a candidate first. Its filters run beside those in use for a revolution, in which they settle, and for a
second one, in which the difference of both feed-forwards is recorded over the angle. At its end the model is judged by
measurements that it was not fitted to. If it is adopted, the difference goes into the memory: the command then does not
change at that sample.

Source: spec/resonance.md; rational feed-forward: Bolder, Oomen, van Zundert.
"""

from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array, Integers
from lathe_rc.control.identification import pass_through
from lathe_rc.control.rational_fit import (
    A1,
    A2,
    A3,
    A4,
    ADOPTED,
    B1,
    B2,
    COEFFICIENTS,
    NO_BETTER,
    JudgeTable,
    RationalFitTable,
    add_revolution,
    better,
    fitted_model,
    no_rational_measurements,
    safe,
)
from lathe_rc.jit import inlined, kernel

_TURN = 2.0 * np.pi
_Q0, _Q1, _Q2, _S0, _S1 = range(5)  # indices in a quotient
FORM, OBSERVER, LEARNER = range(3)  #: signals with a filter of their own
# Indices in the integer state: whether the rational model is in use, age of the candidate in revolutions (0: there is
# none), number of logged verdicts, present sample, last recorded grid point.
_USED, _AGE, _LOGGED, _SAMPLE, _PLACE = range(5)
_LOG = 64  # verdicts that the log keeps
_BEFORE, _AT = (
    3,
    4,
)  # indices behind the signals: change of the form's response at the sample before, and its grid point
_SETTLED = 2  # age of a candidate from which its feed-forward is recorded


class RationalTable(NamedTuple):
    """Rational inverse in use and its candidate, for kernels.

    Attributes:
        fits: whether models are fitted.
        half: half a sampling step [s].
        model: coefficients of A and B in use, and of the candidate, shape (2, 6) [s, s², s³, s⁴, s, s²].
        quotient: q0, q1, q2, s0 and s1 of both, shape (2, 5).
        rests: states y, dy/dt and input of the filters, by model and signal, shape (2, 3, 3).
        more: response of the candidate minus the one in use by signal, that of the form one sample before, and the grid
            point of the latter, shape (5,) [m].
        changes: that of the form over the angle, shape (n,) [m].
        fit: accumulated measurements.
        log: sample and verdict of each adoption and refusal, shape (n, 2); the newest at their number modulo n.
        state: integer state, indexed by the module's constants.
    """

    fits: bool
    half: float
    model: Array
    quotient: Array
    rests: Array
    more: Array
    changes: Array
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
    model, quotient, state = np.zeros((2, COEFFICIENTS)), np.zeros((2, 5)), np.zeros(5, np.int64)
    if given is not None:
        model[0], state[_USED] = given, 1
        divide(given, quotient[0])
    size = points if judge else 1
    fit = no_rational_measurements(bandwidth, step, size, judge)
    rests, changes = np.zeros((2, 3, 3)), np.zeros(size)
    return RationalTable(
        judge is not None,
        0.5 * step,
        model,
        quotient,
        rests,
        np.zeros(5),
        changes,
        fit,
        np.zeros((_LOG, 2), np.int64),
        state,
    )


@inlined
def divide(model: Array, quotient: Array) -> None:
    """Fill the ``quotient`` of A/B, shape (5,), from a ``model``, shape (6,)."""
    q2 = model[A4] / model[B2]
    q1 = (model[A3] - q2 * model[B1]) / model[B2]
    q0 = (model[A2] - q2 - q1 * model[B1]) / model[B2]
    quotient[_Q0], quotient[_Q1], quotient[_Q2] = q0, q1, q2
    quotient[_S0], quotient[_S1] = 1.0 - q0, model[A1] - q1 - q0 * model[B1]


@inlined
def _inverted(m: RationalTable, row: int, signal: int, value: float, first: float, second: float) -> float:
    """Advance the filter of a model and a signal by a sample; return the response of A/B to the signal."""
    quotient, rest, half = m.quotient[row], m.rests[row, signal], m.half
    b1, b2 = m.model[row, B1], m.model[row, B2]
    v = quotient[_S0] * value + quotient[_S1] * first
    rate = rest[1] * (b2 - half * (b1 + half)) + half * (v + rest[2] - 2.0 * rest[0])
    rate /= b2 + half * (b1 + half)
    rest[0] += half * (rest[1] + rate)
    rest[1], rest[2] = rate, v
    return float(quotient[_Q0] * value + quotient[_Q1] * first + quotient[_Q2] * second + rest[0])


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
    found = _inverted(m, 0, signal, value, first, second) if m.state[_USED] else second_order
    if m.state[_AGE]:
        m.more[signal] = _inverted(m, 1, signal, value, first, second) - found
    return found


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
        m.rests[0, signal, 0] = m.rests[0, signal, 2] = m.quotient[0, _S0] * position


@inlined
def record(m: RationalTable, angle: float) -> None:
    """Record the change of the feed-forward at the grid points up to an angle [rad]."""
    if m.state[_AGE] == 0:
        return
    here, before, now = angle * (m.changes.size / _TURN), m.more[_BEFORE], m.more[FORM]
    place = int(np.floor(here))
    for point in range(max(m.state[_PLACE] + 1, place - m.changes.size + 1), place + 1):
        m.changes[point & (m.changes.size - 1)] = now + (before - now) * (here - point) / (here - m.more[_AT])
    m.state[_PLACE] = max(place, m.state[_PLACE])
    m.more[_BEFORE], m.more[_AT] = now, here


@kernel
def revolve(m: RationalTable, second_order: Array) -> bool:
    """End a revolution: judge the candidate, or fit a new one; return whether it has taken over."""
    fit, state, present, taken = m.fit, m.state, m.model[0], False
    if not state[_USED]:  # A and B = 1 of the second order
        present[A1], present[A2] = second_order[0], second_order[1]
    if state[_AGE] == _SETTLED:
        taken = better(fit, m.model[1], present)
        _judged(m, ADOPTED if taken else NO_BETTER)
        if taken:
            _use(m)
    elif state[_AGE]:
        state[_AGE] += 1
    add_revolution(fit, present)
    if not state[_AGE] and fitted_model(fit, present, m.model[1]):
        verdict = safe(fit, m.model[1])
        if verdict == ADOPTED:
            state[_AGE] = 1
            divide(m.model[1], m.quotient[1])
        else:
            _judged(m, verdict)
    return taken


@inlined
def _use(m: RationalTable) -> None:
    """Put the candidate in the place of the model in use."""
    m.state[_USED] = 1
    for k in range(COEFFICIENTS):
        m.model[0, k] = m.model[1, k]
    for k in range(m.quotient.shape[1]):
        m.quotient[0, k] = m.quotient[1, k]
    for signal in range(m.rests.shape[1]):
        for k in range(m.rests.shape[2]):
            m.rests[0, signal, k] = m.rests[1, signal, k]


@inlined
def _judged(m: RationalTable, verdict: int) -> None:
    """Log the verdict on the candidate, which is none any more."""
    m.state[_AGE] = 0
    if verdict != NO_BETTER:
        row = m.state[_LOGGED] % _LOG
        m.log[row, 0], m.log[row, 1] = m.state[_SAMPLE], verdict
        m.state[_LOGGED] += 1


def verdicts(m: RationalTable, told: int) -> list[tuple[int, int]]:
    """Return sample and verdict of the logged models but the first ``told``."""
    logged = int(m.state[_LOGGED])
    return [(int(m.log[k % _LOG, 0]), int(m.log[k % _LOG, 1])) for k in range(max(told, logged - _LOG), logged)]


@inlined
def forget_candidate(m: RationalTable) -> None:
    """Discard the candidate, whose measurements have a gap."""
    m.state[_AGE] = 0
