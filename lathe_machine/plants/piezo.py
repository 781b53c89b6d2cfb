# SPDX-License-Identifier: Apache-2.0
"""Fine piezo drive: linearisation, amplifier, hysteresis, creep, resonance.

    set point -> inverse hysteresis -> amplifier 1/(1 + pT) -> hysteresis -> creep -> resonance -> displacement

    resonance: 1/(1 + 2ζp/ωn + p²/ωn²)
    creep:     1 + c·Σ 1/(1 + pτ_i), τ_i a decade apart: after a step, about c·lg(t) more

The hysteresis precedes the resonance and acts on displacements relative to the stroke. The set point is limited to the
stroke, and the voltage to its range; clipped samples are counted.

Source: paper 001 (Wpk of eqs 6-9); parameters of spec/learning.md.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_machine.plants.hysteresis import LINEAR, Hysteresis, OperatorTable, advance, advance_along
from lathe_machine.plants.linear import Constant, DiscretePlant, Discretisation, discretise, second_order
from lathe_rc.arrays import Array, Complex, Integers
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel

_ROUNDING = 1e-9  # relative to the stroke: rounding error may bring an exact inverse above full voltage

# Indices in the state of a stack; the states of creep, inverse and hysteresis follow.
VOLTAGE, _DEMAND, _EXTENSION, _MEMORIES = 0, 1, 2, 3


class StackTable(NamedTuple):
    """Constants of a piezo stack for kernels (see `Stack`).

    Attributes:
        stroke: displacement at full voltage [m].
        inverse, forward: linearisation and hysteresis.
        inverse_size: size of the state of the inverse.
        decay, now, before: weights of the last output, the current input and the last input in the amplifier's lag.
        slew: largest change of the amplifier's output per sample, relative to full voltage.
        creep: decay and input weights of each creep lag, shape (n, 3).
        creep_gain: gain of each creep lag.
    """

    stroke: float
    inverse: OperatorTable
    inverse_size: int
    forward: OperatorTable
    decay: float
    now: float
    before: float
    slew: float
    creep: Array
    creep_gain: float


@kernel
def extend(stack: StackTable, state: Array, set_point: float) -> tuple[float, bool]:
    """Step a piezo stack; return its extension without load [m], and whether set point or voltage was clipped.

    Args:
        stack: constants of the stack.
        state: state, updated in place; ``state[VOLTAGE]`` is the amplifier's output relative to full voltage.
        set_point: desired extension [m].
    """
    wanted = set_point / stack.stroke
    within = min(max(wanted, -1.0), 1.0)
    inverse = _MEMORIES + stack.creep.shape[0]
    forward = inverse + stack.inverse_size
    demand = advance(stack.inverse.kind, stack.inverse.table, state, inverse, within)
    applied = min(max(demand, -1.0), 1.0)
    lagged = stack.decay * state[VOLTAGE] + stack.now * applied + stack.before * state[_DEMAND]
    voltage = min(max(lagged, state[VOLTAGE] - stack.slew), state[VOLTAGE] + stack.slew)
    extension = stack.stroke * advance(stack.forward.kind, stack.forward.table, state, forward, voltage)
    crept = extension
    creep = stack.creep
    for i in range(creep.shape[0]):
        place = _MEMORIES + i
        state[place] = creep[i, 0] * state[place] + creep[i, 1] * extension + creep[i, 2] * state[_EXTENSION]
        crept += stack.creep_gain * state[place]
    state[VOLTAGE], state[_DEMAND], state[_EXTENSION] = voltage, applied, extension
    return crept, wanted != within or abs(demand) > 1.0 + _ROUNDING or voltage != lagged


@kernel
def _extend_along(stack: StackTable, state: Array, set_point: Array, extension: Array, voltage: Array) -> int:
    """Step a piezo stack through a block: fill the extension [m] and the voltage relative to full voltage, shape (n,).

    For speed, each element of the stack is stepped through the whole block, with the order of operations of `extend`.
    Returns the number of samples at which set point or voltage was clipped.
    """
    inverse = _MEMORIES + stack.creep.shape[0]
    for k in range(set_point.size):
        extension[k] = min(max(set_point[k] / stack.stroke, -1.0), 1.0)
    advance_along(stack.inverse.kind, stack.inverse.table, state, inverse, extension, voltage)
    amplified, before, cut = state[VOLTAGE], state[_DEMAND], 0
    for k in range(set_point.size):
        applied = min(max(voltage[k], -1.0), 1.0)
        lagged = stack.decay * amplified + stack.now * applied + stack.before * before
        amplified = min(max(lagged, amplified - stack.slew), amplified + stack.slew)
        cut += set_point[k] / stack.stroke != extension[k] or abs(voltage[k]) > 1.0 + _ROUNDING or amplified != lagged
        before = applied
        voltage[k] = amplified
    state[VOLTAGE], state[_DEMAND] = amplified, before
    forward = inverse + stack.inverse_size
    advance_along(stack.forward.kind, stack.forward.table, state, forward, voltage, extension)
    before, creep = state[_EXTENSION], stack.creep
    for k in range(set_point.size):
        extension[k] = now = stack.stroke * extension[k]
        for i in range(creep.shape[0]):
            place = _MEMORIES + i
            state[place] = creep[i, 0] * state[place] + creep[i, 1] * now + creep[i, 2] * before
            extension[k] += stack.creep_gain * state[place]
        before = now
    state[_EXTENSION] = before
    return cut


def _lag(time: float, step: float, method: Discretisation) -> DiscretePlant:
    """Discretise the lag 1/(1 + p·time); times are in s."""
    least = float(f"{step / 1000.0:g}")  # the rounded number in the message is itself allowed
    if time < least:
        raise InputError(f"lag of {time:g} s at a step of {step:g} s; allowed: at least {least:g} s, or none")
    return discretise(np.array([[-1.0 / time]]), np.array([1.0 / time]), 0.0, step, method)


def _row(lag: DiscretePlant) -> Array:
    """Return the decay of a lag, and the weights of its current and last inputs."""
    return np.array([lag.transition[0, 0], lag.weights[0, 0], lag.weights[0, 1]])


@dataclass(frozen=True)
class LinearStack:
    """Linear model of amplifier and creep; the hysteresis is assumed to be linearised to a gain of 1.

    Attributes:
        amplifier: lag of the amplifier; None for no lag.
        creep: lags of the creep.
        creep_gain: gain of each creep lag.
    """

    amplifier: DiscretePlant | None
    creep: tuple[DiscretePlant, ...]
    creep_gain: float

    def response(self, frequency: npt.ArrayLike) -> Complex:
        """Return the frequency response from the set point to the extension at ``frequency`` [rad/s]."""
        frequency = np.asarray(frequency, dtype=np.float64)
        whole = np.ones(frequency.shape, dtype=np.complex128)
        for lag in self.creep:
            whole += self.creep_gain * lag.response(frequency)
        return whole * self.amplifier.response(frequency) if self.amplifier else whole


class Stack:
    """Amplifier and piezo ceramics: from the set point to the extension of a stack without load and mass.

    Args:
        stroke: displacement at full voltage, in both directions [m].
        amplifier_lag: T [s]; 0 for no lag.
        slew_rate: largest slope of the amplifier's output, relative to full voltage [1/s]; inf for no limit.
        hysteresis: hysteresis of the ceramics; None for no hysteresis.
        inverse: operator that linearises the hysteresis; None for no linearisation.
        creep_per_decade: c, relative creep per decade of time; 0 for no creep.
        creep_times: τ_i [s], a decade apart; only used with creep.
        step: sampling step [s].
        method: discretisation of the lags, see `lathe_machine.plants.linear.discretise`.

    Attributes:
        table: constants for `extend`.
        state: state for `extend`.
        linear: model without hysteresis and limits.
        steepest: largest change of the extension relative to the change of the set point in the same sample.

    Raises:
        InputError: a lag is much shorter than the step.
    """

    def __init__(
        self,
        *,
        stroke: float,
        amplifier_lag: float = 0.0,
        slew_rate: float = np.inf,
        hysteresis: Hysteresis | None = None,
        inverse: Hysteresis | None = None,
        creep_per_decade: float = 0.0,
        creep_times: Iterable[float] = (),
        step: float,
        method: Discretisation,
    ) -> None:
        self.linear = LinearStack(
            _lag(amplifier_lag, step, method) if amplifier_lag else None,
            tuple(_lag(time, step, method) for time in creep_times) if creep_per_decade else (),
            creep_per_decade,
        )
        amplifier = _row(self.linear.amplifier) if self.linear.amplifier else np.array([0.0, 1.0, 0.0])
        creep = np.array([_row(lag) for lag in self.linear.creep]).reshape(-1, 3)
        none = Hysteresis(LINEAR, np.empty(0), 1.0)
        inverse, hysteresis = inverse or none, hysteresis or none
        self.table = StackTable(
            stroke=stroke,
            inverse=inverse.law,
            inverse_size=inverse.state.size,
            forward=hysteresis.law,
            decay=amplifier[0],
            now=amplifier[1],
            before=amplifier[2],
            slew=slew_rate * step,
            creep=creep,
            creep_gain=creep_per_decade,
        )
        self.state = np.concatenate((np.zeros(_MEMORIES + len(creep)), inverse.state, hysteresis.state))
        crept = 1.0 + creep_per_decade * creep[:, 1].sum()
        self.steepest = float(inverse.steepest * amplifier[1] * hysteresis.steepest * crept)


class FineTable(NamedTuple):
    """Fine piezo drive with its state, for kernels (see `PiezoDrive`).

    Attributes:
        transition, weights: difference equation of the resonance.
        stack: constants of amplifier and ceramics.
        memory: state of amplifier and ceramics.
        full_voltage: voltage at the full stroke [V].
        state: position, velocity, and last extension [m, m/s, m].
        saturated: number of samples so far at which set point or voltage was clipped, shape (1,).
    """

    transition: Array
    weights: Array
    stack: StackTable
    memory: Array
    full_voltage: float
    state: Array
    saturated: Integers


@kernel
def advance_fine(drive: FineTable, set_point: Array, position: Array, velocity: Array, voltage: Array) -> None:
    """Step a fine piezo drive through a block (implements `PiezoDrive.block`)."""
    drive.saturated[0] += _extend_along(drive.stack, drive.memory, set_point, velocity, voltage)
    a, w, state, full_voltage = drive.transition, drive.weights, drive.state, drive.full_voltage
    a00, a01, a10, a11 = a[0, 0], a[0, 1], a[1, 0], a[1, 1]
    w00, w01, w10, w11 = w[0, 0], w[0, 1], w[1, 0], w[1, 1]
    x, v, before = state[0], state[1], state[2]
    for k in range(set_point.size):
        extension = velocity[k]
        x, v = (
            a00 * x + a01 * v + w00 * extension + w01 * before,
            a10 * x + a11 * v + w10 * extension + w11 * before,
        )
        before = extension
        position[k], velocity[k], voltage[k] = x, v, voltage[k] * full_voltage
    state[0], state[1], state[2] = x, v, before


@dataclass(frozen=True)
class LinearPiezo(Constant):
    """Linear model of the fine piezo drive, Wpk of paper 001, from its difference equations.

    Attributes:
        stack: amplifier and ceramics.
        plant: the resonance.
    """

    stack: LinearStack
    plant: DiscretePlant

    @property
    def poles(self) -> Complex:
        """Poles of the resonance [rad/s], shape (2,)."""
        return self.plant.poles

    def response(self, frequency: npt.ArrayLike) -> Complex:
        """Return the frequency response from the set point to the position at ``frequency`` [rad/s]."""
        return np.asarray(self.stack.response(frequency) * self.plant.response(frequency))


_linear = lru_cache(maxsize=64)(LinearPiezo)


class PiezoDrive:
    """Simulated fine piezo drive: from the set point to motion and voltage.

    Args:
        stack: amplifier and ceramics; its state becomes part of the drive.
        natural_frequency: ωn [rad/s].
        damping: ζ [1].
        full_voltage: voltage at the full stroke [V].
        step: sampling step [s].
        method: discretisation, see `lathe_machine.plants.linear.discretise`.

    Attributes:
        linear: model without hysteresis and limits.
        table: constants and state for `advance_fine`.
    """

    def __init__(
        self,
        stack: Stack,
        *,
        natural_frequency: float,
        damping: float,
        full_voltage: float,
        step: float,
        method: Discretisation,
    ) -> None:
        plant = discretise(*second_order(natural_frequency, damping), 0.0, step, method)
        self.linear = _linear(stack.linear, plant)
        self.table = FineTable(
            transition=plant.transition,
            weights=plant.weights,
            stack=stack.table,
            memory=stack.state,
            full_voltage=full_voltage,
            state=np.zeros(3),
            saturated=np.zeros(1, np.int64),
        )

    @property
    def saturated(self) -> int:
        """Number of samples so far at which set point or voltage was clipped."""
        return int(self.table.saturated[0])

    def block(self, set_point: Array, position: Array, velocity: Array, voltage: Array) -> None:
        """Step the drive through a block: fill position [m], velocity [m/s] and voltage [V] for a set point [m].

        All arrays have shape (n,). The drive is at rest at 0 before the first block.
        """
        advance_fine(self.table, set_point, position, velocity, voltage)
