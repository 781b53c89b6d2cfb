# SPDX-License-Identifier: Apache-2.0
"""Sources of encoder counts, and the spindle angle at any time between two readings.

A reading is a time [ns], the counter value at that time and, from some encoders, the time of its last edge (see
`lathe_machine.signals.edge_time`). Between two readings the angle is linear.
"""

import math
import os
import re
import stat
from abc import ABC, abstractmethod
from collections.abc import Iterator
from decimal import Decimal
from itertools import zip_longest
from pathlib import Path
from typing import IO

import numpy as np

from lathe_machine.signals.edge_time import COUNT, STAMP, edge_table, pass_edge, passed
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.signals.quantities import rank, unit_of
from lathe_rc.signals.table import TextTable

#: time [ns], counter and, with edge times, that of the last edge [ns]; an integer counter as int, for all its digits
Reading = tuple[int, int | float] | tuple[int, int | float, int]

_NUMBER = r"\s*([-+]?[0-9.eE+-]+)\s*"
_READING = re.compile(rf"{_NUMBER}(?:[,;]|\s){_NUMBER}(?:(?:[,;]|\s){_NUMBER})?")
_PLAIN = ("time_ns,counts", "time_s,counts")  # headers of lines
_TIMED = ("time_ns,counts,edge_ns", "time_s,counts,edge_s")  # with the time of the counter's last edge
_NANOSECONDS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "sec": 10**9}
_OTHER_COLUMNS = re.compile(r"(?P<what>counts|(?:edge|index)(?=_))(?:_(?P<unit>ns|us|ms|s|counts))?")
_MOST_TIME = 2**63  # [ns], exclusive
MOST_COUNT = 2.0**64  #: largest magnitude of a counter
_LONGEST_LINE = 256
_GOES_ON = 3600  # [s] of extrapolation
_FASTEST = 2.0  # highest expected speed, relative to the nominal one
_COUNTER_BITS = range(8, 49)  # of a counter that begins anew
_PIECE = 65536  # bytes per read
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


def _time_ns(text: str, unit: int) -> int:
    """Parse a time in units of ``unit`` nanoseconds; raises ValueError or ArithmeticError."""
    time = Decimal(text)
    if not abs(time) * unit < _MOST_TIME:  # before 1e999999999 becomes an int
        raise ValueError
    return int(text) if unit == 1 else round(time * unit)


def _reading(text: str, unit: int, where: str, *, edge_unit: int) -> Reading:
    """Parse a reading with a time in units of ``unit`` nanoseconds.

    Args:
        text: a time, a counter and, with an ``edge_unit``, the time of its last edge.
        unit: unit of the time [ns].
        where: place of the text, for error messages.
        edge_unit: unit of the time of the edge [ns]; 0: there is none.
    """
    found, timed = _READING.fullmatch(text), bool(edge_unit)
    try:
        if found and bool(found[3]) == timed:
            time_ns, count = _time_ns(found[1], unit), _count(found[2])
            return (time_ns, count, _time_ns(found[3], edge_unit)) if timed else (time_ns, count)
    except (ValueError, ArithmeticError):
        pass
    what = "a time, a counter and the time of its last edge" if timed else "a time and a counter"
    raise InputError(f"{where}: {shown(text)!r}; allowed: {what}, as {(_TIMED if timed else _PLAIN)[0]}")


