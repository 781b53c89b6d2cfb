# SPDX-License-Identifier: Apache-2.0
"""Example from paper 002, as in `lathe_machine.signals.example_002`: terms, derivatives, and the loop without delay."""

import numpy as np

from lathe_machine.control.periodic import PeriodicController, PeriodicLaw, PeriodicState, advance
from lathe_machine.signals.example_002 import OMEGA
from lathe_machine.transfer import System, TransferFunction, discretise, rest, step
from lathe_rc.arrays import Array
from lathe_rc.jit import kernel


def transient(time: Array) -> Array:
    """Return the decaying part of eq. 17; ``time`` in s, any shape."""
    return np.asarray(-0.1 * np.exp(-time))


def disturbance(time: Array) -> Array:
    """Return the disturbance of eq. 18; ``time`` in s, any shape."""
    return np.asarray(0.5 * np.sin(OMEGA * time) ** 2)


def steady_derivatives(time: Array) -> Array:
    """Return the steady part of eq. 17 and its first four derivatives, shape (5, n); ``time`` in s, shape (n,).

    The third derivative jumps where the cosine is 0, by 12ω³ = 0.024 1/s³. The impulse of the fourth derivative
    there is omitted: no limited input can produce it.
    """
    cosine, sine = np.cos(OMEGA * time), np.sin(OMEGA * time)
    size, slope = np.abs(cosine), -OMEGA * sine * np.sign(cosine)
    cube, cube_slope = size**3, 3.0 * size**2 * slope
    # With c = |cos ωt|: (c³)'' = 6ω²c - 9ω²c³ and, but for impulses, c'' = -ω²c.
    second = OMEGA**2 * (6.0 * size - 9.0 * cube)
    third = OMEGA**2 * (6.0 * slope - 9.0 * cube_slope)
    fourth = -(OMEGA**2) * (6.0 * OMEGA**2 * size + 9.0 * second)
    return np.stack((1.1 - cube, -cube_slope, -second, -third, -fourth))


@kernel
def _run(
    law: PeriodicLaw,
    state: PeriodicState,
    plant: System,
    plant_state: Array,
    first: int,
    wanted: Array,
    load: Array,
    output: Array,
    command: Array,
) -> None:
    """Simulate one block, filling output and command."""
    for k in range(wanted.size):
        # The input acts from this sample to the next, so the output at this sample is known before it.
        output[k] = step(plant, plant_state, 0.0)
        command[k] = advance(law, state, first + k, wanted[k], output[k])
        plant_state[plant.now.size] = command[k] + load[k]


class PeriodicLoop:
    """Closed loop of a controller at its first sample and a drive at rest.

    Args:
        controller: controller of the law.
        drive: strictly proper plant from S(u) + f to y.

    Attributes:
        controller: controller of the law, with its state.
    """

    def __init__(self, controller: PeriodicController, drive: TransferFunction) -> None:
        self.controller = controller
        self._plant = discretise(drive, controller.law.step, "zoh")
        self._state = rest(self._plant)

    def block(self, first: int, wanted: Array, load: Array, output: Array, command: Array) -> None:
        """Simulate one block starting at sample ``first``; arrays of shape (n,) [1].

        Args:
            first: absolute index of the first sample.
            wanted: reference r.
            load: f between each sample and the next.
            output: filled with y.
            command: filled with S(u).
        """
        controller = self.controller
        _run(controller.law, controller.state, self._plant, self._state, first, wanted, load, output, command)
