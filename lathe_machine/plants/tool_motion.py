# SPDX-License-Identifier: Apache-2.0
"""Kernels of the motion of tool drives, sample by sample, in air or together with the chip that they cut.

The equations are those of `lathe_machine.plants.tool_drive`.
"""

from typing import NamedTuple

import numpy as np

from lathe_machine.plants.chip import (
    DONE,
    DRAWN_IN,
    WEAR,
    CutTable,
    chip_of,
    held,
    leave,
    meet,
    press,
)
from lathe_machine.plants.chip import STOPS as CUT_STOPS
from lathe_machine.plants.chip import failure as failure_of_cut
from lathe_machine.plants.coil import CoilTable, applied
from lathe_machine.plants.drift import DriftTable, due, gained, move
from lathe_machine.plants.electrodynamic import between_stops
from lathe_machine.plants.piezo import VOLTAGE, StackTable, extend
from lathe_rc.arrays import Array, put
from lathe_rc.compiled.struct_view import sized
from lathe_rc.errors import LatheError
from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.noise import quantise

_ROUNDS = 32  # maximum iterations for the carriage's position and the extension of the same sample
_TURN = 2.0 * np.pi
_TORN_OFF = DRAWN_IN + 1  # reason why the kernel stopped, in addition to those of the cut
STOPS = {**CUT_STOPS, _TORN_OFF: "torn off: the acceleration exceeds the preload of the stack"}  #: in words


@sized
class Weights(NamedTuple):
    """Weights of state, command, extension and force in the motion of a sample.

    Attributes:
        transition: transition matrix of positions, velocities and, with a current loop, the current, shape (m, m).
        coarse: weights of the command, or of the voltage, shape (m, 3).
        fine, load: weights of the extension e and of the radial force, shape (m, 3).
    """

    transition: Array
    coarse: Array
    fine: Array
    load: Array


class MotionTable(NamedTuple):
    """Tool drives with their state, for kernels (see `lathe_machine.plants.tool_drive.ToolDrive`).

    Attributes:
        series: whether a piezo rides on the carriage.
        weights: see `Weights`.
        tool: index of the tool's position in the state.
        base: index of the carriage's position where the tool or the piezo sits; its sensor is at index 0.
        delay, part: delay of the command: whole samples and fraction [sample].
        gain: static gain of the position loop, included in the weights of the command.
        spring, damper, force_per_current: constants of the position loop.
        carriage_stroke: [m].
        stack, memory, full_voltage: constants, state and full voltage of the piezo.
        feedback: whether the carriage's measured position is subtracted from the set point of the piezo.
        resolution: of the carriage's position sensor [m].
        stiff, loss: ω2², 2ζ2ω2.
        tension: q at which the stack exceeds its preload [m/s²]; inf for no limit.
        radial: ρ.
        coil: current loop.
        state: shape (m,).
        before: e [m] and radial force [N] of the last sample.
        reading: reading of the carriage's sensor in the last sample [m], shape (1,).
        line: ring of past commands: sample n is at index n modulo its length.
        drift: drift of gain and modes.
    """

    series: bool
    weights: Weights
    tool: int
    base: int
    delay: int
    part: float
    gain: float
    spring: float
    damper: float
    force_per_current: float
    carriage_stroke: float
    stack: StackTable
    memory: Array
    full_voltage: float
    feedback: bool
    resolution: float
    stiff: float
    loss: float
    tension: float
    radial: float
    coil: CoilTable
    state: Array
    before: Array
    reading: Array
    line: Array
    drift: DriftTable


@inlined
def _move(drive: MotionTable, n: int) -> None:
    """Change the matrices of sample ``n`` as the modes drift."""
    weights, order = drive.weights, drive.state.size
    move(drive.drift, n, 0, weights.transition)
    move(drive.drift, n, order, weights.coarse)
    move(drive.drift, n, order + 3, weights.fine)
    move(drive.drift, n, order + 6, weights.load)


