# SPDX-License-Identifier: Apache-2.0
"""Stepping the memory of repetitive control: what is learned at the grid points, what is read between them.

Samples come as blocks, grid points as they fall between samples. So a block is taken in passes: which points fall
between which samples (`find`), what they learn (`_learn_piece`), and what the drive is told (`_send`). The passes do
the same operations in the same order as one sample after the other would, and most of them for eight at a time.
"""

import numpy as np
import numpy.typing as npt

from lathe_rc.control.correction import invariant
from lathe_rc.control.interpolation import cubic, read, read_along, read_derivatives
from lathe_rc.control.q_filter import two_sided
from lathe_rc.jit import inlined, kernel

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_TURN = 2.0 * np.pi
PIECE = 512  #: grid points that are learned at a time

# Places in the integer state: next grid point to learn, samples seen, first point of the smoothed chunk, grid point
# from which errors count, whether a cycle ended in the sample at hand, whether the memory was replaced since the last
# sample.
NEXT, SEEN, CHUNK, FROM, ENDED, REPLACED = 0, 1, 2, 3, 4, 5
INTEGERS = 6
# Places in the real state: sum of squares and largest error of the cycle at hand and of the last one, the newest
# three angles and errors, v and v' of Wk2, its last place and input, the lead-lag term's state and last input.
SQUARES, LARGEST, CYCLE_SQUARES, CYCLE_LARGEST, ANGLES, ERRORS, INVARIANT, PLACE, INPUT, LAG = (
    0, 1, 2, 3, 4, 7, 10, 12, 13, 14,
)  # fmt: skip
REALS = 15
NO_CHUNK = -(1 << 62)

DONE, CYCLE_ENDED, AHEAD, JUMPED, SMOOTH, BEHIND = 0, 1, 2, 3, 4, 5  #: why `step` stopped

_BACK = 8  # grid points by which an angle that trembles may be behind the cycle that is still being read
ROOM = _BACK + 8  #: grid points that a memory keeps beside a cycle, for what is read around a place


@inlined
def soft(u: float) -> float:
    """Rises smoothly from 0 at ``u`` = 0 to 1 at ``u`` = 1."""
    return 1.0 if u >= 1.0 else u * u * (3.0 - 2.0 * u)


@kernel
def _take(
    first: int,
    delay: int,
    per_radian: float,
    angle: Array,
    past_angle: Array,
    error: Array,
    whole: Integers,
    real: Array,
    angles: Array,
    errors: Array,
) -> None:
    """Begin a block: set the errors that arrive in it behind the newest three before it, shape (n + 3,).

    Errors are there from sample ``delay`` on; before it, and at it, the angle stands still, so that nothing is learned.
    """
    n = error.size
    if whole[REPLACED] and n:
        # Errors that are still on their way belong to the memory that was replaced.
        whole[REPLACED] = 0
        whole[FROM] = int(np.ceil(angle[0] * per_radian))
    start = min(max(delay - first, 0), n)
    if start == n:
        return
    if whole[SEEN] == 0:
        real[ANGLES : ANGLES + 3] = past_angle[start]
        real[ERRORS : ERRORS + 3] = error[start]
        whole[NEXT] = int(np.ceil(past_angle[start] * per_radian))
        whole[FROM] = max(whole[FROM], whole[NEXT])
        whole[SEEN] = 1
    angles[: start + 3] = real[ANGLES + 2]
    errors[: start + 3] = real[ERRORS + 2]
    for i in range(3):
        angles[start + i], errors[start + i] = real[ANGLES + i], real[ERRORS + i]
    for k in range(start, n):
        angles[k + 3], errors[k + 3] = past_angle[k], error[k]
    real[ANGLES : ANGLES + 3] = angles[n:]
    real[ERRORS : ERRORS + 3] = errors[n:]


