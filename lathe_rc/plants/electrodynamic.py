# SPDX-License-Identifier: Apache-2.0
"""Coarse electrodynamic (voice-coil) tool drive, closed by its own loops.

    Wi(p) = e^{-pτ} / (1 + 2ζp/ωn + p²/ωn²)

Source: papers 000 and 001; parameters identified from the table of 001. The coil current is the one that the
carriage's acceleration asks for, i = m·x''/k.
"""

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel
from lathe_rc.plants.linear import DiscretePlant, Discretisation, discretise, second_order

Array = npt.NDArray[np.float64]


@kernel
def _advance(
    transition: Array,
    weights: Array,
    part: float,
    spring: float,
    damper: float,
    force_per_current: float,
    stroke: float,
    state: Array,
    line: Array,
    command: Array,
    position: Array,
    velocity: Array,
    current: Array,
) -> int:
    """Step the drive through a block; returns the number of samples at an end stop.

    ``line`` holds the commands before this block that are still on their way, the oldest first.
    """
    x, v = state[0], state[1]
    stopped = 0
    sent = np.concatenate((line, command))
    for k in range(command.size):
        u0, u1, u2 = sent[k + 2], sent[k + 1], sent[k]
        new_x = (
            transition[0, 0] * x + transition[0, 1] * v + weights[0, 0] * u0 + weights[0, 1] * u1 + weights[0, 2] * u2
        )
        new_v = (
            transition[1, 0] * x + transition[1, 1] * v + weights[1, 0] * u0 + weights[1, 1] * u1 + weights[1, 2] * u2
        )
        x, v = new_x, new_v
        # The end stops are inelastic: the carriage stays there until it is driven back.
        if x > stroke:
            x, v = stroke, min(v, 0.0)
            stopped += 1
        elif x < -stroke:
            x, v = -stroke, max(v, 0.0)
            stopped += 1
        delayed = (1.0 - part) * u0 + part * u1
        position[k], velocity[k] = x, v
        current[k] = (spring * (delayed - x) - damper * v) * force_per_current
    state[0], state[1] = x, v
    line[:] = sent[command.size :]
    return stopped


class ElectrodynamicDrive:
    """The drive as a machine: command in, motion and current out.

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
        stopped: samples spent at an end stop so far.
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
        self.stopped = 0
        self._spring, self._damper = -a[1, 0], -a[1, 1]
        self._force_per_current = moving_mass / force_constant
        self._stroke = stroke
        self._state = np.zeros(2)
        self._line = np.zeros(self.plant.delay + 2)

    def block(self, command: Array, position: Array, velocity: Array, current: Array) -> None:
        """Step through a block; arrays of shape (n,) [m, m, m/s, A]. At rest at 0 before the first."""
        plant = self.plant
        self.stopped += _advance(
            plant.transition, plant.weights, plant.fraction, self._spring, self._damper,
            self._force_per_current, self._stroke, self._state, self._line,
            command, position, velocity, current,
        )  # fmt: skip
