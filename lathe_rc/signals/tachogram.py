# SPDX-License-Identifier: Apache-2.0
"""Tachogram files: spindle speed over time, written as CSV with the columns time_s and rpm; linear between rows.

Time 0 is at the first row, as it is at the first reading of encoder counts; the file's absolute time is ignored.
"""

from pathlib import Path

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.signals import measurement_file
from lathe_rc.signals.table import write_table

_COLUMNS = ("time_s", "rpm")
_UNITS = {"revolutions per second (Hz)": 60.0, "rad/s": 30.0 / np.pi, "degrees per second": 1.0 / 6.0}  # in rpm
_NEAR = 1.2  # a unit is suspected if it brings the typical speed within this ratio of the nominal speed
_ROOM = 1e-6  # fraction of the tolerance reserved for rounding in the file
_FIRST_LOOK = 256  # number of points checked together; doubled after each check in which the line does not end


def read(path: Path) -> tuple[Array, Array]:
    """Read times after the first row [s] and speeds [1/min] from a tachogram file, shape (n,) each.

    Raises:
        InputError: the file is missing or malformed, the times do not increase, or a speed is not above 0.
    """
    found = measurement_file.read(path)
    _, rpm = found.read("time", "speed")
    time = found.since_first("time")
    measurement_file.check_rising(time, path)
    slow = np.flatnonzero(rpm <= 0.0)
    if slow.size:
        raise InputError(
            f"{path}: rpm = {rpm[slow[0]]:.10g} in row {slow[0] + 1}, {time[slow[0]]:.10g} s after the first; allowed: "
            "above 0 (an emulated spindle does not stand still: leave out the rows where this one does, or follow its "
            "counts with an encoder_device)"
        )
    return time, rpm


def check_unit(path: Path, rpm: Array, nominal_rpm: float) -> None:
    """Check that speeds are not in a unit other than 1/min.

    Args:
        path: path of the file, for the error message.
        rpm: speeds of the file, shape (n,).
        nominal_rpm: nominal speed [1/min].

    Raises:
        InputError: the median speed is close to the nominal speed in another unit.
    """
    typical = float(np.median(rpm))
    for unit, scale in _UNITS.items():
        if 1.0 / _NEAR < typical * scale / nominal_rpm < _NEAR:
            raise InputError(
                f"{path}: rpm is {typical:.4g} in the middle, with nominal_rpm = {nominal_rpm:g}, which looks like "
                f"{unit}; allowed: 1/min (multiply by {scale:.4g}, or set nominal_rpm = {typical:.4g} if it is)"
            )


def write(path: Path, time: Array, rpm: Array, comment: str) -> None:
    """Write a tachogram file (see `read`).

    Args:
        path: path of the file; an existing file is replaced.
        time: times of the rows [s], shape (n,).
        rpm: speeds [1/min], shape (n,).
        comment: first line of the file.

    Raises:
        InputError: the path is not writable.
    """
    write_table(path, ",".join(_COLUMNS), np.stack((time, rpm), axis=1), comment)


class Thinner:
    """Downsample a long record, chunk by chunk, so that straight lines between the points stay within a tolerance.

    Each line starts at the last selected point and is as long as possible: the next selected point is the last one that
    a line can reach while staying within the tolerance of all points in between.

    Args:
        tolerance: largest distance of the lines from any point, in the unit of the values; above 0.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance * (1.0 - _ROOM)
        self._picked: list[tuple[float, float]] = []
        self._reached: tuple[float, float] | None = None  # the last point that a line from the selected point can reach
        self._time, self._value = np.empty(0), np.empty(0)  # points after it, or else after the selected point
        self._open()

    def add(self, time: Array, value: Array) -> None:
        """Add further points with increasing times, shape (n,)."""
        self._time, self._value = np.append(self._time, time), np.append(self._value, value)
        if not self._picked and self._time.size:
            self._picked.append((float(self._time[0]), float(self._value[0])))
            self._drop(1)
        self._look()

    def finish(self) -> tuple[Array, Array]:
        """Return times and values of the selected points, including the first and the last point; shape (m,) each."""
        while self._reached is not None:
            self._pick()
            self._look()
        found = np.array(self._picked).reshape(-1, 2)
        return found[:, 0], found[:, 1]

    def _open(self) -> None:
        """Allow any slope, since no point after the selected one has been checked yet."""
        self._seen, self._low, self._high = 0, -np.inf, np.inf

    def _drop(self, count: int) -> None:
        """Drop the given number of points after the selected or reachable point."""
        self._time, self._value = self._time[count:], self._value[count:]

    def _pick(self) -> None:
        """Start the next line at the last reachable point."""
        assert self._reached is not None, "the first point after the picked one can be reached"
        self._picked.append(self._reached)
        self._reached = None
        self._open()

    def _look(self) -> None:
        """Check the remaining points, and select one wherever no line passes within the tolerance of all of them."""
        count = _FIRST_LOOK
        while self._seen < self._time.size:
            time, value = self._time[self._seen :][:count], self._value[self._seen :][:count]
            since, rise = time - self._picked[-1][0], value - self._picked[-1][1]
            low = np.maximum(np.maximum.accumulate((rise - self._tolerance) / since), self._low)
            high = np.minimum(np.minimum.accumulate((rise + self._tolerance) / since), self._high)
            closed = np.flatnonzero(low > high)
            end = int(closed[0]) if closed.size else since.size
            # A line to a point passes the earlier points if its slope is between ``low`` and ``high`` at that point.
            slope = rise[:end] / since[:end]
            fits = np.flatnonzero((low[:end] <= slope) & (slope <= high[:end]))
            self._seen += end
            if end:
                self._low, self._high = float(low[end - 1]), float(high[end - 1])
            if fits.size:
                place = int(fits[-1])
                self._reached = float(time[place]), float(value[place])
                left = end - place - 1
                self._drop(self._seen - left)
                self._seen = left
            if closed.size:
                self._pick()
                count = _FIRST_LOOK
            else:
                count *= 2
