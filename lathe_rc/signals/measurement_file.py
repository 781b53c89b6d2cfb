# SPDX-License-Identifier: Apache-2.0
"""Measurements by quantity, in SI units, from text tables and files of instruments.

All readers of numbers use one format of columns, see `lathe_rc.signals.quantities`. Without a unit in its name a column
has the unit that the file states for it, otherwise the SI unit; lengths along a part need a unit. A mapping of columns
gives names and units that differ.
"""

import shlex
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.signals.measurement_source import Clock, MeasurementSource, even_clock
from lathe_rc.signals.quantities import UNITS, Mapped, factor, is_decibel, is_quantity, rank, unit_of
from lathe_rc.signals.table import TextTable

_SAME_START = 1e-8  # [s] two columns that begin within it begin together
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


def _elements(columns: Iterable[str]) -> list[str]:
    """Return the columns of a bag, those of the elements of one array together: ``/joint_states.position[0, x]``."""
    arrays: dict[str, list[str]] = {}
    for column in columns:
        array, _, element = column[:-1].rpartition("[") if column.endswith("]") else (column, "", "")
        arrays.setdefault(array, []).append(element)
    for found in arrays.values():
        if len(found) > _MOST_COLUMNS:
            found[2:-1] = ["..."]
    return [f"{array}[{', '.join(found)}]" if found != [""] else array for array, found in arrays.items()]


def check_rising(time: Array, path: Path) -> None:
    """Check that times of a file [s], shape (n,), increase.

    Raises:
        InputError: they do not; the message names the row.
    """
    wrong = np.flatnonzero(np.diff(time) <= 0.0)
    if wrong.size:
        place = int(wrong[0]) + 1
        raise InputError(
            f"{path}: row {place + 1} is {time[place] - time[place - 1]:.10g} s after the one before; allowed: times "
            "that rise"
        )