@kernel
def find(
    start: int,
    point: int,
    stop: int,
    cycle: int,
    per_radian: float,
    looks_ahead: int,
    ended: int,
    angles: Array,
    angle: Array,
    lead: Array,
    sample: Integers,
    place: Array,
) -> tuple[int, int, int, int]:
    """Assign the grid points from ``point`` up to ``stop`` to the samples in whose interval of angle they lie.

    Stops after the sample in which a cycle ends. Returns the sample that is reached, the number of points, why it
    stopped (`SMOOTH`: at the last point), and whether a cycle ended in the sample at hand.
    """
    for j in range(stop - point):
        place[j] = (point + j) / per_radian
    place[stop - point] = np.inf
    count = 0
    to_end = cycle - point % cycle
    for k in range(start, angle.size):
        before, now = angles[k + 1], angles[k + 2]
        if abs(angles[k + 3] - now) > np.pi:
            return k, count, JUMPED, ended
        if now > before:
            while place[count] <= now:
                sample[count] = k
                count += 1
                if count == to_end:
                    ended = 1
        if point + count == stop:
            return k, count, SMOOTH, ended
        if np.floor((angle[k] + lead[k]) * per_radian - cycle) + looks_ahead >= point + count:
            return k, count, AHEAD, ended
        if np.floor((angle[k] + lead[k]) * per_radian) + _BACK < point + count:
            return k, count, BEHIND, ended
        if ended:
            return k + 1, count, CYCLE_ENDED, 0
    return angle.size, count, DONE, ended


@kernel
def _learn_piece(
    point: int,
    count: int,
    cycle: int,
    learning: int,
    gain: float,
    ramp: float,
    sample: Integers,
    place: Array,
    angles: Array,
    errors: Array,
    work: Array,
    chunk: Array,
    memory: Array,
    whole: Integers,
    real: Array,
) -> None:
    """Learn ``count`` grid points from ``point`` on, each from the middle of four errors."""
    mask = memory.size - 1
    for j in range(count):
        k = sample[j]
        work[0, j], work[1, j] = angles[k + 1], angles[k + 2]
        work[2, j], work[3, j], work[4, j], work[5, j] = errors[k], errors[k + 1], errors[k + 2], errors[k + 3]
    delta = place  # the place of a point is not needed after its error is known
    for j in range(count):
        u = (place[j] - work[0, j]) * (1.0 / (work[1, j] - work[0, j]))
        delta[j] = cubic(work[2, j], work[3, j], work[4, j], work[5, j], u)
    if learning:
        smoothed = chunk[point - whole[CHUNK] :]
        for j in range(count):
            y = smoothed[j]
            if point + j >= whole[FROM]:
                y += delta[j] * (gain if ramp == 0.0 else gain * soft((point + j - whole[FROM]) / ramp))
            memory[(point + j) & mask] = y
    else:
        for j in range(count):
            memory[(point + j) & mask] = memory[(point + j - cycle) & mask]
    squares, largest = real[SQUARES], real[LARGEST]
    end = cycle - 1 - point % cycle
    for j in range(count):
        squares += delta[j] * delta[j]
        largest = max(largest, abs(delta[j]))
        if j == end:
            real[CYCLE_SQUARES], real[CYCLE_LARGEST] = squares, largest
            squares = largest = 0.0
            end += cycle
    real[SQUARES], real[LARGEST] = squares, largest


@kernel
def _smooth(base: int, cycle: int, reach: int, ratio: float, memory: Array, scratch: Array, chunk: Array) -> None:
    """Fill ``chunk``, the grid points ``base`` on, with what Q makes of the cycle before; see `Exponential`."""
    mask = memory.size - 1
    for k in range(scratch.shape[1]):
        scratch[0, k] = memory[(base - cycle - reach + k) & mask]
    two_sided(ratio, reach, scratch[0], scratch[1], chunk)


@kernel
def _learn(
    start: int,
    arrives: int,
    grid: int,
    cycle: int,
    looks_ahead: int,
    learning: int,
    gain: float,
    ramp: float,
    ratio: float,
    reach: int,
    angle: Array,
    lead: Array,
    angles: Array,
    errors: Array,
    sample: Integers,
    work: Array,
    chunk: Array,
    scratch: Array,
    memory: Array,
    whole: Integers,
    real: Array,
) -> tuple[int, int]:
    """Learn from sample ``start`` of the block until something has to be done outside; see `step`."""
    per_radian = grid / _TURN
    k = max(start, min(arrives, angle.size))
    reason = DONE
    last = whole[NEXT] + memory.size - cycle - ROOM
    while reason == DONE and k < angle.size and whole[NEXT] < last:
        point = whole[NEXT]
        stop = min(point + PIECE, last)
        if learning:
            if not 0 <= point - whole[CHUNK] < chunk.size:
                if ratio < 0.0:
                    return k, SMOOTH
                whole[CHUNK] = point // chunk.size * chunk.size
                _smooth(whole[CHUNK], cycle, reach, ratio, memory, scratch, chunk)
            stop = min(stop, whole[CHUNK] + chunk.size)
        k, count, reason, whole[ENDED] = find(
            k, point, stop, cycle, per_radian, looks_ahead, whole[ENDED], angles, angle, lead, sample, work[6]
        )
        _learn_piece(
            point, count, cycle, learning, gain, ramp, sample, work[6], angles, errors, work, chunk, memory, whole, real
        )
        whole[NEXT] += count
        if reason == SMOOTH:
            reason = DONE
    return k, reason