@inlined
def _begin(drive: MotionTable, n: int, command: float, free: Array) -> float:
    """Fill the motion of sample ``n`` without extension and force; return the delayed command [m]."""
    line, weights, state = drive.line, drive.weights, drive.state
    transition, coarse, fine, load = weights.transition, weights.coarse, weights.fine, weights.load
    size, delay, part = line.size, drive.delay, drive.part
    line[n % size] = gained(drive.drift, n, command)
    u0, u1, u2 = line[(n - delay) % size], line[(n - delay - 1) % size], line[(n - delay - 2) % size]
    d0, d1, d2 = u0, u1, u2
    if drive.coil.on:
        wanted = (1.0 - part) * u1 + part * u2
        asked = (drive.spring * (drive.gain * wanted - state[0]) - drive.damper * state[1]) * drive.force_per_current
        # The voltage is held through the step: its whole effect is that of one weight.
        d0, d1, d2 = applied(drive.coil, n, asked, state[state.size - 1]), 0.0, 0.0
    order = transition.shape[0]  # known to the compiler, unlike the size of `free`
    for i in range(order):
        # In the order of operations of drives without force, for bit-identical results.
        free[i] = 0.0
        if drive.series:
            free[i] = coarse[i, 0] * d0 + coarse[i, 1] * d1 + coarse[i, 2] * d2 + fine[i, 1] * drive.before[0]
        for j in range(order):
            free[i] += transition[i, j] * state[j]
        if not drive.series:
            free[i] = free[i] + coarse[i, 0] * d0 + coarse[i, 1] * d1 + coarse[i, 2] * d2
        free[i] += load[i, 1] * drive.before[1]
    return float((1.0 - part) * u0 + part * u1)


@inlined
def _off(noise: Array, jitter: Array, k: int, free: Array) -> float:
    """Return noise and jitter of the carriage's sensor as one error of its reading [m]."""
    # The velocity without extension and force of this sample, which change it by less than 1e-3 of itself.
    return float(noise[k] + jitter[k] * free[1]) if jitter.size > 0 else float(noise[k])


@inlined
def _carriage(drive: MotionTable, free: Array, e: float, pushes: float) -> float:
    """Return the position of the carriage [m] for an extension and a radial force, limited by its end stops."""
    stroke = drive.carriage_stroke
    return float(min(max(free[0] + drive.weights.fine[0, 0] * e + drive.weights.load[0, 0] * pushes, -stroke), stroke))


@inlined
def _chip(
    drive: MotionTable, cut: CutTable, free: Array, e: float, here: tuple[float, ...], stiffness: float, c: float
) -> float:
    """Return the depth of cut [m] for an extension (see `chip_of`).

    ``here``: place, angle, cross position, met form, allowance.
    """
    place, angle, cross_position, met, allowance = here
    kept, tool = drive.radial * held(cut), drive.tool
    displacement = free[tool] + drive.weights.fine[tool, 0] * e + drive.weights.load[tool, 0] * kept
    if drive.series:  # in the rounding of the sum of two states
        x1 = _carriage(drive, free, e, kept)
        displacement = x1 + (displacement - x1)
    give = drive.radial * drive.weights.load[tool, 0]
    chip = chip_of(cut, place, angle, cross_position, displacement - met, allowance, stiffness, c, give, 0.0)
    if not drive.series and tool == 0:  # an edge apart from the sensor moves on while the stop holds the sensor
        x1 = free[0] + drive.weights.load[0, 0] * (
            kept + drive.radial * cut.process.lag_now * stiffness * max(chip, 0.0)
        )
        if abs(x1) > drive.carriage_stroke:  # an end stop holds the carriage, without compliance
            x1 = drive.carriage_stroke if x1 > 0.0 else -drive.carriage_stroke
            chip = chip_of(cut, place, angle, cross_position, x1 - met, allowance, stiffness, c, 0.0, 0.0)
    return chip


