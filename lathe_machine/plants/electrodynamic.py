# SPDX-License-Identifier: Apache-2.0
"""Coarse electrodynamic (voice-coil) tool drive with its own closed loops.

    Wi(p) = g·e^{-pτ} / (1 + 2ζp/ωn + p²/ωn²)

Source: papers 000 and 001; parameters identified from the table of 001. The coil current follows from the acceleration
of the carriage, i = m·x''/k. The gain g of the papers is 1. Further resonances are those of
`lathe_machine.plants.modes`, a slow change of gain and modes that of `lathe_machine.plants.drift`. The sensor may
sample at the time t + δ in place of t: it then reads x(t) + δ·x'(t), which is off by x''·δ²/2, 0.5 nm for 1 µs at 1000
m/s².
"""

from typing import NamedTuple

import numpy as np

from lathe_machine.plants.drift import NONE as NO_DRIFT
from lathe_machine.plants.drift import Drift, DriftTable, due, gained, move
from lathe_machine.plants.linear import DiscretePlant, Discretisation, discretise
from lathe_machine.plants.modes import NONE, Modes, carriage
from lathe_rc.arrays import Array, put
from lathe_rc.jit import inlined, kernel


@inlined
def between_stops(position: float, velocity: float, stroke: float) -> tuple[float, float]:
    """Limit a position [m] and its velocity [m/s] to inelastic end stops at ± ``stroke`` [m].

    The carriage stays at the end stop until it is driven back.
    """
    if position > stroke:
        return stroke, min(velocity, 0.0)
    if position < -stroke:
        return -stroke, max(velocity, 0.0)
    return position, velocity


class CoarseTable(NamedTuple):
    """An electrodynamic drive with its state, for kernels (see `ElectrodynamicDrive`).

    Attributes:
        transition, weights, part: difference equation of the plant, with the fraction of the delay.
        gain: g, included in the weights.
        spring, damper: gains of the drive's loops divided by the moving mass [1/s², 1/s].
        force_per_current: moving mass over force constant [A·s²/m].
        stroke: [m].
        edge: index of the position of the edge in the state.
        state: position and velocity of the sensor, then of the modes, shape (m,).
        line: delayed commands from before the next block, the oldest first.
        drift: drift of gain and modes.
    """

    transition: Array
    weights: Array
    part: float
    gain: float
    spring: float
    damper: float
    force_per_current: float
    stroke: float
    edge: int
    state: Array
    line: Array
    drift: DriftTable


@kernel
def advance(
    drive: CoarseTable,
    first: int,
    command: Array,
    jitter: Array,
    position: Array,
    velocity: Array,
    current: Array,
    sensed: Array,
) -> None:
    """Step an electrodynamic drive through a block (implements `ElectrodynamicDrive.block`).

    The sensor, ``sensed`` [m], samples ``jitter`` [s] late, shape (n,), or in time if that is empty.
    """
    if drive.drift.gain != 0.0:
        own = np.empty(command.size)
        for k in range(command.size):
            own[k] = gained(drive.drift, first + k, command[k])
        command = own
    if drive.state.size > 2:
        _advance_modes(drive, first, command, jitter, position, velocity, current, sensed)
        return
    state, line, part, stroke = drive.state, drive.line, drive.part, drive.stroke
    gain, spring, damper, force_per_current = drive.gain, drive.spring, drive.damper, drive.force_per_current
    # Scalars in locals: the compiler cannot know that the output arrays do not overlap the matrices.
    a, w = drive.transition, drive.weights
    a00, a01, a10, a11 = a[0, 0], a[0, 1], a[1, 0], a[1, 1]
    w00, w01, w02, w10, w11, w12 = w[0, 0], w[0, 1], w[0, 2], w[1, 0], w[1, 1], w[1, 2]
    x, v = state[0], state[1]
    sent = np.concatenate((line, command))  # one array, so that the loop needs neither a ring nor a branch
    for k in range(command.size):
        u0, u1, u2 = sent[k + 2], sent[k + 1], sent[k]
        new_x = a00 * x + a01 * v + w00 * u0 + w01 * u1 + w02 * u2
        new_v = a10 * x + a11 * v + w10 * u0 + w11 * u1 + w12 * u2
        x, v = new_x, new_v
        x, v = between_stops(x, v, stroke)
        delayed = (1.0 - part) * u0 + part * u1
        position[k], velocity[k] = x, v
        current[k] = (spring * (gain * delayed - x) - damper * v) * force_per_current
    state[0], state[1] = x, v
    put(line, sent[command.size :])
    put(sensed, position)
    for k in range(jitter.size):
        sensed[k] += jitter[k] * velocity[k]


