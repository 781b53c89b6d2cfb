# SPDX-License-Identifier: Apache-2.0
"""Following error of a force or position loop: by revolution, after a step, at reversals, and at the command's limits.

A controller sees the measurement of ``delay`` samples ago, e(n) = r(n) - y(n - delay) with the set point r. From its
messages follows the error of the process itself,

    r(n - delay) - y(n - delay) = e(n) - r(n) + r(n - delay),

so that a delayed sensor does not look like a lagging loop. The last ``delay`` samples of a run have no measurement, and
a revolution that contains some of them is incomplete.

- A **step** is a change of the set point to a value that then stays constant for at least a revolution; the change
  counts from the last such value, at the start of a run from the measurement. The overshoot is the largest error beyond
  the new value within twice the time of its first arrival there: a second-order loop has its peak by then, and later
  errors are disturbances. The step is settled once the error stays within a band.
- A **reversal** is a change of the set point's direction without a rest. Friction and backlash show in the largest
  error soon after it, within a tenth of the time since the last reversal (quadrant glitch, as in ISO 230-4).
- The command is **saturated** while it is at a limit. Where the error drives it further out, anti-windup holds the
  integral. In the second half of a run, at a constant set point, a loop is **unstable** if its command swings, with a
  fifth of the time or more at each limit, or runs away, with nine tenths of the time at a limit, mostly against the
  error. With the error the set point is **out of reach**. The describing function of a limit gives 0.9 for a sine that
  spends a fifth of the time beyond each limit, so that a swinging loop has at least 1.1 times its critical gain.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lathe_rc.analysis.tolerance import LAST
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.form_errors import FormErrors, RunningErrors

BAND = 0.02  #: share of a step within which it is settled, without a tolerance
_TURN = 2.0 * np.pi
_MOST_TURNS = 1e9
_REST = 2  # longest rest at a reversal [sample]
_SOON = 0.1  # part of the time since the last reversal in which an error counts as that of a reversal
_SWINGS, _STAYS, _AGAINST = 0.2, 0.9, 0.5  # shares of the samples, see the module docstring
# State: number of samples so far; set point, and the last one that stayed; of the current constant set point: first
# sample, turns there, change and band, last sample outside the band and turns there, first arrival, overshoot; of the
# motion: direction, sample of the last reversal, of the last motion, last sample that belongs to a reversal; number of
# reversals; and the step kept: first sample, change, overshoot, samples to settle, 1 if there is one.
(_SAMPLES, _SET, _STAYED, _FROM, _BEGAN, _CHANGE, _BAND, _OUT, _OUT_TURNS, _REACHED, _PEAK, _SIGN, _REVERSED, _MOVED,
 _UNTIL, _REVERSALS, _STEP, _BY, _OVER, _SETTLED, _FOUND, _SIZE) = range(22)  # fmt: skip
# Row of a revolution: number of samples; sum, smallest and largest of the set point; sum and sum of squares of the
# error; samples at the upper and the lower limit, and with the integral held; largest error at a reversal.
_N, _SUM, _LOW, _HIGH, _MEAN, _SQUARE, _UPPER, _LOWER, _HELD, _GLITCH, _COLUMNS = range(11)


@dataclass(frozen=True)
class SetPointStep:
    """Answer of a loop to a change of its set point.

    Attributes:
        start: sample of the change, counted from the first one evaluated.
        change: new set point minus the last one.
        overshoot: largest error beyond the new set point within twice the time of its first arrival.
        settling: number of samples until the error stays within `band`; None if it does not.
        band: size of the band to each side.
    """

    start: int
    change: float
    overshoot: float
    settling: int | None
    band: float


@dataclass(frozen=True)
class Steady:
    """Average behaviour of a loop in the last revolutions.

    Attributes:
        over: first and last revolution, counted from 1.
        set_point: smallest and largest set point.
        mean: mean of the controlled quantity.
        error: mean error.
        deviation: standard deviation of the error.
    """

    over: tuple[int, int]
    set_point: tuple[float, float]
    mean: float
    error: float
    deviation: float


@dataclass(frozen=True)
class LimitUse:
    """Use of the limits of a command at a constant set point.

    Attributes:
        since: first revolution evaluated, counted from 1.
        upper, lower: shares of the samples at the upper and the lower limit.
        held: share of the samples at which anti-windup holds the integral.
    """

    since: int
    upper: float
    lower: float
    held: float

    @property
    def state(self) -> Literal["swings", "runs away", "out of reach"] | None:
        """Failure of the loop; None if there is none."""
        if min(self.upper, self.lower) >= _SWINGS:
            return "swings"
        if (stays := max(self.upper, self.lower)) >= _STAYS:
            return "runs away" if self.held < _AGAINST * stays else "out of reach"
        return None


@dataclass(frozen=True)
class LoopErrors:
    """Behaviour of a loop in each complete revolution; arrays have the shape (revolutions,), values SI units.

    Attributes:
        errors: following error.
        mean: mean error.
        saturated: share of the samples at a limit of the command.
        held: share of the samples at which anti-windup holds the integral.
        limits: use of the command's limits in the second half of the run, at a constant set point; None without one.
        steady: behaviour in the last revolutions, ten at most; None without a revolution.
        step: answer to the largest step; None without one.
        reversals: number of reversals of the set point.
        glitch: largest error soon after a reversal; NaN without one.
    """

    errors: FormErrors
    mean: Array
    saturated: Array
    held: Array
    limits: LimitUse | None
    steady: Steady | None
    step: SetPointStep | None
    reversals: int
    glitch: float


@inlined
def _keep(state: Array, turns: float) -> None:
    """Keep the current step if it is complete and the largest so far."""
    if state[_CHANGE] == 0.0 or not turns - state[_BEGAN] >= 1.0 or abs(state[_CHANGE]) <= abs(state[_BY]):
        return
    settled = turns - state[_OUT_TURNS] >= 1.0
    state[_STEP], state[_BY], state[_OVER], state[_FOUND] = state[_FROM], state[_CHANGE], state[_PEAK], 1.0
    state[_SETTLED] = state[_OUT] + 1.0 - state[_FROM] if settled else -1.0


@kernel
def _end(state: Array, turns: float) -> None:
    """Keep the step at the end of a run, if it is the largest."""
    _keep(state, turns)


@inlined
def _begin(state: Array, turns: float, wanted: float, stayed: float, tolerance: float) -> None:
    """Begin a constant set point."""
    n, change = state[_SAMPLES], wanted - stayed
    state[_STAYED], state[_FROM], state[_BEGAN], state[_CHANGE] = stayed, n, turns, change
    state[_BAND] = tolerance if tolerance > 0.0 else BAND * abs(change)
    state[_OUT], state[_OUT_TURNS], state[_REACHED], state[_PEAK] = n - 1.0, turns, -1.0, 0.0


@inlined
def _turn(state: Array, sign: float) -> None:
    """Notice a motion of the set point, and a reversal."""
    n = state[_SAMPLES]
    if sign != state[_SIGN]:
        if state[_SIGN] != 0.0 and n - state[_MOVED] <= _REST + 1.0:
            state[_UNTIL] = n + _SOON * (n - state[_REVERSED])
            state[_REVERSALS] += 1.0
        state[_REVERSED] = n
    state[_SIGN], state[_MOVED] = sign, n


@inlined
def _answer(state: Array, turns: float, error: float) -> None:
    """Notice where the process is after a step."""
    n = state[_SAMPLES]
    if not abs(error) <= state[_BAND]:
        state[_OUT], state[_OUT_TURNS] = n, turns
    beyond = -error if state[_CHANGE] > 0.0 else error
    if beyond >= 0.0 and state[_REACHED] < 0.0:
        state[_REACHED] = n
    if state[_REACHED] >= 0.0 and n - state[_FROM] <= 2.0 * (state[_REACHED] - state[_FROM]):
        state[_PEAK] = max(state[_PEAK], beyond)


@inlined
def _count(row: Array, wanted: float, error: float, seen: float, command: float, limit: float) -> None:
    """Add a sample to its revolution."""
    if row[_N] == 0.0:
        row[_LOW], row[_HIGH] = wanted, wanted
    row[_N] += 1.0
    row[_SUM] += wanted
    row[_LOW], row[_HIGH] = min(row[_LOW], wanted), max(row[_HIGH], wanted)
    row[_MEAN] += error
    row[_SQUARE] += error * error
    upper, lower = command >= limit, command <= -limit
    row[_UPPER] += upper
    row[_LOWER] += lower
    row[_HELD] += (upper and seen > 0.0) or (lower and seen < 0.0)


@kernel
def _watch(
    state: Array, rows: Array, first: int, turns: Array, samples: Array, errors: Array, limit: float, tolerance: float
) -> None:
    """Process samples: set point, error that the controller sees, command (rows of ``samples``), and process error."""
    for k in range(turns.size):
        n, wanted, error = state[_SAMPLES], samples[0, k], errors[k]
        if n == 0.0:
            stayed = wanted if first > 0 else wanted - error  # a snapshot does not begin with a step
            _begin(state, turns[k], wanted, stayed, tolerance)
        elif wanted != state[_SET]:
            _keep(state, turns[k])
            stayed = state[_SET] if turns[k] - state[_BEGAN] >= 1.0 else state[_STAYED]
            _begin(state, turns[k], wanted, stayed, tolerance)
            _turn(state, 1.0 if wanted > state[_SET] else -1.0)
        state[_SET] = wanted
        _answer(state, turns[k], error)
        place = int(turns[k]) - first
        if place >= 0:
            _count(rows[place], wanted, error, samples[1, k], samples[2, k], limit)
            if n <= state[_UNTIL]:
                rows[place, _GLITCH] = max(rows[place, _GLITCH], abs(error))
        state[_SAMPLES] = n + 1.0


class RunningLoop:
    """Accumulator of the behaviour of a loop, fed chunk by chunk.

    Args:
        first: number of revolutions before the first evaluated one, see `form_errors.turns_before`.
        delay: age of the measurement in the controller's error [sample].
        limit: command from which on it counts as saturated, in its unit.
        tolerance: band within which a step is settled; 0: `BAND` of the step.
    """

    def __init__(self, first: int, delay: int, limit: float, tolerance: float = 0.0) -> None:
        self._first, self._delay, self._limit, self._tolerance = first, delay, limit, tolerance
        self._errors = RunningErrors(first)
        self._state, self._rows, self._turns = np.zeros(_SIZE), np.zeros((1, _COLUMNS)), 0.0
        self._state[_UNTIL] = -1.0
        self._waiting = np.empty((4, 0))  # angle, set point, error and command of samples without a measurement

    def add(self, angle: Array, set_point: Array, error: Array, command: Array) -> None:
        """Process the next samples, shape (n,): true angle [rad], and the fields of the controller's messages.

        Raises:
            InputError: the angle falls or is absurd, or a revolution has no sample.
        """
        held = np.concatenate([self._waiting, np.stack([angle, set_point, error, command])], axis=1)
        count = max(held.shape[1] - self._delay, 0)
        self._waiting = held[:, count:].copy()
        if not count:
            return
        known, seen = held[:, :count], held[:, self._delay :]
        process = seen[2] - seen[1] + known[1]
        turns = known[0] / _TURN
        # The kernel finds the row of a sample by its angle.
        if not (self._turns <= turns[0] and (np.diff(turns) >= 0.0).all() and turns[-1] < _MOST_TURNS):
            raise InputError(f"the angle falls, or is beyond {_MOST_TURNS:.0e} turns; allowed: one that increases")
        self._errors.add(known[0], process)
        self._turns = float(turns[-1])
        if (missing := int(self._turns) - self._first + 1 - len(self._rows)) > 0:
            more = np.zeros((max(missing, len(self._rows)), _COLUMNS))
            self._rows = np.concatenate([self._rows, more])
        samples = np.ascontiguousarray(known[1:])
        _watch(self._state, self._rows, self._first, turns, samples, process, self._limit, self._tolerance)

    def found(self) -> LoopErrors:
        """Return the behaviour in all complete revolutions, as if the run ended after the samples so far."""
        errors = self._errors.found()
        rows = self._rows[: errors.rms.size]
        count, state = np.fmax(rows[:, _N], 1.0), self._state.copy()
        _end(state, self._turns)
        step = None
        if state[_FOUND]:
            band = self._tolerance or BAND * abs(float(state[_BY]))
            settling = int(state[_SETTLED]) if state[_SETTLED] >= 0.0 else None
            step = SetPointStep(int(state[_STEP]), float(state[_BY]), float(state[_OVER]), settling, band)
        return LoopErrors(
            errors,
            rows[:, _MEAN] / count,
            (rows[:, _UPPER] + rows[:, _LOWER]) / count,
            rows[:, _HELD] / count,
            _limits(rows, self._first),
            _steady(rows[-LAST:], self._first + len(rows)) if len(rows) else None,
            step,
            int(state[_REVERSALS]),
            float(rows[:, _GLITCH].max()) if state[_REVERSALS] and len(rows) else np.nan,
        )


def _steady(rows: Array, last: int) -> Steady:
    wanted, error, square = rows[:, [_SUM, _MEAN, _SQUARE]].sum(axis=0) / rows[:, _N].sum()
    deviation = float(np.sqrt(max(square - error * error, 0.0)))
    between = (float(rows[:, _LOW].min()), float(rows[:, _HIGH].max()))
    return Steady((last - len(rows) + 1, last), between, float(wanted - error), float(error), deviation)


def _limits(rows: Array, before: int) -> LimitUse | None:
    """Return the use of the limits in the last rows with the same set point, at most half of the rows."""
    if not len(rows):
        return None
    same = (rows[:, _LOW] == rows[-1, _HIGH]) & (rows[:, _HIGH] == rows[-1, _HIGH])
    start = max(len(rows) // 2, int(np.flatnonzero(~same)[-1]) + 1 if not same.all() else 0)
    if start == len(rows):
        return None
    upper, lower, held = rows[start:, [_UPPER, _LOWER, _HELD]].sum(axis=0) / rows[start:, _N].sum()
    return LimitUse(start + 1 + before, float(upper), float(lower), float(held))
