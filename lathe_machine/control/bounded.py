# SPDX-License-Identifier: Apache-2.0
"""Motions with bounded velocity, acceleration and jerk, and the takeover of a command by such motions."""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import scipy

from lathe_rc.arrays import Array, Integers
from lathe_rc.errors import LatheError
from lathe_rc.jit import inlined, kernel

_LONGER = 1.05  # ratio of successive trial durations
_LOOKS = 129  # points at which the bounds of a motion are checked
_WITHIN = 1.0 + 1e-9


@dataclass(frozen=True)
class Bounds:
    """Bounds on the velocity, acceleration and jerk of a motion; the initial velocity may exceed its bound.

    Attributes:
        velocity: largest velocity [m/s].
        acceleration: largest acceleration [m/s²].
        jerk: largest jerk [m/s³].
    """

    velocity: float
    acceleration: float
    jerk: float

    def reach(self, time: float) -> float:
        """Compute the longest distance of a rest-to-rest motion within ``time`` [s], in metres.

        The peaks of velocity, acceleration and jerk for a distance s in the time T are 1.875·s/T, 10/√3·s/T² and
        60·s/T³.
        """
        peak = 10.0 / math.sqrt(3.0)
        return min(self.velocity * time / 1.875, self.acceleration * time**2 / peak, self.jerk * time**3 / 60.0)


def motion(start: float, velocity: float, end: float | None, bounds: Bounds, step: float) -> Array:
    """Compute a motion to rest: a fifth-degree polynomial that lasts at most 5 % longer than the bounds require.

    Args:
        start: initial position [m]; the initial acceleration is 0.
        velocity: initial velocity [m/s].
        end: final position [m]; None for the earliest stop.
        bounds: bounds of the motion; if the initial velocity exceeds its bound, it becomes the largest velocity.
        step: sampling step [s].

    Returns:
        Positions from one step after the start up to the end [m], shape (n,), n at least 1.

    Raises:
        LatheError: start or velocity is NaN or infinite.
    """
    if not (math.isfinite(start) and math.isfinite(velocity)):
        raise LatheError(f"a command of {start} with a rate of {velocity} is taken over; allowed: finite numbers")
    highest = max(bounds.velocity, abs(velocity))
    length = abs(velocity) * step if end is None else abs(end - start)
    # Lower bound for the duration, from the peaks of a rest-to-rest motion.
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
    positions[-1] = start + way if end is None else end  # exact, since the command stays at this position
    return positions


def prepare() -> None:
    """Import the SciPy module of `motion` in advance, since an import at the first motion would stall a run."""
    motion(0.0, 0.0, 0.0, Bounds(1.0, 1.0, 1.0), 1.0)


class Mode(IntEnum):
    """Source of the command: the controller, a hold or a retraction."""

    FOLLOW = 0  #: the controller's command
    HOLD = 1  #: the command comes to rest
    RETRACT = 2  #: the command moves to the retracted position, out of the part


_MODE, _PLACE = 0, 1  # indices in the state of a takeover: mode, and number of samples of the path already output


class TakeoverTable(NamedTuple):
    """State of a `Takeover` for kernels.

    Attributes:
        path: positions of the motion; in the mode FOLLOW, offsets added to the controller's command [m], shape (n,).
        whole: mode, and number of samples of the path already output.
        given, wanted: the last two samples of the command sent to the drive, and of the controller's command [m].
    """

    path: Array
    whole: Integers
    given: Array
    wanted: Array


@inlined
def follows(takeover: TakeoverTable) -> bool:
    """Return whether the controller's command passes through unchanged."""
    return bool(takeover.whole[_MODE] == Mode.FOLLOW.value and takeover.whole[_PLACE] >= takeover.path.size)


@inlined
def _keep_last(last: Array, samples: Array) -> None:
    """Update the last two samples from a block of any length."""
    if samples.size > 1:
        last[0], last[1] = samples[-2], samples[-1]
    elif samples.size == 1:
        last[0], last[1] = last[1], samples[0]


@kernel
def take_over(takeover: TakeoverTable, command: Array) -> None:
    """Replace the controller's command by the drive's command in place, shape (n,) [m]."""
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
    """Takeover of a command for a hold or a retraction, and return to the controller, without a jump in position.

    The velocity does not jump either, unless the command is faster than the bounds allow. If the command is out of
    reach, where no drive can be, the motion begins at the limit of the reach.

    Args:
        bounds: bounds of the takeover's own motions.
        retracted: retracted position [m].
        step: sampling step [s].
        reach: largest distance between the start and the end of a motion [m].
        carries: whether a motion begins with the velocity of the command, limited to the bounds; False for a command
            that consists of steps and noise and so has no meaningful velocity.

    Attributes:
        table: state for `take_over`.
        skipped: distance from the command to the start of the last motion [m]; 0 unless the command was out of reach.
    """

    def __init__(
        self, bounds: Bounds, retracted: float, step: float, *, reach: float = math.inf, carries: bool = True
    ) -> None:
        self._bounds, self._goal, self._step, self._reach, self._carries = bounds, retracted, step, reach, carries
        self.skipped = 0.0
        self.table = TakeoverTable(np.zeros(0), np.zeros(2, np.int64), np.zeros(2), np.zeros(2))

    @property
    def mode(self) -> Mode:
        """Current source of the command, set by `change`."""
        return Mode(self.table.whole[_MODE])

    @property
    def newest(self) -> float:
        """Last command output to the drive [m]."""
        return float(self.table.given[1])

    @property
    def remaining(self) -> int:
        """Number of samples until the end of the current motion."""
        return self.table.path.size - int(self.table.whole[_PLACE])

    def change(self, mode: Mode) -> None:
        """Switch the source of the command, effective at the next sample."""
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
        """Compute the path to rest or to the retracted position.

        A command that moves away from the retracted position is stopped first, since a single motion would go far into
        the part.
        """
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
        """Return the velocity of the last two samples, limited to its bound; a faster change is noise or a step."""
        highest = self._bounds.velocity if self._carries else 0.0
        return float(np.clip((command[1] - command[0]) / self._step, -highest, highest))
