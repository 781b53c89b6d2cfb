# SPDX-License-Identifier: Apache-2.0
"""Measurements by quantity, in SI units, from CSV, Parquet, MATLAB, TDMS and MDF files.

All commands that read measurements use one format of columns. A column is named by its quantity, with its unit after
it: ``time_ms``, ``time [ms]``, ``command_um``, ``response``, ``frequency_hz``. Without a unit in its name it has the
unit that the file states for it, otherwise the SI unit; records of parts need a unit. A mapping of columns gives names
and units that differ.
"""

import csv
import re
import shlex
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc import extras, files
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.signals import table

_LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "in": 25.4e-3}
_LENGTH = {**_LENGTHS, "": 1.0, "1": 1.0}
_RATIO = {"": 1.0, "1": 1.0, "%": 1e-2, "pct": 1e-2}
_DECIBEL = "db"
_TURN = 2.0 * np.pi

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "": 1.0},
    "command": _LENGTH,
    "response": _LENGTH,
    "displacement": _LENGTH,
    "frequency": {"hz": _TURN, "khz": 1e3 * _TURN, "rad/s": 1.0, "rad_s": 1.0, "": _TURN},
    "magnitude": {**_RATIO, _DECIBEL: 1.0},
    "phase": {"deg": np.pi / 180.0, "°": np.pi / 180.0, "rad": 1.0, "": np.pi / 180.0},
    "real": _RATIO,
    "imaginary": _RATIO,
    "coherence": _RATIO,
    "relative_uncertainty": _RATIO,
    "state": {"": 1.0, "1": 1.0},
    "angle": {"deg": _TURN / 360.0, "°": _TURN / 360.0, "rad": 1.0, "rev": _TURN},
    "radius": _LENGTHS,
    "height": _LENGTHS,
    "revolution": {"": 1.0, "1": 1.0},
}  #: factors to SI units [s, m, rad/s, 1, rad] by quantity and unit; "": no unit known
_NAMED = re.compile(r"\s*(?P<name>.*?)(?:[\s_]*[\[(]\s*(?P<bracket>[^\])]*?)\s*[\])])?\s*")
_LONGEST_HEADER = 2**20  # [B]
_SAME_START = 1e-8  # [s] two columns that begin within it begin together
_MISSING = ("", "nan")  # texts of a value that was not measured
_MOST_COLUMNS = 12  # that an error message lists


