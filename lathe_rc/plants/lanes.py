# SPDX-License-Identifier: Apache-2.0
"""The tool and its drives for many cells at once: arrays have a last axis more, one place a lane.

Each lane gets the bits that `electrodynamic`, `piezo` and `tool` would give it alone.
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
def _plays_along(table: Array, state: Array, value: Array, result: Array) -> None:
    """Plays: ``table`` is (2, m + 1, lanes), ``state`` (m, lanes), ``value`` and ``result`` (n, lanes)."""
    lanes = value.shape[1]
    for k in range(value.shape[0]):
        for lane in range(lanes):
            result[k, lane] = table[1, 0, lane] * value[k, lane]
        for i in range(state.shape[0]):
            for lane in range(lanes):
                at = play(state[i, lane], table[0, i + 1, lane], value[k, lane])
                state[i, lane] = at
                result[k, lane] += table[1, i + 1, lane] * at


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

    ``lag`` has the rows decay, now, before; ``state`` the rows amplifier, its last input, last extension, x, v. Each
    loop over the lanes uses few arrays: the compiler makes vectors of it only if it can tell them apart quickly.
    """
    samples = set_point.shape[0]
    # Row 0 holds what was before the block.
    value, result = np.empty((samples + 1, stroke.size)), np.empty((samples + 1, stroke.size))
    _clip(set_point, stroke, value[1:])
    _plays_along(inverse, inverse_state, value[1:], result[1:])
    for k in range(samples):
        for lane in range(stroke.size):
            cut = set_point[k, lane] / stroke[lane] != value[k + 1, lane] or abs(result[k + 1, lane]) > 1.0 + _ROUNDING
            saturated[lane] += cut
    value[0] = state[1]
    _clip(result[1:], np.ones(stroke.size), value[1:])
    result[0] = state[0]
    _amplify(lag, value, result)
    state[0], state[1] = result[samples], value[samples]
    _plays_along(forward, forward_state, result[1:], value[1:])
    _scale(result[1:], full_voltage, voltage)
    value[0] = state[2]
    _scale(value[1:], stroke, value[1:])
    _resonate(transition, weights, value, state[3], state[4], position, velocity)
    state[2] = value[samples]


@kernel
def _clip(signal: Array, limit: Array, within: Array) -> None:
    """A signal relative to a limit, held within it."""
    for k in range(signal.shape[0]):
        for lane in range(limit.size):
            within[k, lane] = min(max(signal[k, lane] / limit[lane], -1.0), 1.0)


@kernel
def _scale(signal: Array, by: Array, scaled: Array) -> None:
    for k in range(signal.shape[0]):
        for lane in range(by.size):
            scaled[k, lane] = by[lane] * signal[k, lane]


@kernel
def _amplify(lag: Array, applied: Array, voltage: Array) -> None:
    """The amplifier's lag; row 0 of both is what was before the block."""
    for k in range(1, voltage.shape[0]):
        for lane in range(voltage.shape[1]):
            voltage[k, lane] = (
                lag[0, lane] * voltage[k - 1, lane]
                + lag[1, lane] * applied[k, lane]
                + lag[2, lane] * applied[k - 1, lane]
            )


@kernel
def _resonate(
    transition: Array, weights: Array, extension: Array, x: Array, v: Array, position: Array, velocity: Array
) -> None:
    """The resonance; ``extension`` has a row more before the block; ``x`` and ``v`` are changed."""
    for k in range(position.shape[0]):
        for lane in range(x.size):
            position[k, lane] = transition[0, 0, lane] * x[lane] + transition[0, 1, lane] * v[lane]
        for lane in range(x.size):
            velocity[k, lane] = transition[1, 0, lane] * x[lane] + transition[1, 1, lane] * v[lane]
        for lane in range(x.size):
            now, before = extension[k + 1, lane], extension[k, lane]
            position[k, lane] = position[k, lane] + weights[0, 0, lane] * now + weights[0, 1, lane] * before
        for lane in range(x.size):
            now, before = extension[k + 1, lane], extension[k, lane]
            velocity[k, lane] = velocity[k, lane] + weights[1, 0, lane] * now + weights[1, 1, lane] * before
        for lane in range(x.size):
            x[lane] = position[k, lane]
        for lane in range(x.size):
            v[lane] = velocity[k, lane]


@kernel
def add_drive(
    begins: bool,  # noqa: FBT001 - kernels take their arguments by position
    reference: Array,
    expected: Array,
    position: Array,
    measured: Array,
    displacement: Array,
    known: Array,
    error: Array,
) -> None:
    """`tool.add_drive`; what is not a drive's own, the reference and what is expected, is of shape (n,)."""
    for k in range(reference.size):
        for lane in range(position.shape[1]):
            displacement[k, lane] = position[k, lane] if begins else displacement[k, lane] + position[k, lane]
            known[k, lane] = (expected[k] if begins else known[k, lane]) - measured[k, lane]
            error[k, lane] = reference[k] - displacement[k, lane]
