# SPDX-License-Identifier: Apache-2.0
"""Kernels for the memory of repetitive control: learning at the grid points and reading between them.

Samples arrive in blocks, and grid points may lie anywhere between samples. A block is therefore processed in passes:
points are assigned to samples (`find`), points are learned (`_learn_piece`), and the drive's set points are computed
(`_send`). The passes perform the same operations in the same order as a sample-by-sample loop, but most of them are
vectorised in groups of eight.
"""

from typing import NamedTuple

import numpy as np

from lathe_machine.control.correction import invariant
from lathe_machine.control.interpolation import cubic, read, read_along, read_derivatives
from lathe_machine.control.q_filter import two_sided
from lathe_rc.arrays import Array, Integers, put
from lathe_rc.jit import inlined, kernel

_TURN = 2.0 * np.pi
PIECE = 512  #: number of grid points learned at a time

# Indices in the integer state: next grid point to learn, whether any sample has arrived, first point of the smoothed
# chunk, grid point from which errors are learned, whether a cycle ended in the current sample, whether the memory was
# replaced since the last sample, whether learning is on, whether the channel has joined, number of cycles in the log,
# whether to stop after each cycle.
NEXT, SEEN, CHUNK, FROM, ENDED, REPLACED, LEARNS, JOINED, LOGGED, ASKS = range(10)
INTEGERS = 10
# Indices in the real state: sum of squares and largest error of the current cycle and of the previous one, the last
# three angles and errors, v and v' of Wk2, last read position and value, state of the lead-lag term.
SQUARES, LARGEST, CYCLE_SQUARES, CYCLE_LARGEST, ANGLES, ERRORS, INVARIANT, PLACE, INPUT, LAG = (
    0, 1, 2, 3, 4, 7, 10, 12, 13, 14,
)  # fmt: skip
REALS = 15
NO_CHUNK = -(1 << 62)  # lower than the index of any grid point

DONE, CYCLE_ENDED, AHEAD, JUMPED, SMOOTH, BEHIND = 0, 1, 2, 3, 4, 5  #: reasons for `advance` to return
LOG = 64  #: largest number of completed cycles in the log

BACK = 8  #: number of grid points by which a jittering angle may step back behind the cycle being read
AROUND = 8  #: number of grid points stored in addition to these and a cycle, for the points around a read position


@inlined
def soft(u: float) -> float:
    """Compute a smooth step from 0 at ``u`` = 0 to 1 at ``u`` = 1."""
    return 1.0 if u >= 1.0 else u * u * (3.0 - 2.0 * u)


class AngleMemory(NamedTuple):
    """Memory and law of repetitive control, for kernels.

    Attributes:
        delay: number of samples until a measured error is available.
        grid: memory points per revolution.
        cycle: memory points per cycle.
        gain: learning gain.
        ramp: grid points over which the gain rises.
        join_below: largest error of a cycle at which the channel joins [m].
        ratio, reach: parameters of an exponential Q; if ``ratio`` is negative, chunks are smoothed outside the kernel.
        law, looks_ahead: correction law, and number of grid points that it reads ahead.
        back: number of grid points by which a read may stay behind the cycle being read.
        oldest: lead of the oldest read, relative to the lead.
        settings: parameters of the correction.
        taps: filter of the correction FIR.
        memory: learned points [m], weighted over the cycles if there are several weights; their number is a power of
            two.
        weights: weights of the newest learned cycles.
        history: learned points of as many cycles [m]; unused with a single weight.
        chunk: points of the previous cycle, smoothed by Q.
        scratch: scratch array for smoothing.
        windows: angles and errors of a block, preceded by the last three before it, shape (2, n + 3) or more.
        ahead: lead, and first and second time derivatives of the read angle, for each sample of a block, shape (3, n)
            or more.
        sample, work: scratch arrays for the points learned at a time.
        whole, real: integer and real state, indexed by the module's constants.
        log: last sample, sum of squares, largest error, learning flag and joined flag of each cycle, shape (LOG, 5).
    """

    delay: int
    grid: int
    cycle: int
    gain: float
    ramp: float
    join_below: float
    ratio: float
    reach: int
    law: int
    looks_ahead: int
    back: int
    oldest: float
    settings: Array
    taps: Array
    memory: Array
    weights: Array
    history: Array
    chunk: Array
    scratch: Array
    windows: Array
    ahead: Array
    sample: Integers
    work: Array
    whole: Integers
    real: Array
    log: Array


@inlined
def begin(m: AngleMemory, first: int, angle: Array, past_angle: Array, error: Array) -> None:
    """Begin a block: store its angles and errors after the last three of the previous block, shape (n + 3,).

    Errors are available from sample ``delay`` on; before it the stored angle is constant, so nothing is learned.
    """
    n, per_radian, delay = error.size, m.grid / _TURN, m.delay
    whole, real, angles, errors = m.whole, m.real, m.windows[0, : error.size + 3], m.windows[1, : error.size + 3]
    if whole[REPLACED] and n:
        # Errors that are still delayed belong to the replaced memory.
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
    put(real[ANGLES : ANGLES + 3], angles[n:])
    put(real[ERRORS : ERRORS + 3], errors[n:])


