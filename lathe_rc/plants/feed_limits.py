# SPDX-License-Identifier: Apache-2.0
"""Limits of a feed drive's command: of stroke, velocity, acceleration and jerk of the motion that it asks for.

What the command u asks for is where the model settles: of a model that integrates the speed k·u, of any other the
position k·u, with its gain k.

    position  |k·u| ≤ stroke, |k·du/dt| ≤ velocity, |k·d²u/dt²| ≤ acceleration, |k·d³u/dt³| ≤ jerk
    speed     |x∞| ≤ stroke, |k·u| ≤ velocity, |k·du/dt| ≤ acceleration, |k·d²u/dt²| ≤ jerk

x∞ is where the motor would come to rest if the command were 0 from now on: with the denominator p·(a1 + a2·p + …) the
motor's position x + (a2·dx/dt + a3·d²x/dt² + …)/a1, which moves with k·u.
How they are kept is in `lathe_rc.control.limits`.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.control.limits import CommandLimits, keep_position, keep_velocity
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined
from lathe_rc.plants.feed_models import settles
from lathe_rc.transfer import TransferFunction

Array = npt.NDArray[np.float64]


class LimitTable(NamedTuple):
    """Limits of a drive's command for kernels, as `lathe_rc.control.limits` has them; all in the command's unit.

    Attributes:
        stroke, velocity, acceleration, jerk: of the position or the velocity that the command is.
        step: from one taken command to the next [s].
        coming: of a velocity: weights of the states in x∞, shape (m,); of a position: empty.
    """

    stroke: float
    velocity: float
    acceleration: float
    jerk: float
    step: float
    coming: Array


@inlined
def keep_within(limits: LimitTable, memory: Array, state: Array, command: float) -> bool:
    """Keep a command within its limits; ``state`` is the drive's. The first of ``memory`` is what is given."""
    stroke, velocity, acceleration, jerk, step = (
        limits.stroke, limits.velocity, limits.acceleration, limits.jerk, limits.step
    )  # fmt: skip
    if limits.coming.size == 0:
        return keep_position(stroke, velocity, acceleration, jerk, step, memory, command)
    coming = 0.0
    for row in range(limits.coming.size):
        coming += limits.coming[row] * state[row]
    return keep_velocity(stroke, velocity, acceleration, jerk, step, memory, coming, command)


def limit_table(model: TransferFunction, limits: CommandLimits, command_limit: float, step: float) -> LimitTable:
    """The limits of a drive's command, taken every ``step`` [s]."""
    gain, integrates = settles(model)
    if limits.any and not gain:
        raise InputError(
            f"feed drive {model}: its command stands for neither a position nor a speed, so that there is no limit of "
            "stroke, velocity, acceleration or jerk for it; allowed: a gain, and one pole at 0 at most"
        )
    gain = gain or 1.0
    stroke, velocity, acceleration, jerk = (
        limit / gain for limit in (limits.stroke, limits.velocity, limits.acceleration, limits.jerk)
    )
    if integrates:
        bottom = np.trim_zeros(np.array(model.denominator), "f")
        coming = bottom[-2::-1] / (bottom[-2] * gain) if limits.any else np.empty(0)
        return LimitTable(stroke, min(velocity, command_limit), acceleration, jerk, step, coming)
    return LimitTable(min(stroke, command_limit), velocity, acceleration, jerk, step, np.empty(0))
