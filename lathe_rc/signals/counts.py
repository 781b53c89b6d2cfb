# SPDX-License-Identifier: Apache-2.0
"""Counts of a real encoder: their sources, and the spindle angle at any time between two of them.

A reading is a time [ns] and the counter at that time. Between two readings the angle is linear.
"""

import os
import re
import stat
import termios
from abc import ABC, abstractmethod
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.signals.table import read_text

Array = npt.NDArray[np.float64]
Reading = tuple[int, int | float]  #: time [ns] and counter; a whole one as int, for a double has 53 bits

_READING = re.compile(r"\s*([-+]?[0-9.eE+-]+)\s*(?:[,;]|\s)\s*([-+]?[0-9.eE+-]+)\s*")
_HEADERS = {"time_ns,counts": 1, "time_s,counts": 10**9}  # and nanoseconds in a unit of the first column
_MOST_TIME = 2**63  # [ns]
_MOST_COUNT = 2.0**64  # of any counter
_LONGEST_LINE = 256
_GOES_ON = 3600  # [s]
_PIECE = 65536  # bytes that are read at once
_BAUD = {int(name[1:]): getattr(termios, name) for name in dir(termios) if re.fullmatch(r"B[1-9][0-9]+", name)}
_IFLAG, _OFLAG, _CFLAG, _LFLAG, _ISPEED, _OSPEED, _CC = range(7)  # places in what termios gives


class Reader(ABC):
    """Source of readings.

    Attributes:
        ended: no more will come.
    """

    ended = False

    @abstractmethod
    def read(self) -> Iterator[Reading]:
        """Yield the readings that have come since the last call, without waiting.

        Raises:
            LatheError: what has come is no reading, or the source has failed.
        """


def _count(text: str) -> int | float:
    """Read a counter; an integer with more digits than any counter has becomes infinite, as a double."""
    return int(text) if text.lstrip("+-").isdigit() and len(text) < _LONGEST_LINE else float(text)


def _reading(text: str, unit: int, where: str) -> Reading:
    """Read a time in a unit of so many nanoseconds and a counter; ``where`` they stand, for the message."""
    found = _READING.fullmatch(text)
    try:
        if found:
            seconds = Decimal(found[1])
            if abs(seconds) * unit < _MOST_TIME:  # before 1e999999999 becomes an int
                time_ns = int(found[1]) if unit == 1 else round(seconds * unit)
                return time_ns, _count(found[2])
    except (ValueError, ArithmeticError):
        pass
    raise InputError(f"{where}: {shown(text)!r}; allowed: a time and a counter, as {next(iter(_HEADERS))}")


class CsvReader(Reader):
    """All readings of a CSV file with the header ``time_ns,counts`` or ``time_s,counts``; lines with # are left out.

    Args:
        path: of the file.

    Raises:
        InputError: the file cannot be read, or has another header; `read` names lines that are no readings.
    """

    def __init__(self, path: Path) -> None:
        lines = enumerate(read_text(path, "counts").splitlines(), 1)
        self._path = path
        self._lines = [(n, line) for n, line in lines if line.strip() and line.lstrip()[0] != "#"]
        header = self._lines[0][1].replace(" ", "") if self._lines else ""
        if header not in _HEADERS:
            raise InputError(f"{path}: header {shown(header)!r}; allowed: {' or '.join(_HEADERS)}")
        self._unit = _HEADERS[header]

    def read(self) -> Iterator[Reading]:
        """Yield all readings of the file, once."""
        for number, line in [] if self.ended else self._lines[1:]:
            yield _reading(line, self._unit, f"{self._path}:{number}")
        self.ended = True