@contextmanager
def _readable(what: str) -> Iterator[None]:
    """Report the errors of the libraries that read a damaged file as one line, which begins with ``what``."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the libraries warn of what they ignore in a file
            yield
    except LatheError:
        raise
    except Exception as error:  # noqa: BLE001 - the libraries can raise any exception on damaged bytes
        raise InputError(f"{what} ({shown(error)})") from None


class Clock(NamedTuple):
    """Sampling of a column of a file that states it: time of the first value and step [s]."""

    start: float
    step: float


class Source(ABC):
    """Opened measurement: columns by name.

    Attributes:
        units: unit by column, in the order of the file; empty if the file states none.
    """

    units: Mapping[str, str]

    @abstractmethod
    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        """Return columns by name, shape (n,) each; ``gaps``: those in which a missing value is NaN."""

    def clock(self, name: str) -> Clock | None:
        """Return the sampling of a column; None if the file does not state it."""
        return None

    def start(self, name: str) -> float | None:
        """Return the time of the first value of a column [s]; None if the file does not state it."""
        clock = self.clock(name)
        return clock.start if clock else None


class Mapped(NamedTuple):
    """Column of a quantity as a user names it; an empty unit: that of the column."""

    column: str
    unit: str


def parse_mapping(given: Iterable[str]) -> dict[str, Mapped]:
    """Parse ``QUANTITY=COLUMN[:UNIT]``; the unit may be a number, the SI value of 1.

    Raises:
        InputError: the text has another form, the quantity or the unit is unknown, or a quantity is given twice.
    """
    mapping: dict[str, Mapped] = {}
    for text in given:
        quantity, equals, column = text.partition("=")
        if not equals or quantity not in UNITS or not column:
            raise InputError(f"--column {text!r}; allowed: QUANTITY=COLUMN[:UNIT], QUANTITY of {', '.join(UNITS)}")
        if quantity in mapping:
            raise InputError(f"--column {text!r}: {quantity} is given twice; allowed: once")
        name, colon, unit = column.rpartition(":")
        if not colon:
            name, unit = column, ""
        elif _factor(quantity, unit) is None:
            known = ", ".join(unit for unit in UNITS[quantity] if unit)
            raise InputError(
                f"--column {text!r}: no unit {unit!r} of {quantity}; allowed: {known}, or a number, the SI value of 1"
            )
        mapping[quantity] = Mapped(name, unit)
    return mapping


def _plain(unit: str) -> str:
    """Return a unit in the spelling of `UNITS`."""
    return unit.strip().replace("µ", "u").replace("μ", "u").casefold()


def _factor(quantity: str, unit: str) -> float | None:
    """Return the SI value of 1 in a unit: one of `UNITS` or a number; None for another text."""
    found = UNITS[quantity].get(_plain(unit))
    if found is None:
        try:
            found = float(unit)
        except ValueError:
            return None
    return found if np.isfinite(found) and found else None


def _unit_of(quantity: str, column: str) -> str | None:
    """Return the unit in the name of a column, ``NAME_UNIT`` or ``NAME [UNIT]``; None if it has none."""
    match = _NAMED.fullmatch(column)
    if match and match["bracket"] is not None:
        return match["bracket"] if re.search("[^\\W\\d]|[%°]", match["bracket"]) else None  # "[2]" is no unit
    known = sorted((unit for unit in UNITS[quantity] if unit and unit != "1"), key=len, reverse=True)
    return next((unit for unit in known if _plain(column).endswith(f"_{unit}")), None)


def _is_of(quantity: str, column: str) -> bool:
    """Return whether a column is named by a quantity, with or without its unit."""
    match = _NAMED.fullmatch(column)
    name = _plain(match["name"] if match else column).replace(" ", "_")
    return name == quantity or any(name == f"{quantity}_{unit}" for unit in UNITS[quantity] if unit)


def even_clock(time: Array, what: str, cure: str = "resample the record") -> Clock:
    """Return start and step of evenly spaced times.

    Args:
        time: times [s], shape (n,), n at least 2.
        what: description of the times for error messages.
        cure: remedy for times that are not even.

    Raises:
        InputError: the times are not even.
    """
    if time.size < 2:
        raise InputError(f"{what}: {time.size} samples; allowed: 2 or more")
    step = float(time[-1] - time[0]) / (time.size - 1)
    off = np.abs(time - (time[0] + step * np.arange(time.size)))
    if step <= 0.0 or off.max() > 0.1 * step:
        at = int(off.argmax())
        raise InputError(
            f"{what}: not in even steps, {time[at]:.9g} s at sample {at} is {off[at]:.3g} s off; allowed: even steps "
            f"({cure})"
        )
    return Clock(float(time[0]), step)


class Measurement:
    """Quantities of a measurement, in SI units.

    Args:
        name: path of the measurement, for error messages.
        source: its columns.
        mapping: columns of quantities that are not named by them.

    Raises:
        InputError: a column of the mapping does not exist.
    """

    def __init__(self, name: str, source: Source, mapping: Mapping[str, Mapped]) -> None:
        self.name, self._source = name, source
        self._columns: dict[str, Mapped] = {}
        self._doubles: dict[str, list[str]] = {}  # columns that are named by the same quantity
        for quantity, (column, unit) in mapping.items():
            if column not in source.units:
                raise InputError(f"--column {quantity}={column}: {name} has no such column; it has {self._listed()}")
            self._columns[quantity] = Mapped(column, unit)
        for quantity in UNITS.keys() - mapping.keys():
            fitting = [column for column in source.units if _is_of(quantity, column)]
            if fitting:
                self._columns[quantity] = Mapped(fitting[0], "")
            if len(fitting) > 1:
                self._doubles[quantity] = fitting

    def _listed(self) -> str:
        names = list(self._source.units)
        more = f" and {len(names) - _MOST_COLUMNS} more" if len(names) > _MOST_COLUMNS else ""
        return (", ".join(map(repr, names[:_MOST_COLUMNS])) or "no columns of numbers") + more

    def __contains__(self, quantity: str) -> bool:
        """Return whether the measurement has a quantity."""
        return quantity in self._columns

    def lacking(self, allowed: str) -> InputError:
        """Return the error for a measurement without the required quantities; ``allowed`` names these."""
        return InputError(
            f"{self.name}: columns {self._listed()}; allowed: {allowed} (name others by --column QUANTITY=COLUMN:UNIT)"
        )

    def read(self, *quantities: str, gaps: Collection[str] = ()) -> list[npt.NDArray[Any]]:
        """Return quantities in SI units [s, m, rad/s, 1, rad], shape (n,) each; complex where the file has them so.

        Args:
            quantities: quantities to read.
            gaps: those that may be missing in some rows, which are NaN.

        Raises:
            InputError: a column has no finite numbers, its unit is unknown, two columns are named by a quantity, the
                lengths or the times of the first values differ, or the file is damaged.
        """
        for quantity in self._doubles.keys() & set(quantities):
            one, other, *_ = self._doubles[quantity]
            raise InputError(
                f"{self.name}: {one!r} and {other!r} are both {quantity}; allowed: one (--column {quantity}={one})"
            )
        columns = {quantity: self._columns[quantity] for quantity in quantities}
        self._check_starts([column for column, _ in columns.values()])
        with _readable(self._damaged()):
            missing = {columns[quantity].column for quantity in gaps}
            arrays = self._source.read(list(dict.fromkeys(column for column, _ in columns.values())), missing)
        found = []
        for quantity, (column, unit) in columns.items():
            array = np.asarray(arrays[column])
            if array.dtype.kind not in "fiuc" or array.ndim != 1:
                raise InputError(f"{self.name}: column {column!r} holds no numbers in a row; name another column")
            array = array.astype(np.complex128 if array.dtype.kind == "c" else np.float64, copy=False)
            wrong = np.flatnonzero(np.isinf(array) if quantity in gaps else ~np.isfinite(array))
            if wrong.size:
                raise InputError(
                    f"{self.name}: {column!r} is {array[wrong[0]]} in row {wrong[0] + 1}; allowed: finite numbers"
                )
            found.append(self._in_si(quantity, column, unit, array))
        sizes = [array.size for array in found]
        if len(set(sizes)) > 1:
            lengths = ", ".join(f"{size} of {name}" for name, size in zip(quantities, sizes, strict=True))
            raise InputError(f"{self.name}: {lengths}; allowed: as many of each")
        return found

    def _check_starts(self, columns: Sequence[str]) -> None:
        """Check that columns begin at the same time, as far as the file states times."""
        with _readable(self._damaged()):
            starts = [(column, start) for column in columns if (start := self._source.start(column)) is not None]
        for column, start in starts[1:]:
            if (late := abs(start - starts[0][1])) > _SAME_START:
                raise InputError(
                    f"{self.name}: {starts[0][0]!r} and {column!r} begin at different times, {late:.6g} s apart; cut "
                    "both alike"
                )

    def negative(self, quantity: str) -> str:
        """Return the option that reads a quantity with the other sign."""
        column, unit = self._columns[quantity]
        factor = _factor(quantity, unit or self._unit(quantity, column))
        return "--column " + shlex.quote(f"{quantity}={column}:{-(factor or 1.0):.9g}")

    def swapped(self, one: str, other: str) -> str:
        """Return the options that exchange two quantities."""
        pairs = ((one, other), (other, one))
        return " ".join("--column " + shlex.quote(f"{to}={self._columns[of].column}") for to, of in pairs)

    def _unit(self, quantity: str, column: str) -> str:
        named = (
            None if column.startswith("/") else _unit_of(quantity, column)
        )  # the brackets of a topic hold an element
        return named if named is not None else self._source.units[column]

    def _damaged(self) -> str:
        return f"{self.name}: damaged after its header; record or copy it again"

    def _in_si(self, quantity: str, column: str, unit: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
        unit = unit or self._unit(quantity, column)
        factor = _factor(quantity, unit)
        if factor is None:
            known = ", ".join(each for each in UNITS[quantity] if each)
            has = f"the unit {shown(unit)!r}" if unit else "no unit"
            raise InputError(
                f"{self.name}: column {column!r} has {has}; allowed for {quantity}: {known} (or the "
                f"SI value of 1, --column {quantity}={column}:NUMBER)"
            )
        if _plain(unit) == _DECIBEL:
            return np.asarray(10.0 ** (array / 20.0))
        return array if factor == 1.0 else array * factor

    def clock(self, rate: float | None, *quantities: str) -> Clock:
        """Return the common sampling of quantities: of ``rate`` [Hz], the column of the time, or stated by the file.

        Raises:
            InputError: nothing states it, ``rate`` and a column do, it is not even, or it differs between the
                quantities.
        """
        columns = [self._columns[quantity].column for quantity in quantities]
        self._check_starts(columns)
        with _readable(self._damaged()):
            stated = [(column, clock) for column in columns if (clock := self._source.clock(column)) is not None]
        for column, clock in stated[1:]:
            if abs(clock.step - stated[0][1].step) > 1e-6 * clock.step:
                raise InputError(f"{self.name}: {stated[0][0]!r} and {column!r} are sampled differently; resample one")
        if rate is not None and ("time" in self or stated):
            what = f"times in {self._columns['time'].column!r}" if "time" in self else "sampling that the file states"
            raise InputError(f"{self.name}: --rate {rate:g} beside the {what}; leave --rate out")
        if rate is not None:
            return Clock(0.0, 1.0 / rate)
        if "time" in self:
            cure = "resample the record, or give --rate and no column of the time"
            return even_clock(self.read("time")[0], f"{self.name}: time", cure)
        if not stated:
            raise InputError(f"{self.name}: no time; give --rate HZ, or a column by --column time=COLUMN:UNIT")
        if lacking := [column for column in columns if column not in dict(stated)]:
            raise InputError(f"{self.name}: {stated[0][0]!r} has times and {lacking[0]!r} none; resample one")
        return stated[0][1]


# --- formats


class _Csv(Source):
    """CSV file in any dialect (see `lathe_rc.signals.table`); lines that start with # are comments."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with open(path, "rb", opener=files.open_file) as stream:
                self._encoding = table.encoding(stream.read(_LONGEST_HEADER), path)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
        self._skipped, header, first = self._beginning()
        self._delimiter = table.delimiter_of(header)
        self._decimal = "," if self._delimiter != "," and "," in first else "."
        names = next(csv.reader([header], delimiter=self._delimiter), [])
        self._names = [name.strip() for name in names]
        doubles = [name for name in self._names if self._names.count(name) > 1]
        if doubles:
            raise InputError(f"{path}: two columns {doubles[0]!r}; allowed: each name once")
        self.units = dict.fromkeys(self._names, "")

    def _lines(self) -> Iterator[tuple[int, str]]:
        """Yield the lines that are not empty or comments, with their numbers from 1."""
        try:
            with open(self._path, encoding=self._encoding, newline=None, opener=files.open_file) as stream:
                number = 0
                while line := stream.readline(_LONGEST_HEADER):
                    number += 1
                    if line.strip() and line.lstrip()[0] != "#":
                        yield number, line.rstrip("\n")
        except UnicodeDecodeError:
            raise table.not_text(self._path) from None

    def _beginning(self) -> tuple[int, str, str]:
        """Return the number of lines up to the header, the header, and the line after it."""
        lines = self._lines()
        skipped, header = next(lines, (0, ""))
        return skipped, header, next(lines, (0, ""))[1]

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        options = {
            "read_options": arrow_csv.ReadOptions(
                column_names=self._names, skip_rows=self._skipped, encoding=self._encoding.removesuffix("-sig")
            ),
            "parse_options": arrow_csv.ParseOptions(delimiter=self._delimiter),
            "convert_options": arrow_csv.ConvertOptions(
                include_columns=list(names),
                column_types=dict.fromkeys(names, pa.float64()),
                decimal_point=self._decimal,
            ),
        }
        try:
            found = arrow_csv.read_csv(self._path, **options)
        except pa.ArrowInvalid:  # comments among the rows, or an error whose line only the second reading knows
            return self._read_by_line(names, gaps)
        arrays = {name: found.column(name).to_numpy() for name in names}
        if not all(np.isfinite(array).all() for array in arrays.values()):
            return self._read_by_line(names, gaps)
        return arrays

    def _read_by_line(self, names: Sequence[str], gaps: Collection[str]) -> Mapping[str, Array]:
        """Read the columns line by line; errors name the line."""
        places = [self._names.index(name) for name in names]
        lines = self._lines()
        next(lines)
        found = []
        for line, row in table.rows(lines, self._path, self._delimiter):
            table.check_width(self._path, line, len(row), len(self._names))
            found.append(
                [
                    np.nan
                    if name in gaps and row[place].strip().casefold() in _MISSING
                    else table.number(table.pointed(row[place], self._delimiter), self._path, line)
                    for name, place in zip(names, places, strict=True)
                ]
            )
        return dict(zip(names, np.array(found).reshape(-1, len(names)).T, strict=True))


