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

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]

_SHORT_OF = 0.98  # the limits of velocity and stroke, when they are approached
_CLOSE = 1.0 + 1e-9  # of a limit: rounding is no violation


class CommandLimits(NamedTuple):
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
def _stopping(limits: CommandLimits, step: float, distance: float) -> float:
    """Velocity from which a stop within a distance is possible."""
    if distance <= 0.0:
        return 0.0  # not inf · 0
    curved = float(np.cbrt(limits.jerk * distance * distance / 9.0))
    return min(float(np.sqrt(0.5 * limits.acceleration * distance)), curved, distance / step)


@kernel
def _reach(jerk: float, change: float) -> float:
    """Acceleration that the jerk can take back within a change of the velocity."""
    return float(np.sqrt(jerk * change)) if change > 0.0 else 0.0


@kernel
def _keeps(limits: CommandLimits, step: float, v: float, a: float, before: float) -> bool:
    """Whether a velocity and an acceleration keep within the limits, now and when the jerk takes the acceleration back.

    ``before`` is the acceleration of the sample before.
    """
    # Further velocity gained while the jerk takes the acceleration back; half a step of it is in v already.
    rise = max(abs(a) * (0.5 * abs(a) / limits.jerk - 0.5 * step), 0.0) if v * a > 0.0 else 0.0
    return (
        abs(v) <= limits.velocity * _CLOSE
        and abs(v) + rise <= limits.velocity * _CLOSE
        and abs(a) <= limits.acceleration * _CLOSE
        and abs(a - before) <= limits.jerk * step * _CLOSE
    )


@kernel
def _can_stop(limits: CommandLimits, step: float, coming: float, v: float, a: float) -> bool:
    """Whether a sample with this velocity and acceleration leaves room to stop, the acceleration taken back first."""
    if limits.stroke == np.inf:
        return True
    needs = abs(a) / limits.jerk
    then = v + 0.5 * a * needs
    room = limits.stroke - np.sign(then) * (coming + v * step + (v + a * needs / 3.0) * needs)
    return abs(then) <= _stopping(limits, step, room) * _CLOSE


@kernel
def _towards(limits: CommandLimits, step: float, v_wanted: float, pulling: float, v: float, a: float) -> float:
    """Acceleration of a sample that approaches a changing velocity as fast as the limits allow."""
    change, jerk = v_wanted - v, limits.jerk
    a_wanted = pulling + np.sign(change) * min(_reach(0.5 * jerk, abs(change)), abs(change) / step)
    if v * a_wanted > 0.0:
        left = limits.velocity - abs(v)
        a_wanted = _clip(a_wanted, min(_reach(jerk, left), max(left, 0.0) / step))
    return a + _clip(_clip(a_wanted, limits.acceleration) - a, jerk * step)


@kernel
def _next(
    limits: CommandLimits,
    step: float,
    v_goal: float,
    v_wanted: float,
    pulling: float,
    coming: float,
    v: float,
    a: float,
) -> tuple[bool, float]:
    """Whether the next sample can be as wanted, and its acceleration.

    Args:
        limits: of the motion.
        step: sampling step [s].
        v_goal: velocity of a sample that is as wanted.
        v_wanted: velocity otherwise, before its limits.
        pulling: acceleration of what is wanted.
        coming: position at which a velocity of 0 comes to rest.
        v: velocity of the sample before.
        a: its acceleration.
    """
    a_goal = (v_goal - v) / step
    if _keeps(limits, step, v_goal, a_goal, a) and _can_stop(limits, step, coming, v_goal, a_goal):
        return True, a_goal
    allowed = limits.velocity
    if limits.stroke < np.inf:
        room = limits.stroke - np.sign(v_wanted) * coming
        allowed = min(allowed, _stopping(limits, step, room), max(0.5 * room / step, 0.0))
    found = _towards(limits, step, _clip(v_wanted, _SHORT_OF * allowed), pulling, v, a)
    # What would pass a limit later, with the acceleration taken back at once, brakes now.
    after = v + found * step
    too_fast = abs(after + 0.5 * found * abs(found) / limits.jerk) > limits.velocity
    if too_fast or not _can_stop(limits, step, coming, after, found):
        found = _towards(limits, step, 0.0, 0.0, v, a)
    return False, found


@kernel
def keep_position(limits: CommandLimits, step: float, state: Array, wanted: float) -> bool:
    """Keep one more sample of a wanted position within limits; returns whether it is clipped.

    Args:
        limits: of the motion.
        step: sampling step [s].
        state: position, velocity, acceleration of what was given; position and velocity of what was wanted; changed,
            the first is what is given now.
        wanted: the command.
    """
    p, v, a, goal_before, moving_before = state[0], state[1], state[2], state[3], state[4]
    # Velocity and acceleration of what is wanted are fed forward; only what is left of them has to be caught up.
    goal = _clip(wanted, limits.stroke)
    moving = _clip((goal - goal_before) / step, limits.velocity)
    pulling = _clip((moving - moving_before) / step, limits.acceleration)
    behind = goal_before - p
    v_wanted = moving + np.sign(behind) * _stopping(limits, step, abs(behind))
    v_goal = (goal - p) / step
    free, found = _next(limits, step, v_goal, v_wanted, pulling, p, v, a)
    if free:
        p, v = goal, v_goal  # not p + v·step: it goes through to the bit
    else:
        v += found * step
        p += v * step
    state[0], state[1], state[2], state[3], state[4] = p, v, found, goal, moving
    return not free or goal != wanted


@kernel
def keep_velocity(limits: CommandLimits, step: float, state: Array, coming: float, wanted: float) -> bool:
    """Keep one more sample of a wanted velocity within limits; returns whether it is clipped.

    Args:
        limits: of the motion.
        step: sampling step [s].
        state: velocity and acceleration of what was given, velocity that was wanted; changed, the first is what is
            given now.
        coming: position where what is driven comes to rest if 0 is given from now on.
        wanted: the command.
    """
    v, a, moving_before = state[0], state[1], state[2]
    moving = _clip(wanted, limits.velocity)
    pulling = _clip((moving - moving_before) / step, limits.acceleration)
    free, found = _next(limits, step, moving, moving, pulling, coming, v, a)
    state[0], state[1], state[2] = (moving if free else v + found * step), found, moving
    return not free or moving != wanted


class LimiterTable(NamedTuple):
    """A `CommandLimiter` for kernels.

    Attributes:
        limits: that it keeps within.
        step: sampling step [s].
        state: for `keep_position`.
        clipped: whether it was not given as it was commanded, of sample n at n modulo its length.
    """

    limits: CommandLimits
    step: float
    state: Array
    clipped: npt.NDArray[np.uint8]


@kernel
def limit(limiter: LimiterTable, first: int, wanted: Array, given: Array) -> None:
    """Fill ``given`` from ``wanted``, shape (n,) [m], of the samples ``first`` on."""
    mask = limiter.clipped.size - 1
    for k in range(wanted.size):
        limiter.clipped[(first + k) & mask] = keep_position(limiter.limits, limiter.step, limiter.state, wanted[k])
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
    return LimiterTable(limits, step, rest(), np.zeros(remembered, np.uint8))
