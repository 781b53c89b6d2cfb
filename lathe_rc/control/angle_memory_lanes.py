# SPDX-License-Identifier: Apache-2.0
"""`angle_memory` for many controllers at one spindle: arrays have a last axis more, one place a lane.

All lanes have the grid, the cycle and the angle in common; lead, gain and Q are their own. Each lane gets the bits
that it would get alone.
"""

import numpy as np
import numpy.typing as npt

from lathe_rc.control.angle_memory import CHUNK, DONE, ENDED, NEXT, PIECE, SMOOTH, find, soft
from lathe_rc.control.interpolation import cubic
from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_TURN = 2.0 * np.pi

# Rows of the real state, one column a lane: sum of squares and largest error of the cycle at hand and of the last one.
SQUARES, LARGEST, CYCLE_SQUARES, CYCLE_LARGEST = 0, 1, 2, 3


@kernel
def largest_lead(lead_time: Array, constant: Array, speed: Array) -> Array:
    """Largest lead [rad] of all lanes at each sample."""
    lead = np.empty(speed.size)
    for k in range(speed.size):
        most = lead_time[0] * speed[k] + constant[0]
        for lane in range(1, lead_time.size):
            most = max(most, lead_time[lane] * speed[k] + constant[lane])
        lead[k] = most
    return lead


@kernel
def smooth(
    base: int, cycle: int, ratio: Array, skipped: Integers, memory: Array, backward: Array, chunk: Array, both: Array
) -> None:
    """Fill ``chunk``, shape (m, lanes), with what Q makes of the cycle before; see `q_filter.two_sided`.

    ``skipped`` is how much less far than the farthest each lane's Q reaches; ``backward`` (m + 2·reach, lanes) and
    ``both`` (2, lanes) are scratch.
    """
    mask = memory.shape[0] - 1
    size, lanes = backward.shape
    reach = (size - chunk.shape[0]) // 2
    both[:] = 0.0
    for k in range(size - reach):
        left, right = (base - cycle - reach + k) & mask, (base - cycle - reach + size - 1 - k) & mask
        for lane in range(lanes):
            inside = k >= skipped[lane]
            both[0, lane] = ratio[lane] * both[0, lane] + (memory[left, lane] if inside else 0.0)
            backward[size - 1 - k, lane] = both[1, lane]
            both[1, lane] = ratio[lane] * both[1, lane] + (memory[right, lane] if inside else 0.0)
        if k >= reach:
            chunk[k - reach] = both[0]
    for k in range(chunk.shape[0]):
        for lane in range(lanes):
            gain = (1.0 - ratio[lane]) / (1.0 + ratio[lane])
            chunk[k, lane] = gain * (chunk[k, lane] + ratio[lane] * backward[k + reach, lane])


@kernel
def _learn(
    point: int,
    count: int,
    cycle: int,
    learning: npt.NDArray[np.bool_],
    gain: Array,
    ramp: Array,
    since: Integers,
    sample: Integers,
    place: Array,
    angles: Array,
    errors: Array,
    chunk: Array,
    memory: Array,
    whole: Integers,
    real: Array,
    weight: Array,
) -> None:
    """`angle_memory`'s learning for lanes, those that do not learn repeat the cycle before."""
    mask, lanes = memory.shape[0] - 1, memory.shape[1]
    soft_start, any_learns = np.any(ramp > 0.0), np.any(learning)
    end = cycle - 1 - point % cycle
    for j in range(count):
        k, g = sample[j], point + j
        u = (place[j] - angles[k + 1]) * (1.0 / (angles[k + 2] - angles[k + 1]))
        for lane in range(lanes):
            weight[lane] = gain[lane] if learning[lane] and g >= since[lane] else 0.0
        if soft_start:
            for lane in range(lanes):
                if ramp[lane] > 0.0 and weight[lane] != 0.0:
                    weight[lane] = gain[lane] * soft((g - since[lane]) / ramp[lane])
        new, old = g & mask, (g - cycle) & mask
        smoothed = max(g - whole[CHUNK], 0) if any_learns else 0
        for lane in range(lanes):
            delta = cubic(errors[k, lane], errors[k + 1, lane], errors[k + 2, lane], errors[k + 3, lane], u)
            y = chunk[smoothed, lane] if learning[lane] else memory[old, lane]
            memory[new, lane] = y + delta * weight[lane] if learning[lane] and g >= since[lane] else y
            real[SQUARES, lane] += delta * delta
            real[LARGEST, lane] = max(real[LARGEST, lane], abs(delta))
        if j == end:
            real[CYCLE_SQUARES], real[CYCLE_LARGEST] = real[SQUARES], real[LARGEST]
            real[SQUARES], real[LARGEST] = 0.0, 0.0
            end += cycle


@kernel
def learn(
    start: int,
    arrives: int,
    grid: int,
    cycle: int,
    looks_ahead: int,
    learning: npt.NDArray[np.bool_],
    gain: Array,
    ramp: Array,
    ratio: Array,
    skipped: Integers,
    since: Integers,
    angle: Array,
    lead: Array,
    angles: Array,
    errors: Array,
    sample: Integers,
    place: Array,
    chunk: Array,
    backward: Array,
    scratch: Array,
    memory: Array,
    whole: Integers,
    real: Array,
) -> tuple[int, int]:
    """`angle_memory.learn` for lanes; ``lead`` is the largest of them at each sample."""
    per_radian = grid / _TURN
    k = max(start, min(arrives, angle.size))
    reason = DONE
    any_learns = np.any(learning)
    while reason == DONE and k < angle.size:
        point = whole[NEXT]
        stop = point + PIECE
        if any_learns:
            if not 0 <= point - whole[CHUNK] < chunk.shape[0]:
                whole[CHUNK] = point // chunk.shape[0] * chunk.shape[0]
                smooth(whole[CHUNK], cycle, ratio, skipped, memory, backward, chunk, scratch[:2])
            stop = min(stop, whole[CHUNK] + chunk.shape[0])
        k, count, reason, whole[ENDED] = find(
            k, point, stop, cycle, per_radian, looks_ahead, whole[ENDED], angles, angle, lead, sample, place
        )
        _learn(
            point, count, cycle, learning, gain, ramp, since, sample, place, angles, errors, chunk, memory, whole,
            real, scratch[2],
        )  # fmt: skip
        whole[NEXT] += count
        if reason == SMOOTH:
            reason = DONE
    return k, reason


@kernel
def send(
    start: int,
    stop: int,
    grid: int,
    cycle: int,
    lead_time: Array,
    constant: Array,
    memory: Array,
    angle: Array,
    speed: Array,
    told: Array,
) -> None:
    """Fill the set points ``told``, shape (n, lanes), of some samples of the block: the memory alone."""
    per_radian = grid / _TURN
    mask, lanes = memory.shape[0] - 1, memory.shape[1]
    for k in range(start, stop):
        for lane in range(lanes):
            at = (angle[k] + (lead_time[lane] * speed[k] + constant[lane])) * per_radian - cycle
            left = np.floor(at)
            i = int(left)
            told[k, lane] = cubic(
                memory[(i - 1) & mask, lane],
                memory[i & mask, lane],
                memory[(i + 1) & mask, lane],
                memory[(i + 2) & mask, lane],
                at - left,
            )