class _Parquet(Source):
    """Parquet file; the metadata ``unit`` of a field is the unit of the column."""

    def __init__(self, path: Path) -> None:
        from pyarrow import parquet

        self._file = parquet.ParquetFile(path)
        schema = self._file.schema_arrow
        self.units = {field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in schema}

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        table = self._file.read(columns=list(names))
        return {name: table.column(name).to_numpy() for name in names}


class _Mat(Source):
    """MATLAB file; a field of a structure is ``NAME.FIELD``; a field ``time`` states the sampling of its structure."""

    def __init__(self, path: Path) -> None:
        try:
            variables = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
        except NotImplementedError:
            raise InputError(f"{path}: MATLAB 7.3; allowed: up to 7 (save it with '-v7' in MATLAB)") from None
        self._arrays: dict[str, npt.NDArray[Any]] = {}
        for name, value in variables.items():
            if not name.startswith("__"):
                self._collect(name, value)
        self.units = dict.fromkeys(self._arrays, "")

    def _collect(self, name: str, value: Any) -> None:
        if hasattr(value, "_fieldnames"):
            for field in value._fieldnames:  # noqa: SLF001 - the documented way to list the fields
                self._collect(f"{name}.{field}", getattr(value, field))
        elif isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "fiuc":
            self._arrays[name] = value

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        return {name: self._arrays[name] for name in names}

    def _time(self, name: str) -> Array | None:
        """Return the times beside a field [s]; None if there are none."""
        structure = name
        while structure := structure.rpartition(".")[0]:
            for field, time in self._arrays.items():
                place, _, last = field.rpartition(".")
                if place == structure and _is_of("time", last) and time.size == self._arrays[name].size:
                    return time * (_factor("time", _unit_of("time", last) or "") or 1.0)
        return None

    def clock(self, name: str) -> Clock | None:
        time = self._time(name)
        return None if time is None else even_clock(time, f"the time beside {name}")

    def start(self, name: str) -> float | None:
        time = self._time(name)
        return None if time is None or not time.size else float(time[0])