class CsvReader(Reader):
    """Reader of a text table (see `lathe_rc.signals.table`) with columns ``time_ns`` or ``time_s``, and ``counts``.

    Columns ``edge_ns`` or ``edge_s`` have the times of the last edges. A column ``index_counts`` has the counter at the
    newest index pulse, and ``index_ns`` or ``index_s`` the time of this pulse; it is empty before the first pulse.

    Args:
        path: path of the file.

    Attributes:
        timed: whether the file has the times of the last edges.
        index: kind of the index column, ``counts`` or a unit of time; empty without one.
        pulses: place among the readings of the first one after each index pulse, and counter or time [ns] of the
            pulse.
        numbers: line numbers of the readings.

    Raises:
        InputError: the file cannot be read, or has another header; `read` raises it for malformed lines.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        table = TextTable(path, _column)
        columns: dict[str, str] = {}
        units: dict[str, str] = {}
        for name, below in zip_longest(table.names, table.units, fillvalue=""):
            what, unit = _column(name) or ("", "")
            if what in columns:
                raise InputError(f"{path}: {columns[what]!r} and {name!r} are both {what}; allowed: one of them")
            if what:
                columns[what], units[what] = name, unit or below
        self._units = {what: _NANOSECONDS.get(unit, 0) for what, unit in units.items()}
        if "counts" not in units or not self._units.get("time") or not self._units.get("edge", 1):
            raise InputError(
                f"{path}: columns {shown(', '.join(table.names))!r}; allowed: {' or '.join(_PLAIN)}, and edge_ns or "
                "edge_s for the times of edges, and index_counts, index_ns or index_s for index pulses"
            )
        self.timed, self.index = "edge" in units, units.get("index", "")
        self.pulses: list[tuple[int, int | float]] = []
        self._fields = [what for what in ("time", "counts", "edge", "index") if what in columns]
        self._rows = table.texts([columns[what] for what in self._fields])
        if not self._rows:
            raise InputError(f"{path}: no rows below its header; allowed: readings of a time and a counter")
        self._ends, self.numbers = table.ends, [line for line, _ in self._rows]

    def read(self) -> Iterator[Reading]:
        """Yield all readings of the file, once."""
        for place, (line, fields) in enumerate([] if self.ended else self._rows):
            where, reading = f"{self._path}:{line}", fields[: 2 + self.timed]
            try:
                if self.index and fields[-1]:
                    self._add_pulse(place, fields[-1], where)
                yield _reading(",".join(reading), self._units["time"], where, edge_unit=self._units.get("edge", 0))
            except InputError as error:
                raise InputError(f"{error}{self.torn(place)}") from None
        self.ended = True

    def torn(self, place: int) -> str:
        """Return a remark on the last line if it is that of a reading and has no end; otherwise an empty text."""
        last = place == len(self._rows) - 1 and not self._ends
        return " (the last line has no end: torn? remove it)" if last else ""

    def _add_pulse(self, place: int, text: str, where: str) -> None:
        """Append an index pulse if the column shows another one than before."""
        try:
            pulse = _count(text) if self.index == "counts" else _time_ns(text, self._units["index"])
        except (ValueError, ArithmeticError):
            raise InputError(f"{where}: index_{self.index} = {shown(text)!r}; allowed: a number, or nothing") from None
        if not self.pulses or pulse != self.pulses[-1][1]:
            self.pulses.append((place, pulse))


def _column(name: str) -> tuple[str, str] | None:
    """Return what a column of a file has, ``time``, ``counts``, ``edge`` or ``index``, and its unit; None: neither."""
    if rank("time", name):
        return "time", unit_of("time", name) or ""
    found = _OTHER_COLUMNS.fullmatch(name.casefold())
    return (found["what"], found["unit"] or "") if found else None


class LineReader(Reader):
    """Reader of lines of text, with a time in ns and a counter each, from a serial line, a pipe or any other file.

    Empty lines, lines starting with #, and a header are ignored.

    Args:
        stream: opened in binary mode, unbuffered; its ``read`` returns None if no data have arrived.
        name: name of the stream, for messages.
        joins: whether the first line may be incomplete, and is ignored.
        waits: whether an empty read before the first data does not end the stream, as in a pipe without a writer.
        timed: whether a line ends with the time of the counter's last edge [ns].
    """

    def __init__(
        self, stream: IO[bytes], name: str, *, joins: bool = False, waits: bool = False, timed: bool = False
    ) -> None:
        self._stream, self._name, self._skips, self._waits, self._timed = stream, name, joins, waits, timed
        self._rest = b""

    @classmethod
    def open(cls, path: Path, baud: int, *, timed: bool = False) -> "LineReader":
        """Open a terminal, whose speed is set to ``baud``, a pipe or a file; ``timed``: with the times of edges.

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
        return cls(stream, str(path), joins=terminal, waits=stat.S_ISFIFO(os.fstat(number).st_mode), timed=timed)

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
                elif (
                    (text := line.decode("utf-8", "replace").strip()) and text[0] != "#" and text not in _PLAIN + _TIMED
                ):
                    yield _reading(text, 1, self._name, edge_unit=int(self._timed))
            if len(self._rest) > _LONGEST_LINE:
                raise InputError(
                    f"{self._name}: {len(self._rest)} bytes without an end of line; allowed: lines of text"
                )