@kernel
def find(
    m: AngleMemory, start: int, point: int, stop: int, angles: Array, angle: Array, lead: Array
) -> tuple[int, int, int, int]:
    """Assign the grid points from ``point`` up to ``stop`` to the samples whose angle intervals contain them.

    The search stops after the sample in which a cycle ends.

    Returns:
        The sample reached, the number of points assigned, the reason for stopping (`SMOOTH`: at the last point), and
        whether a cycle ended in the current sample.
    """
    cycle, per_radian, looks_ahead, ended = m.cycle, m.grid / _TURN, m.looks_ahead, m.whole[ENDED]
    sample, place = m.sample, m.work[6]
    for j in range(stop - point):
        place[j] = (point + j) / per_radian
    place[stop - point] = np.inf  # sentinel, so that the search below need not test the count
    count = 0
    to_end = cycle - point % cycle
    for k in range(start, angle.size):
        before, now = angles[k + 1], angles[k + 2]
        # A step of more than half a revolution means a wrong angle, from which nothing could be learned.
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
        # Points to be read must already be learned, and not yet be overwritten by the next cycle.
        if np.floor((angle[k] + lead[k]) * per_radian - cycle) + looks_ahead >= point + count:
            return k, count, AHEAD, ended
        if np.floor((angle[k] + m.oldest * lead[k]) * per_radian) + m.back < point + count:
            return k, count, BEHIND, ended
        if ended:
            return k + 1, count, CYCLE_ENDED, 0
    return angle.size, count, DONE, ended


