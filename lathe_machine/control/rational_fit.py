# SPDX-License-Identifier: Apache-2.0
"""Online identification of a drive with one resonance, from its command u and its measured position x.

    A·x = B·u(t - τ) + ψ(φ),   A = 1 + a1·p + ... + a4·p⁴,   B = 1 + b1·p + b2·p²,   τ known

All signals pass the low-pass F = (ω/(p + ω))⁶, whose stages give the derivatives. ψ repeats with the angle, so the
difference from the previous revolution at the same angle cancels it. Least squares of this difference determines the
six coefficients if the speed varies. Derivatives are in units of ω: with the second as unit of time the normal
equations are singular in double precision.

The error is that of the equation, weighted by |F|² alone. A division by the B of the step before (Sanathanan and
Koerner; Steiglitz and McBride) weights the antiresonance more, where a form has no waves, and gives larger errors of
the form.

Where the measurements do not determine a coefficient, a ridge holds it at its present value. At constant speed a model
is fitted only while the memory, and thus the command, still changes. Early revolutions, in which the error is large,
have a small weight.

Source: spec/resonance.md.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_machine.control.disturbance_memory import loop_response, smoothing_response
from lathe_machine.control.identification import LowPass, low_pass
from lathe_rc.arrays import Array, Complex
from lathe_rc.jit import inlined, kernel

A1, A2, A3, A4, B1, B2 = range(6)  #: indices in a model: coefficients of A and B [s, s², s³, s⁴, s, s²]
COEFFICIENTS = 6
RATIONAL_BAND = 5655.0  #: default bandwidth of F [rad/s], 900 Hz
_STAGES = 6  # of F; its fourth derivative needs four, two more suppress the noise
_RIDGE = 1e-7  # weight of the present model, relative to the energy of a regressor
_FORGETTING = 0.9  # of a revolution, at each later one
_EXCITED = 1e-4  # energy of the difference of dx/dt that is needed, relative to that of dx/dt
LEAST_DAMPING, MOST_DAMPING = 0.03, 0.5  #: of the zeros that are identified; with more there is no resonance
_BETTER = 0.7  # largest squared error of a candidate, relative to that of the model in use
LEAST_MARGIN = 0.1  #: drive margin that a model must leave if the drive is the given one
_WAVES = 64  # frequencies at which the margin is computed
_REACH = 4.0  # the highest one, in units of the cut-off of S

#: verdicts on a model: it is adopted, its zeros are not damped, it has no resonance, it leaves too small a margin
ADOPTED, UNSTABLE, SMOOTH, UNSAFE = range(1, 5)


class JudgeTable(NamedTuple):
    """Memory loop with the given model in place of the drive, at some frequencies, for the margin of other models.

    Attributes:
        frequency: frequencies [rad/s], shape (n,).
        given: A/B of the given model, real and imaginary part, shape (2, n).
        kept, learned: what a revolution keeps of the memory, and what it learns, with an exact model; the latter
            complex, shape (n,) and (2, n).
        low: response of the observer with its delay, shape (2, n); 0 without an observer.
    """

    frequency: Array
    given: Array
    kept: Array
    learned: Array
    low: Array


class RationalFitTable(NamedTuple):
    """Accumulated measurements for fitting a rational model.

    Attributes:
        low: low-pass F.
        latest, before: x and u - x with derivatives, at the present grid point and those of the previous revolution,
            shape (7,) and (7, n).
        fresh: products of their differences in the present revolution, and below them the squares of the signals
            themselves, shape (8, 7); of the products the upper triangle is used.
        sums: the same of all revolutions, each weighted by the inverse of the squared error that it left.
        judge: memory loop for the margin.
        powers: units of the coefficients in scaled time, shape (6,).
        scaled, factor, found: present and new model in scaled time, triangular factor of the normal equations, and
            their solution, shape (2, 6), (6, 6) and (6,); scratch arrays.
    """

    low: LowPass
    latest: Array
    before: Array
    fresh: Array
    sums: Array
    judge: JudgeTable
    powers: Array
    scaled: Array
    factor: Array
    found: Array


def no_rational_measurements(bandwidth: float, step: float, points: int, judge: JudgeTable | None) -> RationalFitTable:
    """Create an empty fit for ``points`` grid points per revolution."""
    size = COEFFICIENTS + 1
    none = np.zeros((2, 0))
    powers = bandwidth ** np.array([1.0, 2.0, 3.0, 4.0, 1.0, 2.0])
    return RationalFitTable(
        low_pass(bandwidth, step, _STAGES), np.zeros(size), np.zeros((size, points)), np.zeros((size + 1, size)),
        np.zeros((size + 1, size)), judge or JudgeTable(none[0], none, none[0], none, none),
        powers, np.zeros((2, COEFFICIENTS)), np.zeros((COEFFICIENTS, COEFFICIENTS)), np.zeros(COEFFICIENTS),
    )  # fmt: skip


def judge_of(
    model: Array,
    nominal_speed: float,
    learned_waves: float,
    points_per_revolution: int,
    learning_gain: float,
    learning_bandwidth: float,
    observer_bandwidth: float,
    late: float,
) -> JudgeTable:
    """Return the memory loop of a law; arguments: `lathe_machine.control.disturbance.disturbance`, ``late`` in s."""
    points, waves = points_per_revolution, _REACH * learned_waves * np.arange(1, _WAVES + 1) / _WAVES
    frequency = waves * nominal_speed
    kept, learned, low = loop_response(
        smoothing_response(learned_waves, points, waves),
        waves,
        nominal_speed,
        points_per_revolution=points,
        learning_gain=learning_gain,
        learning_bandwidth=learning_bandwidth,
        observer_bandwidth=observer_bandwidth,
        late=late,
    )
    given = _parts(inverse_response(model, frequency))
    return JudgeTable(frequency, given, kept, _parts(learned), _parts(low))


def inverse_response(model: Array, frequency: Array) -> Complex:
    """Return A/B of a ``model``, shape (6,), at frequencies [rad/s], shape (n,)."""
    p = 1j * frequency
    return np.asarray(np.polyval([*model[A4::-1], 1.0], p) / np.polyval([model[B2], model[B1], 1.0], p))


def _parts(values: npt.ArrayLike) -> Array:
    return np.stack((np.real(values), np.imag(values)))


def forget_rational(m: RationalFitTable) -> None:
    """Discard all measurements of a fit."""
    for array in (m.before, m.fresh, m.sums):
        array[:] = 0.0


@inlined
def _differences(stages: Array, level: int) -> float:
    """Return the derivative of order ``level`` of the output of a low-pass, in units of its bandwidth."""
    last = stages.size - 1
    value, weight = 0.0, 1.0
    for k in range(level + 1):  # binomial coefficients with alternating signs
        value += weight * stages[last - level + k]
        weight *= -(level - k) / (k + 1.0)
    return value


@inlined
def put_latest(m: RationalFitTable) -> None:
    """Store x and u with their derivatives at the present sample."""
    position, command = m.low.position, m.low.command
    for k in range(4):
        m.latest[k] = _differences(position, k + 1)
    m.latest[4], m.latest[5] = -_differences(command, 1), -_differences(command, 2)
    m.latest[6] = command[command.size - 1] - position[position.size - 1]


@kernel
def sum_up_rational(m: RationalFitTable, here: int, again: bool) -> None:  # noqa: FBT001 - kernels take arguments by position
    """Add the signals at grid point ``here``, where the previous revolution has some if ``again``."""
    size = m.latest.size
    for i in range(size):
        m.fresh[size, i] += m.latest[i] * m.latest[i]
    if again:
        for i in range(size):
            for j in range(i, size):
                m.fresh[i, j] += (m.latest[i] - m.before[i, here]) * (m.latest[j] - m.before[j, here])
    for i in range(size):
        m.before[i, here] = m.latest[i]


@kernel
def _solved(m: RationalFitTable, present: Array, found: Array) -> bool:
    """Solve the normal equations with the ridge by Cholesky's method."""
    size, low = found.size, m.factor
    for i in range(size):
        more = _RIDGE * m.sums[size + 1, i]
        found[i] = m.sums[i, size] + more * present[i]
        for j in range(i + 1):
            value = m.sums[j, i]
            if i == j:
                value += more
            for k in range(j):
                value -= low[i, k] * low[j, k]
            if i > j:
                low[i, j] = value / low[j, j]
            elif value > 0.0:
                low[i, i] = np.sqrt(value)
            else:
                return False
    for i in range(size):
        for k in range(i):
            found[i] -= low[i, k] * found[k]
        found[i] /= low[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            found[i] -= low[k, i] * found[k]
        found[i] /= low[i, i]
    return True


@kernel
def _squares(sums: Array, model: Array) -> float:
    """Return the sum of the squared errors of a model in scaled time."""
    size = model.size
    total = sums[size, size]
    for i in range(size):
        total += (sums[i, i] * model[i] - 2.0 * sums[i, size]) * model[i]
        for j in range(i + 1, size):
            total += 2.0 * sums[i, j] * model[i] * model[j]
    return float(total)


@inlined
def damped(a: Array) -> bool:
    """Return whether the zeros of a model are damped, and the drive is a lag at low frequencies."""
    zeros = a[B2] > 0.0 and a[B1] > 2.0 * LEAST_DAMPING * np.sqrt(a[B2])
    return bool(zeros and a[A1] > 0.0 and a[A2] > 0.0 and a[A4] != 0.0)


@kernel
def drive_margin(judge: JudgeTable, model: Array) -> float:
    """Return a lower bound of the drive margin with a ``model``, if the drive is the given one.

    With an error of the drive of the size e, 1 + E = (1 + E0)(1 + e) and the factor of a revolution
    kept - learned·(1 + E)/(1 + E·L) has a magnitude below 1 for

        e < (|1 + E0·L| - |kept·(1 + E0·L) - learned·(1 + E0)|)/(|1 + E0|·(|kept·L - learned| + |L|))
    """
    least = np.inf
    for k in range(judge.frequency.size):
        w = judge.frequency[k]
        above = complex(1.0 - w * w * (model[A2] - w * w * model[A4]), w * (model[A1] - w * w * model[A3]))
        below = complex(1.0 - w * w * model[B2], w * model[B1])
        given = complex(judge.given[0, k], judge.given[1, k])
        learned, low = complex(judge.learned[0, k], judge.learned[1, k]), complex(judge.low[0, k], judge.low[1, k])
        ratio = above / (below * given)
        inside = 1.0 + (ratio - 1.0) * low
        room = _size(inside) - _size(judge.kept[k] * inside - learned * ratio)
        least = min(least, room / (_size(ratio) * (_size(judge.kept[k] * low - learned) + _size(low)) + 1e-300))
    return float(least)


@inlined
def _size(value: complex) -> float:
    return float(np.sqrt(value.real * value.real + value.imag * value.imag))


@inlined
def _scale(m: RationalFitTable, row: int, model: Array) -> Array:
    """Return a ``model`` in scaled time, in a row of the scratch array."""
    for k in range(COEFFICIENTS):
        m.scaled[row, k] = model[k] * m.powers[k]
    scaled: Array = m.scaled[row]
    return scaled


@inlined
def _error(sums: Array, scaled: Array) -> float:
    """Return the squared error of the command by a model: that of the equation over |B|² at a mean frequency."""
    square = sums[B2, B2] / sums[B1, B1] if sums[B1, B1] > 0.0 else 0.0  # of the differences of the command
    return _squares(sums, scaled) / float((1.0 - square * scaled[B2]) ** 2 + square * scaled[B1] ** 2)


@kernel
def safe(m: RationalFitTable, model: Array) -> int:
    """Return why a ``model`` cannot be used, or `ADOPTED`."""
    if not damped(model):
        return UNSTABLE
    if model[B1] > 2.0 * MOST_DAMPING * np.sqrt(model[B2]):
        return SMOOTH
    return ADOPTED if drive_margin(m.judge, model) >= LEAST_MARGIN else UNSAFE


@kernel
def better(m: RationalFitTable, model: Array, present: Array) -> bool:
    """Return whether a ``model`` errs less than the ``present`` one in the revolution that has ended."""
    new = _error(m.fresh, _scale(m, 1, model))
    return bool(new < _BETTER * _error(m.fresh, _scale(m, 0, present)))


@kernel
def add_revolution(m: RationalFitTable, present: Array) -> None:
    """Add the revolution that has ended to the sums, weighted by the error that the ``present`` model left."""
    left = _error(m.fresh, _scale(m, 0, present))
    for i in range(m.sums.shape[0]):
        for j in range(m.sums.shape[1]):
            more = m.fresh[i, j] / left if left > 0.0 else 0.0
            m.sums[i, j] = _FORGETTING * m.sums[i, j] + more
            m.fresh[i, j] = 0.0


@kernel
def fitted_model(m: RationalFitTable, present: Array, model: Array) -> bool:
    """Fit a ``model``, shape (6,); return False if the measurements do not determine it."""
    found = m.found
    if not m.sums[0, 0] > _EXCITED * m.sums[COEFFICIENTS + 1, 0] or not _solved(m, _scale(m, 0, present), found):
        return False
    for k in range(COEFFICIENTS):
        model[k] = found[k] / m.powers[k]
    return True