@inlined
def _solve(
    drive: MotionTable,
    cut: CutTable | None,
    free: Array,
    trial: Array,
    set_point: float,
    noise: float,
    here: tuple[float, ...],
    stiffness: float,
    c: float,
) -> tuple[float, float]:
    """Solve for the extension [m] and the depth of cut [m] of a sample; in air the depth is 0.

    With feedback the solution is iterated, since the extension depends on the carriage's position of the same sample
    and moves the carriage by a thousandth of itself.
    """
    memory, e, chip = drive.memory, 0.0, 0.0
    if not drive.feedback:
        if drive.series:
            e, _ = extend(drive.stack, memory, set_point)
        if cut is not None:
            chip = _chip(drive, cut, free, e, here, stiffness, c)
        return e, chip
    # Each iteration shrinks the error by the coupling within a sample, which `ToolDrive` keeps below a half; the last
    # one is bit-identical to the one before. Each iteration starts at the stack's state of the previous sample.
    x1 = _carriage(drive, free, drive.before[0], 0.0)
    for _ in range(_ROUNDS):
        guess = x1
        drive.reading[0] = quantise(guess + noise, drive.resolution)
        put(trial, memory)
        e, _ = extend(drive.stack, trial, set_point - drive.reading[0])
        force = 0.0
        if cut is not None:
            chip = _chip(drive, cut, free, e, here, stiffness, c)
            force = held(cut) + cut.process.lag_now * stiffness * max(chip, 0.0)
        x1 = _carriage(drive, free, e, drive.radial * force)
        if x1 == guess:
            break
    put(memory, trial)
    return e, chip


@inlined
def _settle(drive: MotionTable, free: Array, e: float, pushes: float, noise: float) -> None:
    """Update the state of the drives at the end of a sample, for a given extension and radial force."""
    state, fine, load = drive.state, drive.weights.fine, drive.weights.load
    for i in range(fine.shape[0]):
        state[i] = free[i] + fine[i, 0] * e + load[i, 0] * pushes
    drive.before[0], drive.before[1] = e, pushes
    state[0], state[1] = between_stops(state[0], state[1], drive.carriage_stroke)  # the tool keeps its own motion
    if not drive.feedback:
        drive.reading[0] = quantise(state[0] + noise, drive.resolution)


@inlined
def _motion(drive: MotionTable, delayed: float) -> tuple[float, float, float, float, float, float, float]:
    """Return the carriage's position, velocity, current and reading; the piezo's extension, its velocity, voltage."""
    state, extension, rate, voltage = drive.state, 0.0, 0.0, 0.0
    current = (drive.spring * (drive.gain * delayed - state[0]) - drive.damper * state[1]) * drive.force_per_current
    if drive.coil.on:
        current = state[state.size - 1]
    base = drive.base
    if drive.series:
        extension, rate = state[2] - state[base], state[3] - state[base + 1]
        voltage = drive.memory[VOLTAGE] * drive.full_voltage
    return state[base], state[base + 1], current, drive.reading[0], extension, rate, voltage


