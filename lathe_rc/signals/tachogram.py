# SPDX-License-Identifier: Apache-2.0
"""Tachograms: spindle speed over time as a CSV file with the columns time_s and rpm, linear between its rows.

Time 0 is at the first row, as that of counts is at the first reading: the clock of the file does not matter.
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError
from lathe_rc.signals.table import read_table, write_table

Array = npt.NDArray[np.float64]

_COLUMNS = ("time_s", "rpm")
_UNITS = {"revolutions per second (Hz)": 60.0, "rad/s": 30.0 / np.pi, "degrees per second": 1.0 / 6.0}  # in rpm
_NEAR = 1.2  # a typical speed that is this near to the nominal one in another unit, and so far off in rpm, is in that
_ROOM = 1e-6  # share of the tolerance that is kept for the rounding of the file
_FIRST_LOOK = 256  # points that are looked at together; twice as many after each look that finds no end


def read(path: Path) -> tuple[Array, Array]:
    """Return times after the first row [s] and speeds [1/min] of a file, shape (n,) each.

    Raises:
        InputError: the file is missing or malformed, times do not rise, or a speed is not above 0.
    """
    _, rows = read_table(path, [_COLUMNS], "tachogram", since_first=True)
    time, rpm = rows[:, 0].copy(), rows[:, 1].copy()
    if not time.size:
        raise InputError(f"{path}: no row; allowed: one or more of {','.join(_COLUMNS)}")
    wrong = np.flatnonzero(np.diff(time) <= 0.0)
    if wrong.size:
        place = int(wrong[0]) + 1
        raise InputError(
            f"{path}: row {place + 1} is {time[place] - time[place - 1]:.10g} s after the one before; allowed: times "
            "that rise"
        )
    slow = np.flatnonzero(rpm <= 0.0)
    if slow.size:
        raise InputError(
            f"{path}: rpm = {rpm[slow[0]]:.10g} in row {slow[0] + 1}, {time[slow[0]]:.10g} s after the first; allowed: "
            "above 0 (an emulated spindle does not stand still: leave out the rows where this one does, or follow its "
            "counts with an encoder_device)"
        )
    return time, rpm


def check_unit(path: Path, rpm: Array, nominal_rpm: float) -> None:
    """Refuse speeds that are most likely not in 1/min.

    Args:
        path: of the file, for the message.
        rpm: its speeds, shape (n,).
        nominal_rpm: speed that they deviate from [1/min].

    Raises:
        InputError: the median is the nominal speed in another unit.
    """
    typical = float(np.median(rpm))
    for unit, scale in _UNITS.items():
        if 1.0 / _NEAR < typical * scale / nominal_rpm < _NEAR:
            raise InputError(
                f"{path}: rpm is {typical:.4g} in the middle, with nominal_rpm = {nominal_rpm:g}, which looks like "
                f"{unit}; allowed: 1/min (multiply by {scale:.4g}, or set nominal_rpm = {typical:.4g} if it is)"
            )


def write(path: Path, time: Array, rpm: Array, comment: str) -> None:
    """Write a file that `read` takes.

    Args:
        path: of the file; an existing one is replaced.
        time: of its rows [s], shape (n,).
        rpm: speed [1/min], shape (n,).
        comment: a line at the top.

    Raises:
        InputError: a place that cannot be written to.
    """
    write_table(path, ",".join(_COLUMNS), np.stack((time, rpm), axis=1), comment)


class Thinner:
    """Picks points of a long record, piece by piece, between which straight lines stay near to all others.

    From the point that was picked last it goes as far as one line can: the next is the last point that a line reaches
    which passes all points in between within the tolerance.

    Args:
        tolerance: greatest distance of the lines from any point, in the unit of the values; above 0.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance * (1.0 - _ROOM)
        self._picked: list[tuple[float, float]] = []
        self._reached: tuple[float, float] | None = None  # the last point that a line reaches from the picked one
        self._time, self._value = np.empty(0), np.empty(0)  # after that, or after the picked one
        self._open()

    def add(self, time: Array, value: Array) -> None:
        """Take further points, shape (n,); their times rise."""
        self._time, self._value = np.append(self._time, time), np.append(self._value, value)
        if not self._picked and self._time.size:
            self._picked.append((float(self._time[0]), float(self._value[0])))
            self._drop(1)
        self._look()

    def finish(self) -> tuple[Array, Array]:
        """Return times and values of the picked points, the first and the last point among them; shape (m,) each."""
        while self._reached is not None:
            self._pick()
            self._look()
        found = np.array(self._picked).reshape(-1, 2)
        return found[:, 0], found[:, 1]

    def _open(self) -> None:
        """Allow any slope: no point after the picked one has been looked at yet."""
        self._seen, self._low, self._high = 0, -np.inf, np.inf

    def _drop(self, count: int) -> None:
        """Forget the first points after the picked or the reached one."""
        self._time, self._value = self._time[count:], self._value[count:]

    def _pick(self) -> None:
        """Begin the next line at the last point that this one reaches."""
        assert self._reached is not None, "the first point after the picked one can be reached"
        self._picked.append(self._reached)
        self._reached = None
        self._open()

    def _look(self) -> None:
        """Go through the points that have not been looked at, and pick one wherever no line passes all."""
        count = _FIRST_LOOK
        while self._seen < self._time.size:
            time, value = self._time[self._seen :][:count], self._value[self._seen :][:count]
            since, rise = time - self._picked[-1][0], value - self._picked[-1][1]
            low = np.maximum(np.maximum.accumulate((rise - self._tolerance) / since), self._low)
            high = np.minimum(np.minimum.accumulate((rise + self._tolerance) / since), self._high)
            closed = np.flatnonzero(low > high)
            end = int(closed[0]) if closed.size else since.size
            # A line to a point passes those before it if its slope is between the ``low`` and ``high`` of that point.
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