@kernel
def _command(
    law: int,
    per_radian: float,
    place: float,
    rate: float,
    bend: float,
    settings: Array,
    memory: Array,
    real: Array,
) -> float:
    """Set point of the drive for the memory at ``place`` [grid point]."""
    i = int(np.floor(place))
    u = place - i
    a1, a2 = settings[0], settings[1]
    if law in (2, 3):
        value, first, second = read_derivatives(memory, i, u)
        slope, bow = first * per_radian, second * per_radian**2
        turning = bend if law == 3 else 0.0
        return value + float(a1 * rate * slope + a2 * (rate**2 * bow + turning * slope))
    value = read(memory, i, u)
    before = real[INPUT]
    real[INPUT] = value
    if law == 1:
        # y = v + (T1 - T2)·dv/dt with T2·dv/dt + v = u, exact for u linear between samples.
        lag = float(settings[3] * real[LAG] + settings[4] * before + settings[5] * value)
        real[LAG] = lag
        return lag + float(settings[6]) * (value - lag)
    distance = 0.0 if np.isnan(real[PLACE]) else (place - real[PLACE]) / per_radian
    real[PLACE] = place
    return invariant(value, before, distance, rate, bend, a1, a2, settings[2], real[INVARIANT : INVARIANT + 2])


@kernel
def _send(
    start: int,
    stop: int,
    law: int,
    grid: int,
    cycle: int,
    settings: Array,
    memory: Array,
    real: Array,
    angle: Array,
    lead: Array,
    rate: Array,
    bend: Array,
    work: Array,
    told: Array,
) -> None:
    """Fill the set points of the drive ``told`` of some samples of the block.

    The memory may be ahead of them by a block: it holds more than the cycle that they read.
    """
    per_radian = grid / _TURN
    if law == 0:
        read_along(memory, per_radian, cycle, angle[start:stop], lead[start:stop], work, told[start:stop])
        return
    for k in range(start, stop):
        place = (angle[k] + lead[k]) * per_radian - cycle
        told[k] = _command(law, per_radian, place, rate[k], bend[k], settings, memory, real)


@kernel
def step(
    first: int,
    start: int,
    begins: bool,  # noqa: FBT001 - kernels take their arguments by position
    delay: int,
    grid: int,
    cycle: int,
    looks_ahead: int,
    learning: bool,  # noqa: FBT001
    gain: float,
    ramp: float,
    ratio: float,
    reach: int,
    law: int,
    settings: Array,
    angle: Array,
    lead: Array,
    rate: Array,
    bend: Array,
    past_angle: Array,
    error: Array,
    windows: Array,
    sample: Integers,
    work: Array,
    chunk: Array,
    scratch: Array,
    memory: Array,
    whole: Integers,
    real: Array,
    told: Array,
) -> tuple[int, int]:
    """Step from sample ``start`` of a block, whose first one is sample ``first`` of the run, until it needs help.

    Returns the sample that is reached and why: `CYCLE_ENDED` after the sample in which one ended, `SMOOTH` where the
    next chunk of the smoothed cycle is wanted, the errors, and `DONE` at the end of the block or where learning further
    ahead of what is read would write over it. The block ``begins`` in the first call for it.
    """
    angles, errors = windows[0, : angle.size + 3], windows[1, : angle.size + 3]
    if begins:
        _take(first, delay, grid / _TURN, angle, past_angle, error, whole, real, angles, errors)
    # What is read before the first error arrives is not checked, so nothing is learned ahead of it.
    stop = angle.size if start >= delay - first else min(angle.size, delay - first)
    reached, reason = _learn(
        start, delay - first, grid, cycle, looks_ahead, learning, gain, ramp, ratio, reach, angle[:stop], lead, angles,
        errors, sample, work, chunk, scratch, memory, whole, real,
    )  # fmt: skip
    _send(start, reached, law, grid, cycle, settings, memory, real, angle, lead, rate, bend, work, told)
    return reached, reason