@kernel
def advance(
    drive: MotionTable,
    first: int,
    command: Array,
    set_point: Array,
    noise: Array,
    jitter: Array,
    motion: tuple[Array, ...],
) -> None:
    """Step tool drives in air through a block.

    Args:
        drive: drives; their state is updated; at rest at 0 before sample 0.
        first: index of the first sample.
        command: set point of the carriage [m], shape (n,), as of all following arrays.
        set_point: of the piezo, before direct compensation [m].
        noise: of the carriage's position sensor [m].
        jitter: delay of the instants at which that sensor samples [s], or empty.
        motion: output arrays: true position [m] and velocity [m/s] of the carriage where the tool sits, current of the
            coil [A], position reading of the carriage's sensor [m]; extension of the piezo (tool relative to carriage)
            [m], its velocity [m/s], voltage at the piezo [V].
    """
    position, velocity, current, measured, extension, rate, voltage = motion
    free, trial, nowhere = np.empty(drive.state.size), np.empty(drive.memory.size), (0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(command.size):
        if due(drive.drift, first, k):
            _move(drive, first + k)
        delayed = _begin(drive, first + k, command[k], free)
        read = _off(noise, jitter, k, free)
        e, _ = _solve(drive, None, free, trial, set_point[k], read, nowhere, 0.0, 0.0)
        _settle(drive, free, e, 0.0, read)
        now = _motion(drive, delayed)
        position[k], velocity[k], current[k], measured[k], extension[k], rate[k], voltage[k] = now


#: input arrays of a block for `advance_loaded`, in its order
GIVEN = (
    "command", "set_point", "noise", "jitter", "met", "angle", "speed", "height", "cross_position", "feed_velocity",
    "allowance",
)  # fmt: skip


@kernel
def advance_loaded(
    drive: MotionTable,
    cut: CutTable,
    first: int,
    given: tuple[Array, ...],
    motion: tuple[Array, ...],
    of_cut: tuple[Array, ...],
) -> tuple[int, int]:
    """Step tool drives and cut through a block (implements `lathe_machine.plants.tool_drive.ToolDrive.block`).

    Args:
        drive: drives, see `advance`.
        cut: cutting process; its state is updated.
        first: index of the first sample.
        given: input arrays, see `GIVEN`.
        motion: output arrays, see `advance`.
        of_cut: output arrays, see `lathe_machine.plants.cutting.MADE`.

    Returns:
        Index of the sample where the kernel stopped, and the reason.
    """
    command, set_point, noise, jitter, met, angle, speed, height, cross_position, feed_velocity, allowance = given
    position, velocity, current, measured, extension, rate, voltage = motion
    force, deflection, depth_of_cut, feed, wear = of_cut
    per_radian = cut.process.grid / _TURN
    free, trial = np.empty(drive.state.size), np.empty(drive.memory.size)
    for k in range(command.size):
        place = angle[k] * per_radian
        reason, feed[k], stiffness, c = meet(cut, place, speed[k], height[k], angle[k], feed_velocity[k])
        if reason != DONE:
            return k, reason
        wear[k] = cut.state[WEAR]
        if due(drive.drift, first, k):
            _move(drive, first + k)
        delayed = _begin(drive, first + k, command[k], free)
        read = _off(noise, jitter, k, free)
        here = (place, angle[k], cross_position[k], met[k], allowance[k])
        e, chip = _solve(drive, cut, free, trial, set_point[k], read, here, stiffness, c)
        if np.isnan(chip):
            return k, DRAWN_IN
        depth_of_cut[k] = chip = max(chip, 0.0)
        force[k], deflection[k] = press(cut, chip, stiffness, c, speed[k], 0.0, 0.0)
        _settle(drive, free, e, drive.radial * force[k], read)
        now = _motion(drive, delayed)
        position[k], velocity[k], current[k], measured[k], extension[k], rate[k], voltage[k] = now
        moved = position[k]
        if drive.series:
            moved += extension[k]
            if drive.stiff * (e - extension[k]) - drive.loss * rate[k] > drive.tension:
                return k, _TORN_OFF
        leave(cut, place, chip, cross_position[k] + (moved - met[k]) + deflection[k])
    return command.size, DONE


def failure(reason: int, angle: float, speed: float, feed: float) -> LatheError:
    """Return the error for a failed motion or cut, see `lathe_machine.plants.chip.failure`."""
    if reason == _TORN_OFF:
        return LatheError(
            f"the tool's acceleration tears the stack off its preload at {angle:.6g} rad; allowed: more preload, or a "
            "gentler command"
        )
    return failure_of_cut(reason, angle, speed, feed)