@inlined
def _weigh(m: AngleMemory, point: int, count: int) -> None:
    """Replace learned points by their weighted mean over the newest cycles, of which there are fewer at first."""
    history, mask = m.history, m.memory.size - 1
    for place in range(point, point + count):
        history[place % history.size] = m.memory[place & mask]
        total, sum_of_weights = 0.0, 0.0
        for k in range(min(m.weights.size, max(place - m.whole[FROM], 0) // m.cycle + 1)):
            total += m.weights[k] * history[(place - k * m.cycle) % history.size]
            sum_of_weights += m.weights[k]
        m.memory[place & mask] = total / sum_of_weights


@kernel
def _learn_piece(m: AngleMemory, point: int, count: int, learning: int, angles: Array, errors: Array) -> None:
    """Learn ``count`` grid points starting at ``point``, each from an error interpolated between four samples."""
    cycle, gain, ramp, sample, place, work = m.cycle, m.gain, m.ramp, m.sample, m.work[6], m.work
    chunk, memory, whole, real = m.chunk, m.memory, m.whole, m.real
    mask = memory.size - 1
    # Gathered first, so that the compiler can vectorise the loop after it.
    for j in range(count):
        k = sample[j]
        work[0, j], work[1, j] = angles[k + 1], angles[k + 2]
        work[2, j], work[3, j], work[4, j], work[5, j] = errors[k], errors[k + 1], errors[k + 2], errors[k + 3]
    delta = place  # reuses the array: the position of a point is not needed once its error is known
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
        if m.weights.size > 1:
            _weigh(m, point, count)
    else:
        for j in range(count):
            memory[(point + j) & mask] = memory[(point + j - cycle) & mask]
            if m.weights.size > 1:
                m.history[(point + j) % m.history.size] = memory[(point + j) & mask]
    # Summed one by one: the order must not depend on the division of the points into chunks.
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
    """Fill ``chunk``, starting at grid point ``base``, with the previous cycle smoothed by an exponential Q."""
    mask = memory.size - 1
    for k in range(scratch.shape[1]):
        scratch[0, k] = memory[(base - cycle - reach + k) & mask]
    two_sided(ratio, reach, scratch[0], scratch[1], chunk)


@inlined
def _learn(
    m: AngleMemory,
    start: int,
    arrives: int,
    learning: int,
    angle: Array,
    lead: Array,
    angles: Array,
    errors: Array,
) -> tuple[int, int]:
    """Learn from sample ``start`` of the block on, until the caller must act.

    Returns:
        The sample of the block reached, and the reason as for `_step`.
    """
    cycle, memory, chunk, whole = m.cycle, m.memory, m.chunk, m.whole
    k = max(start, min(arrives, angle.size))
    reason = DONE
    last = whole[NEXT] + memory.size - cycle - m.back - AROUND  # limit: no point still to be read is overwritten
    while reason == DONE and k < angle.size and whole[NEXT] < last:
        point = whole[NEXT]
        stop = min(point + PIECE, last)
        if learning:
            if not 0 <= point - whole[CHUNK] < chunk.size:
                if m.ratio < 0.0:
                    return k, SMOOTH
                whole[CHUNK] = point // chunk.size * chunk.size
                _smooth(whole[CHUNK], cycle, m.reach, m.ratio, memory, m.scratch, chunk)
            stop = min(stop, whole[CHUNK] + chunk.size)
        k, count, reason, whole[ENDED] = find(m, k, point, stop, angles, angle, lead)
        _learn_piece(m, point, count, learning, angles, errors)
        whole[NEXT] += count
        if reason == SMOOTH:
            reason = DONE
    return k, reason


@kernel
def _command(m: AngleMemory, place: float, rate: float, bend: float) -> float:
    """Compute the set point of the drive from the memory at ``place`` [grid points]."""
    law, per_radian, settings, memory, real = m.law, m.grid / _TURN, m.settings, m.memory, m.real
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


@inlined
def _send(m: AngleMemory, start: int, stop: int, angle: Array, told: Array) -> None:
    """Fill ``told`` with the set points of the drive for samples ``start`` to ``stop`` of the block.

    The memory may be a block ahead of these samples, since it stores more than the cycle that they read.
    """
    per_radian, lead, rate, bend = m.grid / _TURN, m.ahead[0], m.ahead[1], m.ahead[2]
    if m.law == 0:
        read_along(m.memory, per_radian, m.cycle, angle[start:stop], lead[start:stop], m.work, told[start:stop])
        return
    if m.law == 5:
        for k in range(start, stop):
            told[k] = 0.0
            for j in range(m.taps.size):
                place = (angle[k] + (1.0 - j * m.settings[0]) * lead[k]) * per_radian - m.cycle
                i = int(np.floor(place))
                told[k] += m.taps[j] * read(m.memory, i, place - i)
        return
    for k in range(start, stop):
        place = (angle[k] + lead[k]) * per_radian - m.cycle
        told[k] = _command(m, place, rate[k], bend[k])


@inlined
def _step(m: AngleMemory, first: int, start: int, angle: Array, told: Array) -> tuple[int, int]:
    """Advance from sample ``start`` of a block, which begins at sample ``first`` of the run, until the caller must act.

    Returns:
        The sample reached, and the reason: `CYCLE_ENDED` after the last sample of a cycle, `SMOOTH` if the next
        smoothed chunk is needed, an error (`AHEAD`, `BEHIND`, `JUMPED`), or `DONE` at the end of the block or where
        further learning would overwrite points still to be read.
    """
    n, delay = angle.size, m.delay
    # Reads before the arrival of the first error are not checked, so no points are learned ahead of them.
    stop = n if start >= delay - first else min(n, delay - first)
    reached, reason = _learn(
        m, start, delay - first, m.whole[LEARNS] * m.whole[JOINED], angle[:stop], m.ahead[0, :n],
        m.windows[0, : n + 3], m.windows[1, : n + 3],
    )  # fmt: skip
    _send(m, start, reached, angle, told)
    return reached, reason


@inlined
def _end_cycle(m: AngleMemory, sample: int) -> None:
    """Log a completed cycle, and let the channel join if the error is small enough."""
    whole, real = m.whole, m.real
    whole[LOGGED] %= LOG  # full where the host does not read it
    row = m.log[whole[LOGGED]]
    row[0], row[1], row[2] = sample, real[CYCLE_SQUARES], real[CYCLE_LARGEST]
    row[3] = whole[LEARNS] * whole[JOINED]
    if whole[LEARNS] and not whole[JOINED] and real[CYCLE_LARGEST] <= m.join_below:
        whole[JOINED] = 1
        whole[FROM] = whole[NEXT]
    row[4] = whole[JOINED]
    whole[LOGGED] += 1


@kernel
def leave(m: AngleMemory) -> None:
    """Undo that the channel has joined, if it waits for a small error before it learns."""
    if m.join_below < np.inf:
        m.whole[JOINED] = 0


@kernel
def advance(m: AngleMemory, first: int, start: int, angle: Array, told: Array) -> tuple[int, int]:
    """Advance from sample ``start`` of a block to its end (`DONE`), or until the caller must act.

    Args:
        m: memory, after `begin` and with the lead of the block filled in.
        first: index of the block's first sample.
        start: sample of the block to start at.
        angle: measured spindle angle [rad], shape (n,).
        told: output, the set point of the drive [m], shape (n,).

    Returns:
        The sample of the block reached, and the reason: `DONE`, `CYCLE_ENDED`, `SMOOTH`, `AHEAD`, `BEHIND` or `JUMPED`.
    """
    reached, reason = start, DONE
    while True:
        reached, reason = _step(m, first, reached, angle, told)
        if reason == CYCLE_ENDED:
            _end_cycle(m, first + reached - 1)
            if m.whole[ASKS] or m.whole[LOGGED] == LOG:
                return reached, reason
        elif reason != DONE or reached == angle.size:
            return reached, reason
