# SPDX-License-Identifier: Apache-2.0
"""Coarse electrodynamic (voice-coil) tool drive with its own closed loops.

    Wi(p) = e^{-pτ} / (1 + 2ζp/ωn + p²/ωn²)

Source: papers 000 and 001; parameters identified from the table of 001. The coil current follows from the acceleration
of the carriage, i = m·x''/k.
"""

from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array, put
from lathe_rc.jit import inlined, kernel
from lathe_rc.plants.linear import DiscretePlant, Discretisation, discretise, second_order


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
        spring, damper: gains of the drive's loops divided by the moving mass [1/s², 1/s].
        force_per_current: moving mass over force constant [A·s²/m].
        stroke: [m].
        state: position and velocity.
        line: delayed commands from before the next block, the oldest first.
    """

    transition: Array
    weights: Array
    part: float
    spring: float
    damper: float
    force_per_current: float
    stroke: float
    state: Array
    line: Array


@kernel
def advance(drive: CoarseTable, command: Array, position: Array, velocity: Array, current: Array) -> None:
    """Step an electrodynamic drive through a block (implements `ElectrodynamicDrive.block`)."""
    state, line, part, stroke = drive.state, drive.line, drive.part, drive.stroke
    spring, damper, force_per_current = drive.spring, drive.damper, drive.force_per_current
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
        current[k] = (spring * (delayed - x) - damper * v) * force_per_current
    state[0], state[1] = x, v
    put(line, sent[command.size :])


class ElectrodynamicDrive:
    """Simulated electrodynamic drive: from the command to motion and current.

    Args:
        natural_frequency: ωn [rad/s].
        damping: ζ [1].
        delay: τ [s].
        stroke: end stops at ± this displacement [m].
        moving_mass: [kg].
        force_constant: [N/A].
        step: sampling step [s].
        method: discretisation, see `lathe_rc.plants.linear.discretise`.

    Attributes:
        plant: the difference equation.
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
    ) -> None:
        a, b = second_order(natural_frequency, damping)
        self.plant: DiscretePlant = discretise(a, b, delay, step, method)
        self.table = CoarseTable(
            transition=self.plant.transition,
            weights=self.plant.weights,
            part=self.plant.fraction,
            spring=float(-a[1, 0]),
            damper=float(-a[1, 1]),
            force_per_current=moving_mass / force_constant,
            stroke=stroke,
            state=np.zeros(2),
            line=np.zeros(self.plant.delay + 2),
        )

    def block(self, command: Array, position: Array, velocity: Array, current: Array) -> None:
        """Step the drive through a block: fill position [m], velocity [m/s] and current [A] for a command [m].

        All arrays have the shape (n,). The drive is at rest at 0 before the first block.
        """
        advance(self.table, command, position, velocity, current)
