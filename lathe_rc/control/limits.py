# SPDX-License-Identifier: Apache-2.0
"""Limits of a command: stroke, velocity, acceleration, jerk.

A command is a position or a velocity. One that keeps within all of them goes through as it is, to the bit. Stroke and
velocity count before they are reached: the other limits must still be able to stop there. A command that does not is
followed as fast as they allow. With e what is missing, the velocity relative to that of the command is at most
min(√(A·e/2), (J·e²/9)^(1/3)), from which they can bring it to rest there; with Δv what is missing of that, the
acceleration relative to that of the command is at most √(J·Δv/2), and towards a limit of the velocity at most √(J·Δv).
What would come too near to a limit by its acceleration, taken back by the jerk, brakes. Samples that are not what was
commanded are counted.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]

_SHORT_OF = 0.98  # the limits of velocity and stroke, when they are approached
_CLOSE = 1.0 + 1e-9  # of a limit: rounding is no violation


@dataclass(frozen=True)
class CommandLimits:
    """Limits of a command; inf where there is none.

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
def _keeps(v: float, a: float, before: float, velocity: float, acceleration: float, jerk: float, step: float) -> bool:
    """Whether a velocity and an acceleration keep within the limits, now and when the jerk takes the acceleration back.

    ``before`` is the acceleration of the sample before.
    """
    rise = max(abs(a) * (0.5 * abs(a) / jerk - 0.5 * step), 0.0) if v * a > 0.0 else 0.0
    return (
        abs(v) <= velocity * _CLOSE
        and abs(v) + rise <= velocity * _CLOSE
        and abs(a) <= acceleration * _CLOSE
        and abs(a - before) <= jerk * step * _CLOSE
    )


@kernel
def _can_stop(coming: float, v: float, a: float, stroke: float, acceleration: float, jerk: float, step: float) -> bool:
    """Whether a sample with this velocity and acceleration leaves room to stop, the acceleration taken back first."""
    if stroke == np.inf:
        return True
    needs = abs(a) / jerk
    then = v + 0.5 * a * needs
    room = stroke - np.sign(then) * (coming + v * step + (v + a * needs / 3.0) * needs)
    return abs(then) <= _stopping(room, acceleration, jerk, step) * _CLOSE


@kernel
def _towards(
    v_wanted: float, pulling: float, v: float, a: float, velocity: float, acceleration: float, jerk: float, step: float
) -> float:
    """The acceleration of a sample that goes as fast as the limits allow for a velocity that itself changes."""
    change = v_wanted - v
    a_wanted = pulling + np.sign(change) * min(_reach(0.5 * jerk, abs(change)), abs(change) / step)
    if v * a_wanted > 0.0:
        left = velocity - abs(v)
        a_wanted = _clip(a_wanted, min(_reach(jerk, left), max(left, 0.0) / step))
    return a + _clip(_clip(a_wanted, acceleration) - a, jerk * step)


@kernel
def _next(
    v_goal: float, v_wanted: float, pulling: float, coming: float, v: float, a: float,
    stroke: float, velocity: float, acceleration: float, jerk: float, step: float,
) -> tuple[bool, float]:  # fmt: skip
    """Whether the next sample can be as wanted, and its acceleration.

    Args:
        v_goal: velocity of a sample that is as wanted.
        v_wanted: velocity otherwise, before its limits.
        pulling: acceleration of what is wanted.
        coming: position at which a velocity of 0 comes to rest.
        v: velocity of the sample before.
        a: its acceleration.
        stroke: see `CommandLimits`, as the next three.
        velocity: to each side.
        acceleration: to each side.
        jerk: to each side.
        step: sampling step [s].
    """
    a_goal = (v_goal - v) / step
    if _keeps(v_goal, a_goal, a, velocity, acceleration, jerk, step) and _can_stop(
        coming, v_goal, a_goal, stroke, acceleration, jerk, step
    ):
        return True, a_goal
    allowed = velocity
    if stroke < np.inf:
        room = stroke - np.sign(v_wanted) * coming
        allowed = min(allowed, _stopping(room, acceleration, jerk, step), max(0.5 * room / step, 0.0))
    found = _towards(_clip(v_wanted, _SHORT_OF * allowed), pulling, v, a, velocity, acceleration, jerk, step)
    after = v + found * step
    too_fast = abs(after + 0.5 * found * abs(found) / jerk) > velocity
    if too_fast or not _can_stop(coming, after, found, stroke, acceleration, jerk, step):
        found = _towards(0.0, 0.0, v, a, velocity, acceleration, jerk, step)
    return False, found


