# SPDX-License-Identifier: Apache-2.0
"""Form error of a run for each revolution, computed chunk by chunk.

A revolution begins with the first sample at or after its initial angle. The mean square is taken over the angle, not
over time: each sample is weighted by the angle to the next one, so that slow parts of a revolution do not count more.
An incomplete last revolution is omitted unless fewer than two samples are missing.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array, Integers
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel

_TURN = 2.0 * np.pi
# State: samples so far; turns at the last sample and at the one before, error of the last; number of the current
# revolution and index of its first sample; its sums of squares and of weights; its largest and smallest error.
_SAMPLES, _TURNS, _BEFORE, _ERROR, _NUMBER, _START, _SQUARE, _WEIGHT, _HIGH, _LOW = range(10)
_ROWS = 64  # initial capacity in complete revolutions


@dataclass(frozen=True)
class FormErrors:
    """Form error of each complete revolution, shape (revolutions,).

    Attributes:
        rms: root mean square over the angle [m].
        largest: largest magnitude [m].
        peak_to_valley: largest minus smallest value [m].
        starts: index of the first sample of each revolution, and of the sample after the last.
    """

    rms: Array
    largest: Array
    peak_to_valley: Array
    starts: Integers

    def told(self, error: str = "form error", unit: str = "µm", scale: float = 1e6) -> list[str]:
        """Describe the error in the first and the last revolution as a text line; none without a revolution.

        Args:
            error: name of the error.
            unit: unit in the text.
            scale: number of these units in an SI unit.
        """
        ends = [f"{rms * scale:.4g}" for rms in (*self.rms[:1], *self.rms[1:][-1:])]
        return [f"{error} {' to '.join(ends)} {unit} RMS"] if ends else []


def turns_before(angle: Array, first: int) -> int:
    """Return the number of revolutions before the first complete one: 0 for a run, more for a snapshot.

    Args:
        angle: true spindle angle [rad], shape (n,).
        first: index of the first sample.
    """
    within = angle.size and (first or angle[0] >= _TURN)  # a run counts its first revolution from wherever it begins
    return max(int(np.ceil(angle[0] / _TURN)), 0) if within else 0


def turns_at_end(before: float, last: float) -> int:
    """Compute the number of completed revolutions at the end of a run, from the turns at its last two samples."""
    return int(np.floor(last + min(2.0 * (last - before), 0.5)))


def that_count(angle: Array, error: Array) -> npt.NDArray[np.intp] | slice:
    """Select the samples of a chunk, shape (n,), that determine the form errors.

    If the spindle stands still for the whole chunk, these are the first, the last and the extreme samples, so that a
    standstill of minutes requires no memory.
    """
    if angle.size < 5 or angle[0] != angle[-1]:
        return slice(None)
    return np.unique([0, np.argmin(error), np.argmax(error), angle.size - 1])


@inlined
def _close(row: Array, start: float, square: float, weight: float, high: float, low: float) -> None:
    """Fill in the row of a revolution: first sample, RMS, largest and smallest error."""
    row[0], row[1], row[2], row[3] = start, np.sqrt(square / weight), high, low
    if not row[1] < np.inf:  # NaN, which comparisons ignore
        row[2] = row[3] = row[1]


@kernel
def _add(state: Array, rows: Array, angle: Array, error: Array, start: int) -> tuple[int, int]:
    """Process samples starting at ``start``, until the end of the chunk or until all rows are filled.

    Returns:
        Number of samples processed; number of rows filled, or -1 if a revolution has no sample.
    """
    # Local variables, because the compiler keeps them in registers; arrays might overlap.
    samples, last, before, held = state[_SAMPLES], state[_TURNS], state[_BEFORE], state[_ERROR]
    number, begin = state[_NUMBER], state[_START]
    square, weight, high, low = state[_SQUARE], state[_WEIGHT], state[_HIGH], state[_LOW]
    found, k = 0, start
    while k < angle.size and 0 <= found < rows.shape[0]:
        turns = angle[k] / _TURN
        if samples > 0.0:
            # The last sample is added now, because its weight is known.
            square += held * held * (turns - last)
            weight += turns - last
            high, low = max(high, held), min(low, held)
        if turns >= number + 1.0:
            if begin >= 0.0:
                _close(rows[found], begin, square, weight, high, low)
                found += 1
            number += 1.0
            begin, square, weight, high, low = samples, 0.0, 0.0, -np.inf, np.inf
            if turns >= number + 1.0:
                found = -1
        samples += 1.0
        last, before, held = turns, last, error[k]
        k += 1
    state[_SAMPLES], state[_TURNS], state[_BEFORE], state[_ERROR] = samples, last, before, held
    state[_NUMBER], state[_START] = number, begin
    state[_SQUARE], state[_WEIGHT], state[_HIGH], state[_LOW] = square, weight, high, low
    return k, found


@kernel
def _end(state: Array, row: Array) -> None:
    """Complete the current revolution with the last sample, weighted like the previous one."""
    held, step = state[_ERROR], state[_TURNS] - state[_BEFORE]
    square, weight = state[_SQUARE] + held * held * step, state[_WEIGHT] + step
    _close(row, state[_START], square, weight, max(state[_HIGH], held), min(state[_LOW], held))


def _plain(samples: Array) -> Array:
    """Convert samples to the array layout of the kernel, which would otherwise be compiled once more."""
    fits = samples.flags.carray and samples.dtype == np.float64
    return samples if fits else np.require(samples, np.float64, ["C", "W"])


class RunningErrors:
    """Accumulator of the form errors per revolution, fed chunk by chunk.

    Args:
        first: number of revolutions before the first evaluated one, see `turns_before`.
    """

    def __init__(self, first: int = 0) -> None:
        self._state = np.zeros(10)
        self._state[_NUMBER], self._state[_START] = first - 1, -1
        self._rows, self._filled = np.empty((_ROWS, 4)), 0

    def add(self, angle: Array, error: Array) -> None:
        """Process the next chunk of samples.

        Args:
            angle: true spindle angle [rad], increasing, shape (n,).
            error: form error [m], shape (n,).

        Raises:
            InputError: a revolution has no sample.
        """
        angle, error = _plain(angle), _plain(error)
        start = 0
        while start < angle.size:
            start, found = _add(self._state, self._rows[self._filled :], angle, error, start)
            if found < 0:
                raise InputError(
                    f"revolution {int(self._state[_NUMBER])} has no sample; allowed: an angle that increases by less "
                    "than a revolution from sample to sample"
                )
            self._filled += found
            if self._filled == len(self._rows):
                self._rows = np.concatenate((self._rows, np.empty_like(self._rows)))

    def _complete(self) -> tuple[Array, float]:
        """Return the rows of all complete revolutions, as if the run ended after the samples so far, and their end."""
        state, filled = self._state, self._filled
        if state[_SAMPLES] < 2.0:
            return self._rows[:0], 0.0
        end = state[_START] if state[_START] >= 0.0 else state[_SAMPLES]
        if end < state[_SAMPLES] and turns_at_end(state[_BEFORE], state[_TURNS]) > state[_NUMBER]:
            end = state[_SAMPLES]
            _end(state, self._rows[filled])  # in a free row, which further samples overwrite
            filled += 1
        return self._rows[:filled], float(end)

    def found(self) -> FormErrors:
        """Return the form errors of all complete revolutions, as if the run ended after the samples so far."""
        rows, end = self._complete()
        start, rms, high, low = rows.T.copy()
        return FormErrors(rms, np.maximum(high, -low), high - low, np.append(start, end).astype(np.int64))

    def largest(self) -> Array:
        """Return the largest magnitudes alone [m], shape (revolutions,)."""
        rows, _ = self._complete()
        return np.asarray(np.maximum(rows[:, 2], -rows[:, 3]))


def form_errors(angle: Array, error: Array, first: int = 0) -> FormErrors:
    """Compute the form errors per revolution of a complete run (implemented by `RunningErrors`)."""
    running = RunningErrors(first)
    running.add(angle, error)
    return running.found()