def _since(start: Any, seconds: int) -> float:
    """Return the time of a TDMS time stamp after whole seconds since 1904 [s]; of none: that of 1904."""
    return float(start.seconds - seconds + start.second_fractions / 2**64) if start else float(-seconds)


class _Tdms(Source):
    """TDMS file: ``CHANNEL``, or ``GROUP/CHANNEL`` where the name of the channel alone is not unique."""

    def __init__(self, path: Path) -> None:
        with extras.named():
            import nptdms

        self._path = path
        with nptdms.TdmsFile.read_metadata(path, raw_timestamps=True) as file:
            channels = [channel for group in file.groups() for channel in group.channels()]
            names = [channel.name for channel in channels]
            self._places = {
                channel.name if names.count(channel.name) == 1 else f"{channel.group_name}/{channel.name}": (
                    channel.group_name,
                    channel.name,
                )
                for channel in channels
            }
            about = dict(zip(self._places, (channel.properties for channel in channels), strict=True))
        self.units = {name: str(found.get("unit_string", "")) for name, found in about.items()}
        starts = {name: found["wf_start_time"] for name, found in about.items() if "wf_start_time" in found}
        newest = max((start.seconds for start in starts.values()), default=0)  # a double resolves times since it
        self._clocks = {
            name: Clock(
                float(found.get("wf_start_offset", 0.0)) + _since(starts.get(name), newest),
                float(found["wf_increment"]),
            )
            for name, found in about.items()
            if found.get("wf_increment")
        }

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        import nptdms

        with nptdms.TdmsFile.open(self._path) as file:
            return {name: file[group][channel][:] for name in names for group, channel in [self._places[name]]}

    def clock(self, name: str) -> Clock | None:
        return self._clocks.get(name)


