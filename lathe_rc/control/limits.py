# SPDX-License-Identifier: Apache-2.0
"""Limits of a command: stroke, velocity, acceleration, jerk.

A command that keeps within all of them goes through as it is, to the bit. The stroke counts before it is reached: from
a velocity towards it the other limits must still be able to stop. A command that does not is followed as fast as they
allow. With e what is missing, the velocity relative to that of the command is at most min(√(A·e/2), (J·e²/9)^(1/3)),
from which they can bring it to rest there; with Δv what is missing of that, the acceleration relative to that of the
command is at most √(J·Δv/2), and towards a limit of the velocity at most √(J·Δv). Samples that are not what was
commanded are counted.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]

_SHORT_OF = 0.98  # the limits of velocity and stroke, when they are approached
_CLOSE = 1.0 + 1e-9  # of a limit: rounding is no violation


@dataclass(frozen=True)
class CommandLimits:
    """What a command keeps within; inf where there is no limit.

    Attributes:
        stroke: to each side [m].
        velocity: [m/s].
        acceleration: [m/s²].
        jerk: [m/s³].
    """

    stroke: float = np.inf
    velocity: float = np.inf
    acceleration: float = np.inf
    jerk: float = np.inf

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return min(self.stroke, self.velocity, self.acceleration, self.jerk) < np.inf


@kernel
def _clip(value: float, limit: float) -> float:
    return float(min(max(value, -limit), limit))


@kernel
def _stopping(distance: float, acceleration: float, jerk: float, step: float) -> float:
    """A velocity from which a stop within a distance is possible."""
    if distance <= 0.0:
        return 0.0  # not inf · 0
    curved = float(np.cbrt(jerk * distance * distance / 9.0))
    return min(float(np.sqrt(0.5 * acceleration * distance)), curved, distance / step)


@kernel
def _reach(jerk: float, change: float) -> float:
    """An acceleration that the jerk can take back within a change of the velocity."""
    return float(np.sqrt(jerk * change)) if change > 0.0 else 0.0


@kernel
def _limit(
    stroke: float, velocity: float, acceleration: float, jerk: float, step: float, state: Array, wanted: Array,
    given: Array, clipped: npt.NDArray[np.uint8],
) -> None:  # fmt: skip
    """The state: position, velocity, acceleration of what was given; position and velocity of what was wanted."""
    p, v, a, goal_before, moving_before = state
    for k in range(wanted.size):
        goal = _clip(wanted[k], stroke)
        moving = _clip((goal - goal_before) / step, velocity)
        pulling = _clip((moving - moving_before) / step, acceleration)
        behind = goal_before - p
        goal_before, moving_before = goal, moving
        v_goal = (goal - p) / step
        a_goal = (v_goal - v) / step
        inside = velocity
        if stroke < np.inf:
            inside = min(inside, _stopping(max(stroke - np.sign(v_goal) * p, 0.0), acceleration, jerk, step))
        if (
            abs(v_goal) <= inside * _CLOSE
            and abs(a_goal) <= acceleration * _CLOSE
            and abs(a_goal - a) <= jerk * step * _CLOSE
        ):
            clipped[k] = goal != wanted[k]
            p, v, a = goal, v_goal, a_goal
        else:
            clipped[k] = 1
            v_wanted = moving + np.sign(behind) * _stopping(abs(behind), acceleration, jerk, step)
            room = max(stroke - np.sign(v_wanted) * p, 0.0)
            stopping = _stopping(room, acceleration, jerk, step) if stroke < np.inf else velocity
            v_wanted = _clip(v_wanted, _SHORT_OF * min(velocity, stopping))
            change = v_wanted - v
            a_wanted = pulling + np.sign(change) * min(_reach(0.5 * jerk, abs(change)), abs(change) / step)
            if v * a_wanted > 0.0:
                a_wanted = _clip(a_wanted, _reach(jerk, velocity - abs(v)))
            a += _clip(_clip(a_wanted, acceleration) - a, jerk * step)
            v += a * step
            p += v * step
        given[k] = p
    state[0], state[1], state[2], state[3], state[4] = p, v, a, goal_before, moving_before


class CommandLimiter:
    """Keeps a command within its limits.

    Args:
        limits: that it keeps within; the command is at rest at 0 before the first sample.
        step: sampling step [s].

    Attributes:
        clipped: samples so far that were not given as they were commanded.
    """

    def __init__(self, limits: CommandLimits, step: float) -> None:
        self._limits, self._step = limits, step
        self._state = np.zeros(5)
        self.clipped = 0

    def block(self, wanted: Array, given: Array) -> npt.NDArray[np.uint8]:
        """Fill ``given`` from ``wanted``, shape (n,) [m]; 1 where they differ."""
        clipped = np.empty(wanted.size, np.uint8)
        limits = self._limits
        _limit(
            limits.stroke, limits.velocity, limits.acceleration, limits.jerk, self._step, self._state, wanted, given,
            clipped,
        )  # fmt: skip
        self.clipped += int(clipped.sum())
        return clipped