@kernel
def keep_position(
    stroke: float, velocity: float, acceleration: float, jerk: float, step: float, state: Array, wanted: float
) -> bool:
    """Keep one more sample of a wanted position within limits; returns whether it is clipped.

    Args:
        stroke: see `CommandLimits`, as the next three.
        velocity: to each side.
        acceleration: to each side.
        jerk: to each side.
        step: sampling step [s].
        state: position, velocity, acceleration of what was given; position and velocity of what was wanted; changed,
            the first is what is given now.
        wanted: the command.
    """
    p, v, a, goal_before, moving_before = state[0], state[1], state[2], state[3], state[4]
    goal = _clip(wanted, stroke)
    moving = _clip((goal - goal_before) / step, velocity)
    pulling = _clip((moving - moving_before) / step, acceleration)
    behind = goal_before - p
    v_wanted = moving + np.sign(behind) * _stopping(abs(behind), acceleration, jerk, step)
    v_goal = (goal - p) / step
    free, found = _next(v_goal, v_wanted, pulling, p, v, a, stroke, velocity, acceleration, jerk, step)
    if free:
        p, v = goal, v_goal
    else:
        v += found * step
        p += v * step
    state[0], state[1], state[2], state[3], state[4] = p, v, found, goal, moving
    return not free or goal != wanted


@kernel
def keep_velocity(
    stroke: float, velocity: float, acceleration: float, jerk: float, step: float, state: Array, coming: float,
    wanted: float,
) -> bool:  # fmt: skip
    """Keep one more sample of a wanted velocity within limits; returns whether it is clipped.

    Args:
        stroke: see `CommandLimits`, as the next three.
        velocity: to each side.
        acceleration: to each side.
        jerk: to each side.
        step: sampling step [s].
        state: velocity and acceleration of what was given, velocity that was wanted; changed, the first is what is
            given now.
        coming: position where what is driven comes to rest if 0 is given from now on.
        wanted: the command.
    """
    v, a, moving_before = state[0], state[1], state[2]
    moving = _clip(wanted, velocity)
    pulling = _clip((moving - moving_before) / step, acceleration)
    free, found = _next(moving, moving, pulling, coming, v, a, stroke, velocity, acceleration, jerk, step)
    state[0], state[1], state[2] = (moving if free else v + found * step), found, moving
    return not free or moving != wanted


class LimiterTable(NamedTuple):
    """A `CommandLimiter` for kernels.

    Attributes:
        stroke, velocity, acceleration, jerk: see `CommandLimits`.
        step: sampling step [s].
        state: for `keep_position`.
        clipped: whether it was not given as it was commanded, of sample n at n modulo its length.
    """

    stroke: float
    velocity: float
    acceleration: float
    jerk: float
    step: float
    state: Array
    clipped: npt.NDArray[np.uint8]


@kernel
def limit(limiter: LimiterTable, first: int, wanted: Array, given: Array) -> None:
    """Fill ``given`` from ``wanted``, shape (n,) [m], of the samples ``first`` on."""
    stroke, velocity, acceleration, jerk = limiter.stroke, limiter.velocity, limiter.acceleration, limiter.jerk
    mask = limiter.clipped.size - 1
    for k in range(wanted.size):
        limiter.clipped[(first + k) & mask] = keep_position(
            stroke, velocity, acceleration, jerk, limiter.step, limiter.state, wanted[k]
        )
        given[k] = limiter.state[0]


def rest() -> Array:
    """The state for `keep_position` or `keep_velocity` of a command at rest at 0."""
    return np.zeros(5)


def limiter(limits: CommandLimits, step: float, remembered: int) -> LimiterTable:
    """The limiter of a command; it is at rest at 0 before the first sample.

    Args:
        limits: that it keeps within.
        step: sampling step [s].
        remembered: samples for which it is known whether they were clipped, a power of two.
    """
    return LimiterTable(
        limits.stroke, limits.velocity, limits.acceleration, limits.jerk, step, rest(), np.zeros(remembered, np.uint8)
    )
