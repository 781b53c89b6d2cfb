# SPDX-License-Identifier: Apache-2.0
"""Rules of the monitors, with results that do not depend on the block length.

One kernel processes the samples for all monitors of a cell; each row of a table gives a rule, its signals and the
location of its state, the array ``memory``. A rule first checks a stretch of samples in a vectorised loop, and
processes the samples one by one only if the check finds a violation.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array, Integers, put
from lathe_rc.jit import inlined, kernel

Pulses = npt.NDArray[np.uint8]

THRESHOLD, RATE, INDEX, GROWTH = range(4)  #: numbers of the rules in the table
TURN = 2.0 * np.pi  #: a revolution [rad]
_STRETCH = 256  # number of samples checked at a time


@inlined
def _beyond(value: float, offset: float, low: float, high: float) -> bool:
    """Return whether a value is beyond its limits or NaN; symmetric limits, the common case, need one comparison."""
    value -= offset
    return not abs(value) <= high if low == -high else not low <= value <= high


@kernel
def _any_beyond(signal: Array, other: Array, memory: Array) -> int:
    """Return 0 if enough consecutive samples may be beyond the limits or may begin to be at the last one; otherwise -1.

    ``memory`` is as in `_lasting_beyond`. If n consecutive samples are needed, checking every n-th sample and the
    last one suffices, provided that the sample before the first was not beyond the limits.
    """
    offset, low, high, needed = memory[0], memory[1], memory[2], int(memory[3])
    count = 0
    if needed > 1:
        for k in range(needed - 1, signal.size, needed):
            count += _beyond(signal[k] - (other[k] if other.size else 0.0), offset, low, high)
        if signal.size:
            count += _beyond(signal[-1] - (other[-1] if other.size else 0.0), offset, low, high)
    elif other.size:
        for k in range(signal.size):
            count += _beyond(signal[k] - other[k], offset, low, high)
    else:
        for k in range(signal.size):
            count += _beyond(signal[k], offset, low, high)
    return 0 if count else -1


@inlined
def _over(memory: Array) -> bool:
    """Return whether the initial alarm-free angle has been passed (``memory`` as in `_lasting_beyond`)."""
    return bool(memory[5] == 0.0 or memory[6] == -np.inf)


@kernel
def _forgiven(angle: Array, memory: Array) -> int:
    """Count the samples of the block within the initial alarm-free angle (``memory`` as in `_lasting_beyond`)."""
    if _over(memory) or not angle.size:
        return 0
    if np.isnan(memory[6]):
        memory[6] = angle[0] + memory[5]
    for k in range(angle.size):
        if angle[k] >= memory[6]:
            memory[6] = -np.inf  # final, even if the angle turns back
            return k
    return angle.size


@kernel
def _lasting_beyond(signal: Array, other: Array, angle: Array, memory: Array) -> int:
    """Return the first sample at which enough consecutive samples were beyond the limits; -1 if there is none.

    ``memory``: offset, lower and upper limit, number of consecutive samples required, current number of consecutive
    samples; alarm-free spindle angle after the first sample or a reset, and the angle at which it ends, NaN before it
    begins.
    """
    if memory[4] == 0.0 and _over(memory) and _any_beyond(signal, other, memory) < 0:
        return -1
    for k in range(_forgiven(angle, memory), signal.size):
        value = signal[k] - (other[k] if other.size else 0.0)
        memory[4] = memory[4] + 1.0 if _beyond(value, memory[0], memory[1], memory[2]) else 0.0
        if memory[4] >= memory[3]:
            return k
    return -1


@kernel
def clear(position: Array, memory: Array) -> tuple[int, float]:
    """Find the first sample at which enough consecutive samples were at or beyond a position.

    ``memory``, which remains unchanged: the position, the number of consecutive samples required, and the number
    reached before the block.

    Returns:
        The sample, or -1 if there is none, and the number of consecutive samples up to it or to the end of the block.
    """
    run = memory[2]
    for k in range(position.size):
        run = run + 1.0 if position[k] >= memory[0] else 0.0
        if run >= memory[1]:
            return k, run
    return -1, run


@inlined
def _differ(after: float, before: float, limit: float) -> bool:
    return not abs(after - before) <= limit


@inlined
def _how_many_differ(after: Array, before: Array, limit: float) -> int:
    count = 0  # without a branch, so that the compiler vectorises the loop
    for k in range(after.size):
        count += _differ(after[k], before[k], limit)
    return count


@kernel
def _changing(signal: Array, memory: Array) -> int:
    """Return the first sample that differs by more than the limit from the one a window earlier; -1 if there is none.

    ``memory``: limit, difference at that sample, and the samples of the last window.
    """
    limit, past, size = memory[0], memory[2:], signal.size
    window = past.size
    count = _how_many_differ(signal[:window], past, limit) + _how_many_differ(signal[window:], signal, limit)
    found = -1
    for k in range(size if count else 0):
        before = past[k] if k < window else signal[k - window]
        if _differ(signal[k], before, limit):
            found = k
            memory[1] = abs(signal[k] - before)
            break
    kept = max(window - size, 0)
    for k in range(kept):
        past[k] = past[k + size]
    put(past[kept:], signal[size - window + kept :])
    return found


@inlined
def _next(pulse: Pulses, begin: int) -> int:
    """Return the first index pulse at or after a sample; the size of the block if there is none."""
    for start in range(begin, pulse.size, _STRETCH):
        piece, some = pulse[start : start + _STRETCH], np.uint8(0)
        for k in range(piece.size):
            some |= piece[k]
        for k in range(piece.size if some else 0):
            if piece[k]:
                return start + k
    return pulse.size


@inlined
def _off(since: float, limit: float) -> bool:
    """Return whether an angle since the index pulse is negative or above one revolution, by more than the limit."""
    return since > TURN + limit or since < -limit


@kernel
def _first_off(angle: Array, last: float, limit: float) -> int:
    """Return the first sample with an impossible angle since the index pulse; -1 if there is none."""
    count = 0
    for k in range(angle.size):
        count += _off(angle[k] - last, limit)
    for k in range(angle.size if count else 0):
        if _off(angle[k] - last, limit):
            return k
    return -1


@kernel
def _index(angle: Array, pulse: Pulses, at: int, memory: Array) -> int:
    """Return the first sample whose angle is inconsistent with the index pulses, -1 if none; ``at``: the first pulse.

    ``memory``: limit, angle of the last pulse, deviation found, whether there was a pulse. Until the first pulse, the
    first angle takes the place of the last pulse's angle, and the first pulse may come early.
    """
    limit, begin = memory[0], 0
    if angle.size and np.isnan(memory[1]):
        memory[1] = angle[0]
    while begin < angle.size:
        last = memory[1]
        found = _first_off(angle[begin : at + 1], last, limit)
        if found >= 0:
            found += begin
        elif at < angle.size and memory[3] > 0.0 and angle[at] - last < TURN - limit:
            found = at
        if found >= 0:
            memory[2] = abs(angle[found] - last - TURN)
            return found
        if at < angle.size:
            memory[1], memory[3] = angle[at], 1.0
        begin, at = at + 1, _next(pulse, at + 1)
    return -1


SUMS = 128  # interleaved sums of squares, so that the loop vectorises; a single sum would be a serial dependency


@inlined
def _add(error: Array, memory: Array) -> None:
    """Add the squares of further errors of the current revolution (``memory`` as in `_growing`)."""
    # Sum k takes every 128th error since the pulse, independent of block boundaries: the order of summation is fixed.
    sums = memory[7:]
    start = int(memory[3]) % sums.size
    head = min(sums.size - start, error.size)
    for k in range(head):
        sums[start + k] += error[k] * error[k]
    for first in range(head, error.size, sums.size):
        row = error[first : first + sums.size]
        for k in range(row.size):
            sums[k] += row[k] * row[k]
    memory[3] += error.size


@inlined
def _grown(memory: Array) -> bool:
    """End a revolution and begin the next; return whether the error has grown often enough (``memory``: `_growing`)."""
    limit, floor, needed, state, sums = memory[0], memory[1], memory[2], memory[3:7], memory[7:]
    rms = np.sqrt(np.sum(sums) / state[0])
    before = state[1]
    state[2] = state[2] + 1.0 if rms > limit * before and rms > floor else 0.0
    state[0], state[1] = 0.0, rms
    sums[:] = 0.0
    if state[2] < needed:
        return False
    state[3] = rms / before
    return True


@kernel
def _growing(error: Array, pulse: Pulses, at: int, memory: Array) -> int:
    """Return the sample at which the RMS error has grown often enough, -1 if there is none; ``at``: the first pulse.

    ``memory``: limit, floor, revolutions required; samples of the current revolution, negative before the first index
    pulse; RMS error of the previous revolution, number of consecutive growths, last growth factor; sums of squares.
    """
    begin = 0
    while True:
        if memory[3] >= 0.0:
            _add(error[begin:at], memory)
        if at == pulse.size:
            return -1
        if memory[3] < 0.0:
            memory[3] = 0.0
        elif _grown(memory):
            return at
        begin, at = at, _next(pulse, at + 1)


class MonitorTable(NamedTuple):
    """Table of the monitors of a cell for `walk`.

    Attributes:
        plan: rule, first signal, second signal or -1, start and end of the state of each monitor, shape (rules, 5).
        memory: concatenated states of the monitors.
        raised: flags of the monitors that have raised their alarm and are now inactive, shape (rules,).
        places: sample of each monitor's finding, or -1, shape (rules,).
        values: value at that sample, shape (rules,).
    """

    plan: Integers
    memory: Array
    raised: Integers
    places: Integers
    values: Array


@kernel
def walk(watch: MonitorTable, signals: tuple[Array, ...], angle: Array, pulse: Pulses) -> int:
    """Run all monitors over a block, fill in the sample and value of each finding, and return the number of findings.

    Args:
        watch: table of the monitors, updated in place.
        signals: signals in the numbering of the plan, shape (n,) each.
        angle: angle of the encoder [rad], shape (n,).
        pulse: index pulses of the encoder, shape (n,).
    """
    plan, found, first_pulse = watch.plan, 0, _next(pulse, 0)
    for row in range(plan.shape[0]):
        rule, own, second = plan[row, 0], watch.memory[plan[row, 3] : plan[row, 4]], plan[row, 2]
        signal, place, value = signals[plan[row, 1]], -1, 0.0
        other = signals[second] if second >= 0 else signal[:0]
        if rule == THRESHOLD:
            if not watch.raised[row]:
                place = _lasting_beyond(signal, other, angle, own)
                if place >= 0:
                    value = signal[place] - (other[place] if other.size else 0.0)
                    if own[1] == -own[2]:  # for symmetric limits the value is the magnitude
                        value = abs(value - own[0])
        elif rule == RATE:
            place, value = _changing(signal, own), own[1]
        elif rule == INDEX:
            place, value = _index(signal, pulse, first_pulse, own), own[2]
        else:
            place, value = _growing(signal, pulse, first_pulse, own), own[6]
        watch.places[row], watch.values[row] = -1 if watch.raised[row] else place, value
        found += watch.places[row] >= 0
    return found