class LineReader(Reader):
    """Readings as lines of text, a time in ns and a counter each, from a serial line, a pipe or any other file.

    Empty lines, those with #, and a header are left out.

    Args:
        stream: opened for bytes, without a buffer; its ``read`` gives None where nothing has come yet.
        name: of the stream, for messages.
        joins: whether the first line may lack its beginning, and is left out.
        waits: whether it has not ended as long as nothing has come: nobody writes to a pipe yet.
    """

    def __init__(self, stream: IO[bytes], name: str, *, joins: bool = False, waits: bool = False) -> None:
        self._stream, self._name, self._skips, self._waits = stream, name, joins, waits
        self._rest = b""

    @classmethod
    def open(cls, path: Path, baud: int) -> "LineReader":
        """Open a terminal, which gets its speed, a pipe or a file.

        Raises:
            InputError: it cannot be opened, or has no such speed.
        """
        try:
            number = os.open(path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            raise InputError(f"{path}: cannot be opened ({error.strerror}); check the path of the encoder") from None
        stream = os.fdopen(number, "rb", buffering=0)
        terminal = os.isatty(number)
        if terminal:
            _make_raw(number, path, baud)
        return cls(stream, str(path), joins=terminal, waits=stat.S_ISFIFO(os.fstat(number).st_mode))

    def close(self) -> None:
        """Close the stream."""
        self._stream.close()

    def read(self) -> Iterator[Reading]:
        """Yield the readings of the lines that are complete."""
        while not self.ended:
            try:
                data = self._stream.read(_PIECE)
            except OSError:
                data = b""  # a terminal whose other end is closed fails instead of giving nothing
            if data is None or (self._waits and not data):
                return
            self.ended, self._waits = not data, False
            *lines, self._rest = (self._rest + data).split(b"\n")
            if self.ended:
                lines, self._rest = [*lines, self._rest], b""
            for line in lines:
                if self._skips:
                    self._skips = False
                elif (text := line.decode("utf-8", "replace").strip()) and text[0] != "#" and text not in _HEADERS:
                    yield _reading(text, 1, self._name)
            if len(self._rest) > _LONGEST_LINE:
                raise InputError(
                    f"{self._name}: {len(self._rest)} bytes without an end of line; allowed: lines of text"
                )


def _make_raw(number: int, path: Path, baud: int) -> None:
    """Set a terminal to raw bytes at a speed."""
    if baud not in _BAUD:
        raise InputError(f"{path}: {baud} baud; allowed: {', '.join(map(str, sorted(_BAUD)))}")
    state = termios.tcgetattr(number)
    state[_IFLAG] = state[_OFLAG] = state[_LFLAG] = 0
    state[_CFLAG] = termios.CS8 | termios.CREAD | termios.CLOCAL
    state[_ISPEED] = state[_OSPEED] = _BAUD[baud]
    state[_CC][termios.VMIN], state[_CC][termios.VTIME] = 1, 0  # with 0, 0 nothing would look like the end
    termios.tcsetattr(number, termios.TCSANOW, state)


class CountedAngle:
    """The spindle angle of a real encoder, sample by sample.

    Sample 0 is at the first reading. Whole revolutions that the counter has made before are left out.

    Args:
        counts: in a revolution.
        step_ns: sampling step [ns].
        wraps: the counter begins anew after so many counts; 0: it does not.
        inverted: it counts down while the spindle turns forward.
        max_reverse: counts that it may go back by; the angle stands still meanwhile.
        max_gap: longest time between readings [s].

    Attributes:
        late: readings that came after a younger one, and were left out.
    """

    def __init__(
        self, *, counts: int, step_ns: int, wraps: int, inverted: bool, max_reverse: float, max_gap: float
    ) -> None:
        self._counts, self._step_ns, self._wraps = counts, step_ns, wraps
        self._sign, self._max_reverse, self._max_gap_ns = -1 if inverted else 1, max_reverse, round(max_gap * 1e9)
        self._start_ns = 0
        self._newest: Reading | None = None
        self._turned = self._highest = 0.0  # [count]
        self._times: list[float] = []  # [ns] after sample 0, of readings that have been added since
        self._angles: list[float] = []
        self._time, self._angle = np.empty(0), np.empty(0)  # those before
        self.late = 0

    @property
    def time(self) -> float:
        """Time of the newest reading after sample 0 [s]."""
        return 0.0 if self._newest is None else (self._newest[0] - self._start_ns) * 1e-9

    @property
    def angle(self) -> float:
        """Angle at the newest reading [rad]."""
        return self._highest * 2.0 * np.pi / self._counts

    @property
    def available(self) -> int:
        """Number of samples whose angle the readings give."""
        return 0 if self._newest is None else (self._newest[0] - self._start_ns) // self._step_ns + 1

    def add(self, time_ns: int, count: float) -> None:
        """Take a reading.

        Raises:
            LatheError: the last one was too long ago, the counter has gone back, or the number is none of a counter.
        """
        if not abs(count) <= _MOST_COUNT:
            raise LatheError(f"counter of {count:.6g} at {time_ns} ns; allowed: finite numbers up to 2^64")
        if self._newest is None:
            self._start_ns, self._newest = time_ns, (time_ns, count)
            self._turned = self._highest = float((count * self._sign) % self._counts)
            self._keep()
            return
        if time_ns <= self._newest[0]:
            self.late += 1
            return
        since = time_ns - self._newest[0]
        if since > self._max_gap_ns:
            raise LatheError(
                f"no counts from {self.time:.9g} to {self.time + since * 1e-9:.9g} s, for {since * 1e-6:.4g} ms; "
                f"allowed: up to max_gap = {self._max_gap_ns * 1e-6:.4g} ms"
            )
        moved = count - self._newest[1]  # of integers, before anything is rounded
        if self._wraps:
            moved = ((2 * moved + self._wraps) % (2 * self._wraps) - self._wraps) / 2
        self._newest = time_ns, count
        self._turned += moved * self._sign
        if (back := self._highest - self._turned) > self._max_reverse:
            raise LatheError(
                f"the encoder has gone back by {back:.6g} counts at {self.time:.9g} s; allowed: up to max_reverse = "
                f"{self._max_reverse:g}, a spindle that turns one way (inverted turns the sign)"
            )
        self._highest = max(self._highest, self._turned)
        self._keep()

    def go_on(self, speed: float) -> None:
        """Extrapolate the newest reading by an hour at ``speed`` [rad/s]."""
        assert self._newest is not None, "a reading has come"
        self._newest = self._newest[0] + _GOES_ON * 10**9, self._newest[1]
        self._highest += speed * _GOES_ON * self._counts / (2.0 * np.pi)
        self._keep()

    def _keep(self) -> None:
        """Store the newest reading; lists grow cheaply, and `_gather` makes arrays of them."""
        assert self._newest is not None, "a reading has come"
        self._times.append(float(self._newest[0] - self._start_ns))
        self._angles.append(self.angle)

    def _gather(self) -> None:
        """Append the stored readings to the arrays."""
        if self._times:
            self._time, self._angle = np.append(self._time, self._times), np.append(self._angle, self._angles)
            self._times, self._angles = [], []

    def take(self, first: int, samples: int) -> Array:
        """The angle [rad] of the samples ``first`` on, shape (n,), up to `available`; those before are forgotten."""
        self._gather()
        at: Array = self._step_ns * np.arange(first, first + samples, dtype=np.float64)
        if not samples:
            return at
        begin = max(int(np.searchsorted(self._time, at[0], side="right")) - 1, 0)
        self._time, self._angle = self._time[begin:], self._angle[begin:]
        # `np.interp` looks at all points that it gets: those of later samples may be a whole file.
        end = int(np.searchsorted(self._time, at[-1])) + 1
        return np.interp(at, self._time[:end], self._angle[:end])

    def reached(self, angle: float) -> int | None:
        """Return the first sample at which the angle [rad] is at least so large; None if there is none yet."""
        self._gather()
        if not self._time.size or angle > self._angle[-1]:
            return None
        place = int(np.searchsorted(self._angle, angle))
        begin, end = max(place - 1, 0), place + 1
        first = int(self._time[begin] // self._step_ns)
        last = int(self._time[place] // self._step_ns) + 1
        at = np.interp(
            self._step_ns * np.arange(first, last + 1, dtype=np.float64), self._time[begin:end], self._angle[begin:end]
        )
        # By the interpolation of `take`, sample by sample, so that both agree to the bit.
        found = first + int(np.searchsorted(at, angle))
        return found if found < self.available else None
