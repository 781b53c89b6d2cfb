# SPDX-License-Identifier: Apache-2.0
"""The drives of the tool for many cells at once: arrays have a last axis more, one place a lane.

Each lane gets the bits that `electrodynamic` and `piezo` would give it alone.
"""

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel
from lathe_rc.plants.hysteresis import play

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_ROUNDING = 1e-9


@kernel
def electrodynamic(
    transition: Array,
    weights: Array,
    part: Array,
    spring: Array,
    damper: Array,
    force_per_current: Array,
    stroke: Array,
    early: Integers,
    state: Array,
    line: Array,
    stopped: Integers,
    command: Array,
    position: Array,
    velocity: Array,
    current: Array,
) -> None:
    """Step the drives through a block; signals have the shape (n, lanes), constants (..., lanes).

    ``line`` holds the commands before this block, as many as the longest delay needs, and ``early`` how much shorter
    than that each lane's delay is [sample].
    """
    sent = np.concatenate((line, command))
    lanes = command.shape[1]
    for k in range(command.shape[0]):
        for lane in range(lanes):
            at = k + early[lane]
            u0, u1, u2 = sent[at + 2, lane], sent[at + 1, lane], sent[at, lane]
            x, v = state[0, lane], state[1, lane]
            new_x = (
                transition[0, 0, lane] * x
                + transition[0, 1, lane] * v
                + weights[0, 0, lane] * u0
                + weights[0, 1, lane] * u1
                + weights[0, 2, lane] * u2
            )
            new_v = (
                transition[1, 0, lane] * x
                + transition[1, 1, lane] * v
                + weights[1, 0, lane] * u0
                + weights[1, 1, lane] * u1
                + weights[1, 2, lane] * u2
            )
            above, below = new_x > stroke[lane], new_x < -stroke[lane]
            x = stroke[lane] if above else (-stroke[lane] if below else new_x)
            v = min(new_v, 0.0) if above else (max(new_v, 0.0) if below else new_v)
            stopped[lane] += above or below
            delayed = (1.0 - part[lane]) * u0 + part[lane] * u1
            state[0, lane], state[1, lane] = x, v
            position[k, lane], velocity[k, lane] = x, v
            current[k, lane] = (spring[lane] * (delayed - x) - damper[lane] * v) * force_per_current[lane]
    line[:] = sent[command.shape[0] :]


@kernel
def _plays(table: Array, state: Array, value: Array, result: Array) -> None:
    """Plays of one sample: ``table`` is (2, m + 1, lanes), ``state`` (m, lanes), ``value`` (lanes,)."""
    lanes = value.size
    for lane in range(lanes):
        result[lane] = table[1, 0, lane] * value[lane]
    i = 0
    while i + 4 < state.shape[0]:
        for lane in range(lanes):
            u = value[lane]
            a = play(state[i, lane], table[0, i + 1, lane], u)
            b = play(state[i + 1, lane], table[0, i + 2, lane], u)
            c = play(state[i + 2, lane], table[0, i + 3, lane], u)
            d = play(state[i + 3, lane], table[0, i + 4, lane], u)
            e = play(state[i + 4, lane], table[0, i + 5, lane], u)
            state[i, lane], state[i + 1, lane], state[i + 2, lane], state[i + 3, lane] = a, b, c, d
            state[i + 4, lane] = e
            result[lane] = (
                result[lane]
                + table[1, i + 1, lane] * a
                + table[1, i + 2, lane] * b
                + table[1, i + 3, lane] * c
                + table[1, i + 4, lane] * d
                + table[1, i + 5, lane] * e
            )
        i += 5
    while i < state.shape[0]:
        for lane in range(lanes):
            state[i, lane] = play(state[i, lane], table[0, i + 1, lane], value[lane])
            result[lane] += table[1, i + 1, lane] * state[i, lane]
        i += 1


@kernel
def piezo(
    stroke: Array,
    lag: Array,
    inverse: Array,
    forward: Array,
    transition: Array,
    weights: Array,
    full_voltage: Array,
    inverse_state: Array,
    forward_state: Array,
    state: Array,
    saturated: Integers,
    set_point: Array,
    position: Array,
    velocity: Array,
    voltage: Array,
) -> None:
    """Step drives with plays and without creep through a block; signals have the shape (n, lanes).

    ``lag`` has the rows decay, now, before; ``state`` the rows amplifier, its last input, last extension, x, v.
    """
    lanes = set_point.shape[1]
    value, result = np.empty(lanes), np.empty(lanes)
    for k in range(set_point.shape[0]):
        for lane in range(lanes):
            value[lane] = min(max(set_point[k, lane] / stroke[lane], -1.0), 1.0)
        _plays(inverse, inverse_state, value, result)
        for lane in range(lanes):
            cut = set_point[k, lane] / stroke[lane] != value[lane] or abs(result[lane]) > 1.0 + _ROUNDING
            saturated[lane] += cut
            applied = min(max(result[lane], -1.0), 1.0)
            value[lane] = lag[0, lane] * state[0, lane] + lag[1, lane] * applied + lag[2, lane] * state[1, lane]
            state[0, lane], state[1, lane] = value[lane], applied
        _plays(forward, forward_state, value, result)
        for lane in range(lanes):
            extension, before = stroke[lane] * result[lane], state[2, lane]
            x, v = state[3, lane], state[4, lane]
            new_x = (
                transition[0, 0, lane] * x
                + transition[0, 1, lane] * v
                + weights[0, 0, lane] * extension
                + weights[0, 1, lane] * before
            )
            new_v = (
                transition[1, 0, lane] * x
                + transition[1, 1, lane] * v
                + weights[1, 0, lane] * extension
                + weights[1, 1, lane] * before
            )
            state[2, lane], state[3, lane], state[4, lane] = extension, new_x, new_v
            position[k, lane], velocity[k, lane] = new_x, new_v
            voltage[k, lane] = value[lane] * full_voltage[lane]
