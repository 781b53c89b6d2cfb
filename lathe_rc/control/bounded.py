# SPDX-License-Identifier: Apache-2.0
"""Motions within bounds of velocity, acceleration and jerk, and commands that are taken over and given back by them."""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc.errors import LatheError
from lathe_rc.jit import inlined, kernel

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

_LONGER = 1.05  # factor from one try of a duration to the next
_LOOKS = 129  # points at which a motion is looked at
_WITHIN = 1.0 + 1e-9


@dataclass(frozen=True)
class Bounds:
    """Bounds of a motion, which may begin beyond them.

    Attributes:
        velocity: [m/s].
        acceleration: [m/s²].
        jerk: [m/s³].
    """

    velocity: float
    acceleration: float
    jerk: float

    def reach(self, time: float) -> float:
        """Longest way of a motion from rest to rest in some time [m].

        The peaks of a way s in the time T are 1.875·s/T, 10/√3·s/T² and 60·s/T³.
        """
        peak = 10.0 / math.sqrt(3.0)
        return min(self.velocity * time / 1.875, self.acceleration * time**2 / peak, self.jerk * time**3 / 60.0)


def motion(start: float, velocity: float, end: float | None, bounds: Bounds, step: float) -> Array:
    """Motion to rest: a polynomial of fifth degree, as short as the bounds allow to 5 %.

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
    positions[-1] = start + way if end is None else end  # without rounding: there a command stands still
    return positions


def prepare() -> None:
    """Load the part of SciPy that motions use: its import at their first use would stall a run."""
    motion(0.0, 0.0, 0.0, Bounds(1.0, 1.0, 1.0), 1.0)


class Mode(IntEnum):
    """The side that commands."""

    FOLLOW = 0  #: the controller
    HOLD = 1  #: nobody: the command comes to rest
    RETRACT = 2  #: the command goes to its place out of the part


_MODE, _PLACE = 0, 1  # places in the state of a takeover: its mode, and how much of its path is behind


class TakeoverTable(NamedTuple):
    """A `Takeover` for kernels.

    Attributes:
        path: positions to come; of what is added to the command when it follows [m], shape (n,).
        whole: mode, and how much of the path is behind.
        given, wanted: the last two samples, after and before the takeover [m].
    """

    path: Array
    whole: Integers
    given: Array
    wanted: Array


@inlined
def follows(takeover: TakeoverTable) -> bool:
    """Whether the command is the controller's, and nothing is added to it."""
    return bool(takeover.whole[_MODE] == Mode.FOLLOW.value and takeover.whole[_PLACE] >= takeover.path.size)


@inlined
def _keep_last(last: Array, samples: Array) -> None:
    """Keep the last two samples, of the blocks before if this one has less."""
    if samples.size > 1:
        last[0], last[1] = samples[-2], samples[-1]
    elif samples.size == 1:
        last[0], last[1] = last[1], samples[0]


@kernel
def take_over(takeover: TakeoverTable, command: Array) -> None:
    """Replace the command of the controller by that for the drive; in place, shape (n,) [m]."""
    path, whole = takeover.path, takeover.whole
    _keep_last(takeover.wanted, command)
    if not follows(takeover):
        place, adds = whole[_PLACE], whole[_MODE] == Mode.FOLLOW.value
        ahead = min(path.size - place, command.size)
        for k in range(ahead):
            command[k] = command[k] + path[place + k] if adds else path[place + k]
        if not adds:
            command[ahead:] = path[-1]
        whole[_PLACE] = place + ahead
    _keep_last(takeover.given, command)


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
        table: for `take_over`.
        skipped: by how much the last motion has begun nearer to its end than the command was [m]; 0 within reach.
    """

    def __init__(
        self, bounds: Bounds, retracted: float, step: float, *, reach: float = math.inf, carries: bool = True
    ) -> None:
        self._bounds, self._goal, self._step, self._reach, self._carries = bounds, retracted, step, reach, carries
        self.skipped = 0.0
        self.table = TakeoverTable(np.zeros(0), np.zeros(2, np.int64), np.zeros(2), np.zeros(2))

    @property
    def mode(self) -> Mode:
        """The side that commands; see `change`."""
        return Mode(self.table.whole[_MODE])

    @property
    def newest(self) -> float:
        """The last output [m]."""
        return float(self.table.given[1])

    @property
    def remaining(self) -> int:
        """Samples until the motion that is under way ends."""
        return self.table.path.size - int(self.table.whole[_PLACE])

    def change(self, mode: Mode) -> None:
        """Take over, or give back, from the next sample on."""
        self.skipped = 0.0
        if mode is self.mode:
            return
        given, wanted = self.table.given, self.table.wanted
        velocity = self._carried(given)
        if mode is Mode.FOLLOW:
            left = self._within_reach(given[1] - wanted[1], 0.0)
            path = motion(left, velocity - self._carried(wanted), 0.0, self._bounds, self._step)
        else:
            path = self._way(velocity, to_goal=mode is Mode.RETRACT)
        self.table.whole[:] = mode, 0
        self.table = self.table._replace(path=np.ascontiguousarray(path))

    def _way(self, velocity: float, *, to_goal: bool) -> Array:
        """The way to rest, or out of the part: a single motion that begins into the part would first go far into it."""
        start, step = self.newest, self._step
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