def _make_raw(number: int, path: Path, baud: int) -> None:
    """Set a terminal to raw mode and to a speed."""
    import termios  # which Windows lacks

    speeds = {int(name[1:]): getattr(termios, name) for name in dir(termios) if re.fullmatch(r"B[1-9][0-9]+", name)}
    if baud not in speeds:
        raise InputError(f"{path}: {baud} baud; allowed: {', '.join(map(str, sorted(speeds)))}")
    state = termios.tcgetattr(number)
    state[_IFLAG] = state[_OFLAG] = state[_LFLAG] = 0
    state[_CFLAG] = termios.CS8 | termios.CREAD | termios.CLOCAL
    state[_ISPEED] = state[_OSPEED] = speeds[baud]
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
        max_forward: largest angle by which the counter may run ahead of a spindle at twice the nominal speed [rad].
        max_gap: longest time between readings [s].
        edge_clock: resolution of the times of edges [s].
        nominal_speed: nominal speed of the spindle [rad/s]; also that from the first reading to the next edge, with
            times of edges. 0: not known, and nothing runs ahead.

    Attributes:
        zero: counts turned from the first reading to the one at which the angle is 0; None: the counter's own 0.
        late: number of ignored readings, which arrived after a more recent one.
    """

    def __init__(
        self,
        *,
        counts: int,
        step_ns: int,
        wraps: int,
        inverted: bool,
        max_reverse: float,
        max_gap: float,
        max_forward: float = 0.1,
        edge_clock: float = 0.0,
        nominal_speed: float = 0.0,
    ) -> None:
        self._counts, self._step_ns, self._wraps = counts, step_ns, wraps
        self._sign, self._max_reverse, self._max_gap_ns = -1 if inverted else 1, max_reverse, round(max_gap * 1e9)
        self._start_ns = 0
        self._newest: tuple[int, int | float] | None = None
        self._turned = self._highest = self._reached = 0.0  # [count], the last with the part of a count since its edge
        self._rate = nominal_speed * counts / (2.0 * np.pi) * _FASTEST * 1e-9  # [count/ns], the highest expected
        self._max_ahead = max_forward * counts / (2.0 * np.pi)
        self._ahead = 0.0  # counts beyond those of the highest expected speed
        self._changed_ns = 0  # time of the reading at which the counter has changed last
        self._older = 0.0  # turned counts at the reading before the newest one
        self.zero: float | None = None
        self._edges = edge_table(edge_clock, 0.0, 0.0, nominal_speed * counts / (2.0 * np.pi))
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
        return self._reached * 2.0 * np.pi / self._counts

    @property
    def available(self) -> int:
        """Number of samples for which the readings determine the angle."""
        return 0 if self._newest is None else (self._newest[0] - self._start_ns) // self._step_ns + 1

    def add(self, time_ns: int, count: float, edge_ns: int | None = None) -> None:
        """Add a reading of the encoder: its time [ns], the counter and, if known, the time of its last edge [ns].

        Raises:
            LatheError: the last reading was too long ago, the counter has moved back or ahead too far, or a value is
                invalid.
        """
        if not abs(count) <= MOST_COUNT:
            raise LatheError(f"counter of {count:.6g} at {time_ns} ns; allowed: finite numbers up to 2^64")
        if edge_ns is not None and edge_ns > time_ns:
            raise LatheError(f"last edge at {edge_ns} ns in a reading at {time_ns} ns; allowed: not after the reading")
        before = self._newest
        if before is None:
            self._start_ns, self._newest, self._changed_ns = time_ns, (time_ns, count), time_ns
            self._turned = (count * self._sign if self.zero is None else -self.zero) % self._counts
            self._turned = self._highest = self._older = float(self._turned)
            if edge_ns is not None:
                self._edges.last[[STAMP, COUNT]] = (edge_ns - time_ns) * 1e-9, self._turned
            self._keep(edge_ns)
            return
        if time_ns <= before[0]:
            self.late += 1
            return
        since = time_ns - before[0]
        if since > self._max_gap_ns:
            raise LatheError(
                f"no counts from {self.time:.9g} to {self.time + since * 1e-9:.9g} s, for {since * 1e-6:.4g} ms; "
                f"allowed: up to max_gap = {self._max_gap_ns * 1e-6:.4g} ms"
            )
        moved = count - before[1]  # between integers, before any rounding
        if self._wraps:
            moved = ((2 * moved + self._wraps) % (2 * self._wraps) - self._wraps) / 2
        self._newest = time_ns, count
        self._turn(moved * self._sign, before[0])
        if edge_ns is not None and self._turned > self._highest:
            # The edge of a new count comes after the reading before; both times are rounded to nanoseconds.
            least = before[0] - math.ceil(self._edges.clock * 1e9) - 1
            if edge_ns < least:
                raise LatheError(
                    f"last edge at {edge_ns} ns of a count that had not come at {before[0]} ns; allowed: from {least} "
                    f"ns on (times of edges by the clock and in the unit of the readings, edge_clock = "
                    f"{self._edges.clock:g} s)"
                )
        self._highest = max(self._highest, self._turned)
        self._keep(edge_ns)

    def _turn(self, moved: float, before_ns: int) -> None:
        """Turn the angle by counts since the reading before, which came at ``before_ns``.

        Raises:
            LatheError: the counter has moved back or ahead too far.
        """
        assert self._newest is not None, "a reading has come"
        time_ns, older = self._newest[0], self._older
        self._older = self._turned
        self._turned += moved
        if (back := self._highest - self._turned) > self._max_reverse:
            raise LatheError(self._gone_back(back, -moved, before_ns, spike=self._turned > older))
        if moved > 0.0 and self._rate:
            self._ahead = max(self._ahead + moved - self._rate * (time_ns - self._changed_ns), 0.0)
            if self._ahead > self._max_ahead:
                most = self._max_ahead * 2.0 * np.pi / self._counts
                raise LatheError(
                    f"the counter runs ahead by {moved:.6g} counts from {self._seconds(before_ns)} to "
                    f"{self.time:.9g} s; allowed: max_forward = {most:g} rad more than at {_FASTEST:g} times "
                    "nominal_rpm (a reading that stands out, a counter that was set, stamps in bursts, or another "
                    "counts_per_revolution)"
                )
        if moved:
            self._changed_ns = time_ns

    def _seconds(self, time_ns: int) -> str:
        return f"{(time_ns - self._start_ns) * 1e-9:.9g}"

    def _gone_back(self, back: float, moved: float, before_ns: int, *, spike: bool) -> str:
        """Describe a counter that has gone back, and what may have caused it.

        Args:
            back: counts from the highest reading back.
            moved: counts from the reading before back.
            before_ns: time of the reading before [ns].
            spike: whether the counter has risen since the reading before that one.
        """
        assert self._newest is not None, "a reading has come"
        time_ns, count = self._newest
        if spike:
            return (
                f"the counter jumps ahead at {self._seconds(before_ns)} s and back by {moved:.6g} counts at "
                f"{self.time:.9g} s: the first of these readings stands out; allowed: a spindle that turns one way"
            )
        said = f"the encoder has gone back by {back:.6g} counts at {self.time:.9g} s; allowed: up to max_reverse = "
        most = self._max_ahead + self._rate * (time_ns - before_ns)
        for turn in (self._counts, *(2**bits for bits in _COUNTER_BITS)):
            if turn != self._wraps and moved > turn / 2.0 and -self._max_reverse <= turn - moved <= most:
                often = ", by its index?" if turn == self._counts else ""
                return f"{said}{self._max_reverse:g} (a counter that begins anew{often}: counter_range = {turn})"
        if 0.0 <= count * self._sign <= most < moved:
            return f"{said}{self._max_reverse:g} (the counter was zeroed or set: begin the file after it)"
        return f"{said}{self._max_reverse:g}, a spindle that turns one way (inverted turns the sign)"

    def go_on(self, speed: float) -> None:
        """Extrapolate the most recent reading by an hour at ``speed`` [rad/s]."""
        assert self._newest is not None, "a reading has come"
        self._newest = self._newest[0] + _GOES_ON * 10**9, self._newest[1]
        self._highest += speed * _GOES_ON * self._counts / (2.0 * np.pi)
        self._keep(None)

    def _keep(self, edge_ns: int | None) -> None:
        """Append the most recent reading to lists, which is faster than appending to arrays (see `_gather`)."""
        assert self._newest is not None, "a reading has come"
        self._reached = self._highest
        if edge_ns is not None:
            if self._highest > self._edges.last[COUNT]:  # a counter that trembles passes its edge again, later
                pass_edge(self._edges, (edge_ns - self._start_ns) * 1e-9, self._highest)
            self._reached += passed(self._edges, self.time)
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
