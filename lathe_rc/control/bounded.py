# SPDX-License-Identifier: Apache-2.0
"""Motions that keep within velocity, acceleration and jerk, and a command that is taken over and given back by them."""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc.errors import LatheError

Array = npt.NDArray[np.float64]

_LONGER = 1.05  # factor from one try of a duration to the next
_LOOKS = 129  # points at which a motion is looked at
_WITHIN = 1.0 + 1e-9


@dataclass(frozen=True)
class Bounds:
    """What a motion keeps within; what it begins with may be beyond.

    Attributes:
        velocity: [m/s].
        acceleration: [m/s²].
        jerk: [m/s³].
    """

    velocity: float
    acceleration: float
    jerk: float

    def reach(self, time: float) -> float:
        """As far as a motion from rest gets in some time [m].

        The peaks of a way s in the time T are 1.875·s/T, 10/√3·s/T² and 60·s/T³.
        """
        peak = 10.0 / math.sqrt(3.0)
        return min(self.velocity * time / 1.875, self.acceleration * time**2 / peak, self.jerk * time**3 / 60.0)


def motion(start: float, velocity: float, end: float | None, bounds: Bounds, step: float) -> Array:
    """A motion to rest: a polynomial of fifth degree, as short as the bounds allow to 5 %.

    Args:
        start: where it begins [m], without acceleration.
        velocity: with which it begins [m/s].
        end: where it ends [m]; None: where it comes to rest the soonest.
        bounds: that it keeps within; a larger velocity at the start is not exceeded.
        step: sampling step [s].

    Returns:
        Positions one step after the start and on, up to the end [m], shape (n,), n at least 1.

    Raises:
        LatheError: start or velocity is NaN or infinite.
    """
    if not (math.isfinite(start) and math.isfinite(velocity)):
        raise LatheError(f"a command of {start} with a rate of {velocity} is taken over; allowed: finite numbers")
    highest = max(bounds.velocity, abs(velocity))
    length = abs(velocity) * step if end is None else abs(end - start)
    # The shortest that the peaks of a motion from rest to rest could allow; nothing shorter need be tried.
    duration = max(step, 1.875 * length / highest, (60.0 * length / bounds.jerk) ** (1 / 3) / 2.0)
    while True:
        way = velocity * duration / 2.0 if end is None else end - start
        path = scipy.interpolate.BPoly.from_derivatives([0.0, duration], [[0.0, velocity, 0.0], [way, 0.0, 0.0]])
        times = np.linspace(0.0, duration, _LOOKS)
        peaks = [float(np.abs(path(times, order)).max()) for order in (1, 2, 3)]
        limits = (highest, bounds.acceleration, bounds.jerk)
        if all(peak <= limit * _WITHIN for peak, limit in zip(peaks, limits, strict=True)):
            break
        duration *= _LONGER
    samples = int(np.ceil(duration / step))
    positions: Array = start + path(np.minimum(np.arange(1, samples + 1) * step, duration))
    positions[-1] = start + way if end is None else end
    return positions


def prepare() -> None:
    """Load what motions need of SciPy, which is loaded when it is first used: else that would be in mid-run."""
    motion(0.0, 0.0, 0.0, Bounds(1.0, 1.0, 1.0), 1.0)


def _last_two(before: Array, samples: Array) -> Array:
    return samples[-2:].copy() if samples.size > 1 else np.concatenate((before, samples))[-2:]


class Mode(Enum):
    """Who commands."""

    FOLLOW = "the controller"
    HOLD = "nobody: the command comes to rest"
    RETRACT = "the command goes to its place out of the part"


class Takeover:
    """A command that is held or retracted, and given back to its controller, without a jump of position.

    Nor is there one of velocity, unless the command is faster than the bounds allow. A command that is out of reach is
    where nothing that moves can be: its way begins at the end of the reach.

    Args:
        bounds: of what it does itself.
        retracted: where the command is when retracted [m].
        step: sampling step [s].
        reach: how far from its end a motion begins at most [m].
        carries: whether a motion begins with the velocity that the command has, up to that of the bounds; one that is
            all steps and noise has none.

    Attributes:
        mode: who commands; see `change`.
        skipped: by how much the last motion has begun nearer to its end than the command was [m]; 0 within reach.
    """

    def __init__(
        self, bounds: Bounds, retracted: float, step: float, *, reach: float = math.inf, carries: bool = True
    ) -> None:
        self._bounds, self._goal, self._step, self._reach, self._carries = bounds, retracted, step, reach, carries
        self.mode, self.skipped = Mode.FOLLOW, 0.0
        self._path, self._place = np.zeros(0), 0  # positions to come; of what is added to the command when it follows
        self._given, self._wanted = np.zeros(2), np.zeros(2)  # the last two samples, after and before

    @property
    def newest(self) -> float:
        """What was given last [m]."""
        return float(self._given[1])

    @property
    def remaining(self) -> int:
        """Samples until the motion that is under way ends."""
        return self._path.size - self._place

    def change(self, mode: Mode) -> None:
        """Take over, or give back, from the next sample on."""
        self.skipped = 0.0
        if mode is self.mode:
            return
        velocity = self._carried(self._given)
        if mode is Mode.FOLLOW:
            rest = velocity - self._carried(self._wanted)
            left = self._within_reach(self._given[1] - self._wanted[1], 0.0)
            self._path = motion(left, rest, 0.0, self._bounds, self._step)
        else:
            self._path = self._way(velocity, to_goal=mode is Mode.RETRACT)
        self.mode, self._place = mode, 0

    def _way(self, velocity: float, *, to_goal: bool) -> Array:
        """The way to rest, or out of the part: a single motion that begins into the part would first go far into it."""
        start, step = float(self._given[1]), self._step
        if not to_goal:
            return motion(start, velocity, None, self._bounds, step)
        start = self._within_reach(start, self._goal)
        if velocity * (self._goal - start) >= 0.0:
            return motion(start, velocity, self._goal, self._bounds, step)
        stop = motion(start, velocity, None, self._bounds, step)
        return np.concatenate((stop, motion(float(stop[-1]), 0.0, self._goal, self._bounds, step)))

    def _within_reach(self, place: float, goal: float) -> float:
        within = float(np.clip(place, goal - self._reach, goal + self._reach))
        self.skipped = abs(place - within)
        return within

    def _carried(self, command: Array) -> float:
        """The velocity of the last two samples as far as a motion may have it: what is faster is noise, or a step."""
        highest = self._bounds.velocity if self._carries else 0.0
        return float(np.clip((command[1] - command[0]) / self._step, -highest, highest))

    def apply(self, command: Array) -> None:
        """Make of what the controller wants what the drive gets; in place, shape (n,) [m]."""
        if command.size > 1 and self._place >= self._path.size and self.mode is Mode.FOLLOW:
            self._given = self._wanted = command[-2:].copy()
            return
        wanted = _last_two(self._wanted, command)
        if self.mode is not Mode.FOLLOW or self._place < self._path.size:
            ahead = self._path[self._place : self._place + command.size]
            self._place += ahead.size
            if self.mode is Mode.FOLLOW:
                command[: ahead.size] += ahead
            else:
                command[: ahead.size], command[ahead.size :] = ahead, self._path[-1]
        self._given, self._wanted = _last_two(self._given, command), wanted
