# SPDX-License-Identifier: Apache-2.0
"""Limits on the stroke, velocity, acceleration and jerk of a command.

A command is a position or a velocity. A command within all limits passes unchanged, bit for bit. Stroke and velocity
limits take effect early, so that the output can still stop at them within the acceleration and jerk limits A and J. A
command beyond the limits is followed as fast as they allow. With e the remaining distance, the velocity relative to
that of the command is at most min(√(A·e/2), (J·e²/9)^(1/3)), which permits stopping at the command. With Δv the
remaining velocity difference, the acceleration relative to that of the command is at most √(J·Δv/2), or √(J·Δv) towards
a velocity limit. The output brakes if it would otherwise exceed a limit while the jerk reduces its acceleration to 0.
Clipped samples are reported.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array
from lathe_rc.jit import kernel

_SHORT_OF = 0.98  # fraction of the allowed velocity that is used when approaching a limit
_CLOSE = 1.0 + 1e-9  # tolerance factor of a limit, for rounding errors


class CommandLimits(NamedTuple):
    """Limits on a command's stroke, velocity, acceleration and jerk; inf for no limit.

    Attributes:
        stroke: largest displacement in either direction [m].
        velocity: largest velocity [m/s].
        acceleration: largest acceleration [m/s²].
        jerk: largest jerk [m/s³].
    """

    stroke: float = np.inf
    velocity: float = np.inf
    acceleration: float = np.inf
    jerk: float = np.inf

    @property
    def any(self) -> bool:
        """Whether any limit is finite."""
        return min(self.stroke, self.velocity, self.acceleration, self.jerk) < np.inf


@kernel
def _clip(value: float, limit: float) -> float:
    return float(min(max(value, -limit), limit))


@kernel
def _stopping(limits: CommandLimits, step: float, distance: float) -> float:
    """Compute the largest velocity that permits a stop within ``distance``."""
    if distance <= 0.0:
        return 0.0  # avoids inf · 0
    curved = float(np.cbrt(limits.jerk * distance * distance / 9.0))
    return min(float(np.sqrt(0.5 * limits.acceleration * distance)), curved, distance / step)


@kernel
def _reach(jerk: float, change: float) -> float:
    """Compute the largest acceleration that the jerk can reduce to 0 within a given velocity change."""
    return float(np.sqrt(jerk * change)) if change > 0.0 else 0.0


@kernel
def _keeps(limits: CommandLimits, step: float, v: float, a: float, before: float) -> bool:
    """Return whether ``v`` and ``a`` stay within the limits, now and while the jerk reduces ``a`` to 0.

    ``before`` is the acceleration of the previous sample.
    """
    # Velocity gained while the jerk reduces the acceleration to 0; v already includes half a step of it.
    rise = max(abs(a) * (0.5 * abs(a) / limits.jerk - 0.5 * step), 0.0) if v * a > 0.0 else 0.0
    return (
        abs(v) <= limits.velocity * _CLOSE
        and abs(v) + rise <= limits.velocity * _CLOSE
        and abs(a) <= limits.acceleration * _CLOSE
        and abs(a - before) <= limits.jerk * step * _CLOSE
    )


@kernel
def _can_stop(limits: CommandLimits, step: float, coming: float, v: float, a: float) -> bool:
    """Return whether a stop within the stroke is possible after a sample with velocity ``v`` and acceleration ``a``."""
    if limits.stroke == np.inf:
        return True
    needs = abs(a) / limits.jerk
    then = v + 0.5 * a * needs
    room = limits.stroke - np.sign(then) * (coming + v * step + (v + a * needs / 3.0) * needs)
    return abs(then) <= _stopping(limits, step, room) * _CLOSE


@kernel
def _towards(limits: CommandLimits, step: float, v_wanted: float, pulling: float, v: float, a: float) -> float:
    """Compute the acceleration that approaches a changing velocity as fast as the limits allow."""
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
    """Return whether the next sample can follow the command exactly, and the acceleration of that sample.

    Args:
        limits: limits of the command.
        step: sampling step [s].
        v_goal: velocity of a sample that follows the command exactly.
        v_wanted: desired velocity, before limiting, of a sample that cannot follow exactly.
        pulling: acceleration of the command.
        coming: position at which the output comes to rest if its velocity is 0 from now on.
        v: velocity of the previous sample.
        a: acceleration of the previous sample.
    """
    a_goal = (v_goal - v) / step
    if _keeps(limits, step, v_goal, a_goal, a) and _can_stop(limits, step, coming, v_goal, a_goal):
        return True, a_goal
    allowed = limits.velocity
    if limits.stroke < np.inf:
        room = limits.stroke - np.sign(v_wanted) * coming
        allowed = min(allowed, _stopping(limits, step, room), max(0.5 * room / step, 0.0))
    found = _towards(limits, step, _clip(v_wanted, _SHORT_OF * allowed), pulling, v, a)
    # Brake now if a limit would be exceeded later even with the acceleration reduced to 0 immediately.
    after = v + found * step
    too_fast = abs(after + 0.5 * found * abs(found) / limits.jerk) > limits.velocity
    if too_fast or not _can_stop(limits, step, coming, after, found):
        found = _towards(limits, step, 0.0, 0.0, v, a)
    return False, found


@kernel
def keep_position(limits: CommandLimits, step: float, state: Array, wanted: float) -> bool:
    """Limit the next sample of a position command; return whether it was clipped.

    Args:
        limits: limits of the command.
        step: sampling step [s].
        state: position, velocity and acceleration of the output; position and velocity of the command. Updated in
            place; the first element is the new output.
        wanted: position command [m].
    """
    p, v, a, goal_before, moving_before = state[0], state[1], state[2], state[3], state[4]
    # The command's velocity and acceleration are fed forward; only the remaining difference is controlled.
    goal = _clip(wanted, limits.stroke)
    moving = _clip((goal - goal_before) / step, limits.velocity)
    pulling = _clip((moving - moving_before) / step, limits.acceleration)
    behind = goal_before - p
    v_wanted = moving + np.sign(behind) * _stopping(limits, step, abs(behind))
    v_goal = (goal - p) / step
    free, found = _next(limits, step, v_goal, v_wanted, pulling, p, v, a)
    if free:
        p, v = goal, v_goal  # not p + v·step: the command must pass bit for bit
    else:
        v += found * step
        p += v * step
    state[0], state[1], state[2], state[3], state[4] = p, v, found, goal, moving
    return not free or goal != wanted


@kernel
def keep_velocity(limits: CommandLimits, step: float, state: Array, coming: float, wanted: float) -> bool:
    """Limit the next sample of a velocity command; return whether it was clipped.

    Args:
        limits: limits of the command.
        step: sampling step [s].
        state: velocity and acceleration of the output, velocity of the command. Updated in place; the first element
            is the new output.
        coming: position at which the drive would come to rest with an output of 0 from now on [m].
        wanted: velocity command [m/s].
    """
    v, a, moving_before = state[0], state[1], state[2]
    moving = _clip(wanted, limits.velocity)
    pulling = _clip((moving - moving_before) / step, limits.acceleration)
    free, found = _next(limits, step, moving, moving, pulling, coming, v, a)
    state[0], state[1], state[2] = (moving if free else v + found * step), found, moving
    return not free or moving != wanted


class LimiterTable(NamedTuple):
    """Limits and state of a command limiter for kernels.

    Attributes:
        limits: limits of the command.
        step: sampling step [s].
        state: state for `keep_position`.
        clipped: ring buffer of flags for clipped samples; sample n is at index n modulo the length.
    """

    limits: CommandLimits
    step: float
    state: Array
    clipped: npt.NDArray[np.uint8]


@kernel
def limit(limiter: LimiterTable, first: int, wanted: Array, given: Array) -> None:
    """Fill ``given`` with the limited position command ``wanted`` of a block at sample ``first``, shape (n,) [m]."""
    mask = limiter.clipped.size - 1
    for k in range(wanted.size):
        limiter.clipped[(first + k) & mask] = keep_position(limiter.limits, limiter.step, limiter.state, wanted[k])
        given[k] = limiter.state[0]


def rest() -> Array:
    """Return the initial state of a limited command at rest at 0, for `keep_position` or `keep_velocity`."""
    return np.zeros(5)


def limiter(limits: CommandLimits, step: float, remembered: int) -> LimiterTable:
    """Create a limiter of a position command, initially at rest at 0.

    Args:
        limits: limits of the command.
        step: sampling step [s].
        remembered: number of samples for which the clipped flag is stored, a power of two.
    """
    return LimiterTable(limits, step, rest(), np.zeros(remembered, np.uint8))