@kernel
def _advance_modes(
    drive: CoarseTable,
    first: int,
    command: Array,
    jitter: Array,
    position: Array,
    velocity: Array,
    current: Array,
    sensed: Array,
) -> None:
    """Step a drive with modes through a block (see `advance`)."""
    state, part, transition, weights = drive.state, drive.part, drive.transition, drive.weights
    order = state.size
    moved = np.empty(order)
    sent = np.concatenate((drive.line, command))
    for k in range(command.size):
        if due(drive.drift, first, k):
            move(drive.drift, first + k, 0, transition)
            move(drive.drift, first + k, order, weights)
        u0, u1, u2 = sent[k + 2], sent[k + 1], sent[k]
        for i in range(order):
            moved[i] = weights[i, 0] * u0 + weights[i, 1] * u1 + weights[i, 2] * u2
            for j in range(order):
                moved[i] += transition[i, j] * state[j]
        put(state, moved)
        state[0], state[1] = between_stops(state[0], state[1], drive.stroke)
        delayed = (1.0 - part) * u0 + part * u1
        position[k], velocity[k], sensed[k] = state[drive.edge], state[drive.edge + 1], state[0]
        if jitter.size > 0:
            sensed[k] += jitter[k] * state[1]
        current[k] = (
            drive.spring * (drive.gain * delayed - state[0]) - drive.damper * state[1]
        ) * drive.force_per_current
    put(drive.line, sent[command.size :])


class ElectrodynamicDrive:
    """Simulated electrodynamic drive: from the command to motion and current.

    Args:
        natural_frequency: ωn [rad/s].
        damping: ζ [1].
        delay: τ [s].
        stroke: end stops at ± this displacement of the sensor [m].
        moving_mass: [kg].
        force_constant: [N/A].
        step: sampling step [s].
        method: discretisation, see `lathe_machine.plants.linear.discretise`.
        gain: g, static gain from the command to the position, of either sign.
        modes: further resonances.
        drift: drift of gain and modes.

    Attributes:
        plant: the difference equation, with the sensor's position as first state.
        table: constants and state for `advance`.
    """

    def __init__(
        self,
        *,
        natural_frequency: float,
        damping: float,
        delay: float,
        stroke: float,
        moving_mass: float,
        force_constant: float,
        step: float,
        method: Discretisation,
        gain: float = 1.0,
        modes: Modes = NONE,
        drift: Drift = NO_DRIFT,
    ) -> None:
        _, b, _, edge = carriage(natural_frequency, damping, modes)
        plants = []
        for state in drift.states():
            a, command, *_ = carriage(natural_frequency, damping, modes.moved(state.modes))
            plants.append(discretise(a, gain * command, delay, step, method))
        self.plant: DiscretePlant = plants[0]
        self.table = CoarseTable(
            # Copies, which a drift changes: cells share the plant.
            transition=self.plant.transition.copy(),
            weights=self.plant.weights.copy(),
            part=self.plant.fraction,
            gain=gain,
            spring=natural_frequency**2,
            damper=2.0 * damping * natural_frequency,
            force_per_current=moving_mass / force_constant,
            stroke=stroke,
            edge=edge,
            state=np.zeros(b.size),
            line=np.zeros(self.plant.delay + 2),
            drift=drift.table([np.hstack((each.transition, each.weights)) for each in plants], step),
        )

    def block(self, command: Array, position: Array, velocity: Array, current: Array, first: int = 0) -> None:
        """Step the drive through a block: fill position [m], velocity [m/s] and current [A] for a command [m].

        All arrays have the shape (n,); position and velocity are those of the edge. The drive is at rest at 0 before
        sample 0. ``first`` is the index of the first sample, by which the drive drifts.
        """
        advance(self.table, first, command, np.empty(0), position, velocity, current, np.empty_like(command))
