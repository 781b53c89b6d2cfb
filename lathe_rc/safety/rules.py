# SPDX-License-Identifier: Apache-2.0
"""Rules of the monitors, sample by sample, whatever the blocks.

One kernel goes through the samples for all monitors of a cell: a row of a table says which rule reads which signals and
where its memory is. A rule first asks whether there is anything in a stretch of samples, which the compiler makes
vectors of, and takes them one by one only where there is.
"""

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import inlined, kernel, lent

Array = npt.NDArray[np.float64]
Places = npt.NDArray[np.int64]
Pulses = npt.NDArray[np.uint8]

THRESHOLD, RATE, INDEX, GROWTH = range(4)  #: rules of the table
TURN = 2.0 * np.pi  #: a revolution [rad]
_STRETCH = 256  # samples


@inlined
def _beyond(value: float, offset: float, low: float, high: float) -> bool:
    """Whether a value is beyond its limits, or not a number; most limits are to both sides, which is one comparison."""
    value -= offset
    return not abs(value) <= high if low == -high else not low <= value <= high


@kernel
def _any_beyond(signal: Array, other: Array, memory: Array) -> int:
    """0 if so many samples in a row may be beyond here or from the last one on, or -1.

    The memory: offset, lower and upper limit, how many. Where n are needed, every n-th one and the last tell: n in a
    row cannot pass between them, if the sample before the first was not beyond.
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


@kernel
def lasting(signal: Array, other: Array, memory: Array, run: int) -> tuple[int, int]:
    """First sample at which enough in a row were beyond, or -1, and how many were up to it or the last."""
    for k in range(signal.size):
        value = signal[k] - (other[k] if other.size else 0.0)
        run = run + 1 if _beyond(value, memory[0], memory[1], memory[2]) else 0
        if run >= memory[3]:
            return k, run
    return -1, run


@kernel
def clear(position: Array, beyond: float, needed: int, run: int) -> tuple[int, int]:
    """First sample at which enough in a row were beyond a position, or -1, and how many were up to it or the last."""
    for k in range(position.size):
        run = run + 1 if position[k] >= beyond else 0
        if run >= needed:
            return k, run
    return -1, run


@inlined
def _differ(after: float, before: float, limit: float) -> bool:
    return not abs(after - before) <= limit


@inlined
def _how_many_differ(after: Array, before: Array, limit: float) -> int:
    count = 0
    for k in range(after.size):
        count += _differ(after[k], before[k], limit)
    return count


@kernel
def _changing(signal: Array, memory: Array) -> int:
    """First sample that differs by more than the limit from the one a window before, or -1.

    The memory: limit, by how much it differs, and the samples of a window up to now.
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
    past[kept:] = signal[size - window + kept :]
    return found


@inlined
def _next(pulse: Pulses, begin: int) -> int:
    """The first index pulse from a sample on; the end if there is none."""
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
    """Whether no angle since an index pulse can be this, to the limit."""
    return since > TURN + limit or since < -limit


@kernel
def _first_off(angle: Array, last: float, limit: float) -> int:
    """First sample that no angle since an index pulse can be, or -1."""
    count = 0
    for k in range(angle.size):
        count += _off(angle[k] - last, limit)
    for k in range(angle.size if count else 0):
        if _off(angle[k] - last, limit):
            return k
    return -1


@kernel
def _index(angle: Array, pulse: Pulses, at: int, memory: Array) -> int:
    """First sample that does not fit the pulses, the first of which is ``at``, or -1.

    The memory: limit, angle of the last pulse, what was found, whether there was a pulse: before, the first angle
    stands for one that may come early.
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


SUMS = 128  # of squares, each of every 128th error: one would wait for itself, these are vectors


@inlined
def _add(error: Array, memory: Array) -> None:
    """Add the squares of more errors of the same revolution, see `_growing`; the same whatever the blocks."""
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
    """End a revolution, see `_growing`, and begin the next; whether its error has grown once too often."""
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
    """First sample at which the RMS error has grown often enough, or -1; ``at``: the first pulse.

    The memory: limit, floor, revolutions needed; samples of the revolution, below 0 before the first index pulse; RMS
    of the one before, how many have grown, by how much; sums of squares.
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


@kernel
def located(signals: tuple[Array, ...], samples: int, plan: Places) -> None:
    """Replace the signals of a plan, see `walk`, by where they are; they must be contiguous.

    Raises:
        ValueError: one is not as long as the block.
    """
    for signal in signals:
        if signal.size != samples:
            raise ValueError("a signal that is watched is not as long as the block")
    for row in range(plan.shape[0]):
        plan[row, 1] = signals[plan[row, 1]].ctypes.data
        plan[row, 2] = signals[plan[row, 2]].ctypes.data if plan[row, 2] >= 0 else 0


@kernel
def walk(pulse: Pulses, plan: Places, memory: Array, places: Places) -> int:
    """Fill in where each rule finds something, or -1, and say how many do.

    Args:
        pulse: index pulses of the encoder, shape (n,).
        plan: rule, where its two signals are, the second or 0, begin and end of its memory; shape (rules, 5).
        memory: of all of them.
        places: that are filled in, shape (rules,).
    """
    found, first_pulse = 0, _next(pulse, 0)
    for row in range(plan.shape[0]):
        rule, own, second = plan[row, 0], memory[plan[row, 3] : plan[row, 4]], plan[row, 2]
        signal = lent(plan[row, 1], pulse.size)
        other = lent(second, pulse.size) if second else signal[:0]
        if rule == THRESHOLD:
            place = _any_beyond(signal, other, own)
        elif rule == RATE:
            place = _changing(signal, own)
        elif rule == INDEX:
            place = _index(signal, pulse, first_pulse, own)
        else:
            place = _growing(signal, pulse, first_pulse, own)
        places[row] = place
        found += place >= 0
    return found
