# SPDX-License-Identifier: Apache-2.0
"""The example of paper 002 as `lathe_rc.signals.example_002` has it: parts, derivatives, the loop without a delay."""

import numpy as np
import numpy.typing as npt

from lathe_rc.control.periodic import PeriodicController, PeriodicLaw, PeriodicState, advance
from lathe_rc.jit import kernel
from lathe_rc.signals.example_002 import OMEGA
from lathe_rc.transfer import System, TransferFunction, discretise, rest, step

Array = npt.NDArray[np.float64]


def transient(time: Array) -> Array:
    """The decaying part of eq. 17; ``time`` in s, any shape."""
    return np.asarray(-0.1 * np.exp(-time))


def disturbance(time: Array) -> Array:
    """Eq. 18; ``time`` in s, any shape."""
    return np.asarray(0.5 * np.sin(OMEGA * time) ** 2)


def steady_derivatives(time: Array) -> Array:
    """Eq. 17 without what decays, and its first four derivatives, shape (5, n); ``time`` in s, shape (n,).

    The third derivative jumps where the cosine is 0, by 12ω³ = 0.024 1/s³. The impulse that the fourth has there is
    left out: no limited input makes it.
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
    """Fill output and command."""
    for k in range(wanted.size):
        # The input acts from this sample to the next: the output, which it does not reach at once, is known first.
        output[k] = step(plant, plant_state, 0.0)
        command[k] = advance(law, state, first + k, wanted[k], output[k])
        plant_state[plant.now.size] = command[k] + load[k]


class PeriodicLoop:
    """A controller at its first sample and a drive at rest.

    Args:
        controller: of the law.
        drive: strictly proper, from S(u) + f to y.

    Attributes:
        controller: see above.
    """

    def __init__(self, controller: PeriodicController, drive: TransferFunction) -> None:
        self.controller = controller
        self._plant = discretise(drive, controller.law.step, "zoh")
        self._state = rest(self._plant)

    def block(self, first: int, wanted: Array, load: Array, output: Array, command: Array) -> None:
        """Step from sample ``first`` on; arrays of shape (n,) [1].

        Args:
            first: absolute index of the first sample.
            wanted: r.
            load: f, as it is between a sample and the next.
            output: filled with y.
            command: filled with S(u).
        """
        controller = self.controller
        _run(controller.law, controller.state, self._plant, self._state, first, wanted, load, output, command)
