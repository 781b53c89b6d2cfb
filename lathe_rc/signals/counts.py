# SPDX-License-Identifier: Apache-2.0
"""Sources of encoder counts, and the spindle angle at any time between two readings.

A reading is a time [ns] and the counter value at that time. Between two readings the angle is linear.
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
Reading = tuple[int, int | float]  #: time [ns] and counter; an integer counter as int, since a double has 53 bits

_READING = re.compile(r"\s*([-+]?[0-9.eE+-]+)\s*(?:[,;]|\s)\s*([-+]?[0-9.eE+-]+)\s*")
_HEADERS = {"time_ns,counts": 1, "time_s,counts": 10**9}  # header, and nanoseconds per unit of the first column
_MOST_TIME = 2**63  # [ns], exclusive
_MOST_COUNT = 2.0**64  # largest magnitude of a counter
_LONGEST_LINE = 256
_GOES_ON = 3600  # [s] of extrapolation
_PIECE = 65536  # bytes per read
_BAUD = {int(name[1:]): getattr(termios, name) for name in dir(termios) if re.fullmatch(r"B[1-9][0-9]+", name)}
_IFLAG, _OFLAG, _CFLAG, _LFLAG, _ISPEED, _OSPEED, _CC = range(7)  # indices in the list of termios.tcgetattr


class Reader(ABC):
    """Base of sources of encoder readings.

    Attributes:
        ended: whether the source has ended.
    """

    ended = False

    @abstractmethod
    def read(self) -> Iterator[Reading]:
        """Yield the readings that have arrived since the last call, without waiting.

        Raises:
            LatheError: the received data are not a reading, or the source has failed.
        """


def _count(text: str) -> int | float:
    """Parse a counter value; an integer with more digits than any counter becomes infinite, as a double."""
    return int(text) if text.lstrip("+-").isdigit() and len(text) < _LONGEST_LINE else float(text)


def _reading(text: str, unit: int, where: str) -> Reading:
    """Parse a time, in units of ``unit`` nanoseconds, and a counter; ``where`` locates the text in error messages."""
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
    """Reader of a CSV file with the header ``time_ns,counts`` or ``time_s,counts``; ignores lines starting with #.

    Args:
        path: path of the file.

    Raises:
        InputError: the file cannot be read, or has another header; `read` raises it for malformed lines.
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
    """Reader of lines of text, with a time in ns and a counter each, from a serial line, a pipe or any other file.

    Empty lines, lines starting with #, and a header are ignored.

    Args:
        stream: opened in binary mode, unbuffered; its ``read`` returns None if no data have arrived.
        name: name of the stream, for messages.
        joins: whether the first line may be incomplete, and is ignored.
        waits: whether an empty read before the first data does not end the stream, as in a pipe without a writer.
    """

    def __init__(self, stream: IO[bytes], name: str, *, joins: bool = False, waits: bool = False) -> None:
        self._stream, self._name, self._skips, self._waits = stream, name, joins, waits
        self._rest = b""

    @classmethod
    def open(cls, path: Path, baud: int) -> "LineReader":
        """Open a terminal, whose speed is set to ``baud``, a pipe or a file.

        Raises:
            InputError: it cannot be opened, or does not support the speed.
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
        """Close the stream of readings."""
        self._stream.close()

    def read(self) -> Iterator[Reading]:
        """Yield the readings of all complete lines."""
        while not self.ended:
            try:
                data = self._stream.read(_PIECE)
            except OSError:
                data = b""  # a terminal whose other end is closed raises an error instead of returning no data
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
    """Set a terminal to raw mode and to a speed."""
    if baud not in _BAUD:
        raise InputError(f"{path}: {baud} baud; allowed: {', '.join(map(str, sorted(_BAUD)))}")
    state = termios.tcgetattr(number)
    state[_IFLAG] = state[_OFLAG] = state[_LFLAG] = 0
    state[_CFLAG] = termios.CS8 | termios.CREAD | termios.CLOCAL
    state[_ISPEED] = state[_OSPEED] = _BAUD[baud]
    state[_CC][termios.VMIN], state[_CC][termios.VTIME] = 1, 0  # with 0, 0 a read without data would look like the end
    termios.tcsetattr(number, termios.TCSANOW, state)


class CountedAngle:
    """Spindle angle at the sample times, interpolated from the readings of a real encoder.

    Sample 0 is at the first reading. Whole revolutions counted before it are ignored.

    Args:
        counts: counts per revolution.
        step_ns: sampling step [ns].
        wraps: number of counts after which the counter restarts at 0; 0: never.
        inverted: whether the counter counts down while the spindle turns forward.
        max_reverse: largest backward motion [counts]; the angle is constant during it.
        max_gap: longest time between readings [s].

    Attributes:
        late: number of ignored readings, which arrived after a more recent one.
    """

    def __init__(
        self, *, counts: int, step_ns: int, wraps: int, inverted: bool, max_reverse: float, max_gap: float
    ) -> None:
        self._counts, self._step_ns, self._wraps = counts, step_ns, wraps
        self._sign, self._max_reverse, self._max_gap_ns = -1 if inverted else 1, max_reverse, round(max_gap * 1e9)
        self._start_ns = 0
        self._newest: Reading | None = None
        self._turned = self._highest = 0.0  # [count]
        self._times: list[float] = []  # [ns] after sample 0, of readings added since the last `_gather`
        self._angles: list[float] = []
        self._time, self._angle = np.empty(0), np.empty(0)  # readings before them
        self.late = 0

    @property
    def time(self) -> float:
        """Time of the most recent reading after sample 0 [s]."""
        return 0.0 if self._newest is None else (self._newest[0] - self._start_ns) * 1e-9

    @property
    def angle(self) -> float:
        """Angle at the most recent reading [rad]."""
        return self._highest * 2.0 * np.pi / self._counts

    @property
    def available(self) -> int:
        """Number of samples for which the readings determine the angle."""
        return 0 if self._newest is None else (self._newest[0] - self._start_ns) // self._step_ns + 1

    def add(self, time_ns: int, count: float) -> None:
        """Add a reading of the encoder.

        Raises:
            LatheError: the last reading was too long ago, the counter has moved back too far, or the value is invalid.
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
        moved = count - self._newest[1]  # between integers, before any rounding
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
        """Extrapolate the most recent reading by an hour at ``speed`` [rad/s]."""
        assert self._newest is not None, "a reading has come"
        self._newest = self._newest[0] + _GOES_ON * 10**9, self._newest[1]
        self._highest += speed * _GOES_ON * self._counts / (2.0 * np.pi)
        self._keep()

    def _keep(self) -> None:
        """Append the most recent reading to lists, which is faster than appending to arrays (see `_gather`)."""
        assert self._newest is not None, "a reading has come"
        self._times.append(float(self._newest[0] - self._start_ns))
        self._angles.append(self.angle)

    def _gather(self) -> None:
        """Move the stored readings from lists to arrays."""
        if self._times:
            self._time, self._angle = np.append(self._time, self._times), np.append(self._angle, self._angles)
            self._times, self._angles = [], []

    def take(self, first: int, samples: int) -> Array:
        """Return angles [rad] of samples starting at ``first``, below `available`, shape (n,); drop old readings."""
        self._gather()
        at: Array = self._step_ns * np.arange(first, first + samples, dtype=np.float64)
        if not samples:
            return at
        begin = max(int(np.searchsorted(self._time, at[0], side="right")) - 1, 0)
        self._time, self._angle = self._time[begin:], self._angle[begin:]
        # `np.interp` checks all given points, and those of later samples may be a whole file.
        end = int(np.searchsorted(self._time, at[-1])) + 1
        return np.interp(at, self._time[:end], self._angle[:end])

    def reached(self, angle: float) -> int | None:
        """Return the first sample at which the angle [rad] is at least ``angle``; None if there is none yet."""
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
        # With the interpolation of `take`, so that both give bit-identical results.
        found = first + int(np.searchsorted(at, angle))
        return found if found < self.available else None