class _Mdf(Source):
    """MDF file (versions 2 to 4): channels by name, the first of each."""

    def __init__(self, path: Path) -> None:
        with extras.named():
            import asammdf

        self._file = asammdf.MDF(path)
        self._places = {
            name: places[0]
            for name, places in self._file.channels_db.items()
            if self._file.masters_db.get(places[0][0]) != places[0][1]
        }
        self.units = {name: self._file.get_channel_unit(name, *place) for name, place in self._places.items()}

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        return {name: self._file.get(name, *self._places[name], samples_only=True)[0] for name in names}

    def clock(self, name: str) -> Clock | None:
        time = self._file.get_master(self._places[name][0])
        return even_clock(np.asarray(time, np.float64), name)

    def start(self, name: str) -> float | None:
        time = self._file.get_master(self._places[name][0])
        return float(time[0]) if time.size else None


_FORMATS: Mapping[str, tuple[str, Callable[[Path], Source]]] = {
    ".csv": ("CSV", _Csv),
    ".txt": ("CSV", _Csv),
    ".parquet": ("Parquet", _Parquet),
    ".mat": ("MATLAB", _Mat),
    ".tdms": ("TDMS", _Tdms),
    ".mf4": ("MDF", _Mdf),
    ".mdf": ("MDF", _Mdf),
    ".dat": ("MDF", _Mdf),
}


def open_file(path: Path, ending: str = "") -> Source:
    """Open a measurement file; ``ending``, or else that of its name, gives the format.

    Raises:
        InputError: the ending is unknown, or the file is missing or damaged.
        LatheError: the package that reads the format is not installed.
    """
    if not path.is_file():
        raise InputError(f"{path}: cannot be read ({'a folder' if path.is_dir() else 'no such file'}); check the path")
    ending = ending or path.suffix.lower()
    if ending not in _FORMATS:
        raise InputError(f"{path}: no format of measurements; allowed: {', '.join(_FORMATS)}, or a bag")
    name, opened = _FORMATS[ending]
    with _readable(f"{path}: no readable {name} file"):
        return opened(path)


def read(path: Path, mapping: Mapping[str, Mapped], ending: str = "") -> Measurement:
    """Open a measurement file with a mapping of its columns; ``ending`` as for `open_file`.

    Raises:
        InputError: see `open_file` and `Measurement`.
        LatheError: see `open_file`.
    """
    return Measurement(str(path), open_file(path, ending), mapping)