class MeasuredQuantities:
    """Quantities of a measurement, in SI units.

    Args:
        name: path of the measurement, for error messages.
        source: its columns.
        mapping: columns of quantities that are not named by them; None: the caller has no option for it.

    Raises:
        InputError: a column of the mapping does not exist.
    """

    def __init__(self, name: str, source: MeasurementSource, mapping: Mapping[str, Mapped] | None) -> None:
        self.name, self._source, self._has_option, mapping = name, source, mapping is not None, mapping or {}
        self._columns: dict[str, Mapped] = {}
        self._doubles: dict[str, list[str]] = {}  # columns that are named by the same quantity
        for quantity, (column, unit) in mapping.items():
            if column not in source.units:
                raise InputError(f"--column {quantity}={column}: {name} has no such column; it has {self._listed()}")
            self._columns[quantity] = Mapped(column, unit)
        for quantity in UNITS.keys() - mapping.keys():
            ranks = {column: rank(quantity, column) for column in source.units}
            fitting = [column for column in ranks if ranks[column] == max(ranks.values()) > 0]
            if fitting:
                self._columns[quantity] = Mapped(fitting[0], "")
            if len(fitting) > 1:
                self._doubles[quantity] = fitting

    def _listed(self) -> str:
        names = list(self._source.units) if self._source.has_header else _elements(self._source.units)
        more = f" and {len(names) - _MOST_COLUMNS} more" if len(names) > _MOST_COLUMNS else ""
        return (", ".join(map(repr, names[:_MOST_COLUMNS])) or "no columns of numbers") + more

    def __contains__(self, quantity: str) -> bool:
        """Return whether the measurement has a quantity."""
        return quantity in self._columns

    def column(self, quantity: str) -> str:
        """Return the name of the column of a quantity that the measurement has."""
        return self._columns[quantity].column

    def lacking(self, allowed: str) -> InputError:
        """Return the error for a measurement without the required quantities; ``allowed`` names these."""
        cure = "rename others in the header" + self._or_option("QUANTITY=COLUMN:UNIT")
        cure = cure if self._source.has_header else "--column QUANTITY=COLUMN[:UNIT] for each"
        return InputError(f"{self.name}: columns {self._listed()}; allowed: {allowed} ({cure})")

    def _or_option(self, value: str) -> str:
        return f", or --column {value}" if self._has_option else ""

    def read(
        self, *quantities: str, gaps: Collection[str] = (), units: Mapping[str, str] | None = None
    ) -> list[npt.NDArray[Any]]:
        """Return quantities in the units of `UNITS`, shape (n,) each, n above 0; complex where the file has them so.

        Args:
            quantities: quantities to read.
            gaps: those that may be missing in some rows, which are NaN.
            units: units of quantities in place of these; a value in the same unit is not rounded.

        Raises:
            InputError: a column is missing, has no finite numbers, or has an unknown unit, two columns are named by a
                quantity, the lengths or the times of the first values differ, or the file is damaged.
        """
        if not self._columns.keys() >= set(quantities):
            raise self.lacking(" and ".join(quantities))
        for quantity in self._doubles.keys() & set(quantities):
            one, other, *_ = self._doubles[quantity]
            cure = f"rename one in the header{self._or_option(f'{quantity}={one}')}"
            raise InputError(f"{self.name}: {one!r} and {other!r} are both {quantity}; allowed: one ({cure})")
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
            wanted = factor(quantity, units[quantity]) if units else None
            found.append(self._scaled(quantity, column, unit, array, wanted or 1.0))
        sizes = [array.size for array in found]
        if len(set(sizes)) > 1:
            lengths = ", ".join(f"{size} of {name}" for name, size in zip(quantities, sizes, strict=True))
            raise InputError(f"{self.name}: {lengths}; allowed: as many of each")
        if not any(sizes):
            raise InputError(f"{self.name}: no rows below its header; allowed: one or more")
        return found

    def since_first(self, quantity: str) -> Array:
        """Return a quantity less its first value, shape (n,), as exactly as the file states it; see `read`."""
        self.read(quantity)
        column, unit = self._columns[quantity]
        return np.asarray(self._scaled(quantity, column, unit, self._source.since_first(column)))

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
        value = factor(quantity, unit or self._unit(quantity, column)) or 1.0
        return "--column " + shlex.quote(f"{quantity}={column}:{-value:.9g}")

    def swapped(self, one: str, other: str) -> str:
        """Return the options that exchange two quantities."""
        pairs = ((one, other), (other, one))
        return " ".join("--column " + shlex.quote(f"{to}={self._columns[of].column}") for to, of in pairs)

    def _unit(self, quantity: str, column: str) -> str:
        named = None if column.startswith("/") else unit_of(quantity, column)  # the brackets of a topic hold an element
        return named if named is not None else self._source.units[column]

    def _damaged(self) -> str:
        return f"{self.name}: damaged after its header; record or copy it again"

    def _scaled(
        self, quantity: str, column: str, unit: str, array: npt.NDArray[Any], wanted: float = 1.0
    ) -> npt.NDArray[Any]:
        unit = unit or self._unit(quantity, column)
        value = factor(quantity, unit)
        if value is None:
            known = ", ".join(each for each in UNITS[quantity] if each)
            has = f"the unit {shown(unit)!r}" if unit else "no unit"
            cure = f"in its name, as '{quantity} [{known.partition(',')[0]}]'"
            cure += self._or_option(f"{quantity}={column}:UNIT or the SI value of 1")
            raise InputError(f"{self.name}: column {column!r} has {has}; allowed for {quantity}: {known} ({cure})")
        if is_decibel(unit):
            return np.asarray(10.0 ** (array / 20.0))
        return array if value == wanted else array * (value / wanted)

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


class _Text(MeasurementSource):
    """Text table (see `lathe_rc.signals.table`)."""

    def __init__(self, path: Path, known: Collection[str]) -> None:
        self._table = TextTable(path, lambda column: column in known or is_quantity(column))
        names = self._table.names
        self.units = dict.fromkeys(names, "") | dict(zip(names, self._table.units, strict=False))

    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        return self._table.numbers(names, gaps)

    def since_first(self, name: str) -> Array:
        return self._table.numbers([name], since_first=name)[name]


#: Formats of instruments, by ending; `lathe_rc.signals.instrument_files` reads them.
_INSTRUMENTS = {
    ".parquet": "Parquet",
    ".mat": "MATLAB",
    ".tdms": "TDMS",
    ".mf4": "MDF",
    ".mdf": "MDF",
    ".dat": "MDF",
}


def read(path: Path, mapping: Mapping[str, Mapped] | None = None) -> MeasuredQuantities:
    """Open a measurement file with a mapping of its columns; a file of another ending is a text table.

    Raises:
        InputError: the file is missing or damaged, or see `MeasuredQuantities`.
        LatheError: the package that reads the format is not installed.
    """
    if not path.is_file():
        reason = "a folder" if path.is_dir() else "not a file" if path.exists() else "no such file"
        raise InputError(f"{path}: cannot be read ({reason}); check the path")
    name = _INSTRUMENTS.get(path.suffix.lower())
    with _readable(f"{path}: no readable {name or 'CSV'} file"):
        if name is None:
            return MeasuredQuantities(
                str(path), _Text(path, {column for column, _ in (mapping or {}).values()}), mapping
            )
        from lathe_rc.signals import instrument_files  # with SciPy, which text does not need

        return MeasuredQuantities(str(path), instrument_files.FORMATS[name](path), mapping)
