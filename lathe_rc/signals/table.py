# SPDX-License-Identifier: Apache-2.0
"""Tables in text files of any program: one intake with uniform error messages for all readers.

Encoding: UTF-8, UTF-16 with a byte order mark, otherwise Windows-1252. Between columns: semicolon, tabulator or comma,
whichever the header has first in this order, otherwise spaces. The header is the last line before the numbers that
names the columns sought; lines above it are ignored, as are empty lines and those that start with # or %. A row of
units may follow. All numbers of a table have one decimal mark; the other mark, spaces or apostrophes may group digits.
"""

import codecs
import csv
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from decimal import Decimal
from itertools import islice
from pathlib import Path

import numpy as np

from lathe_rc import files
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError, shown
from lathe_rc.signals.quantities import is_unit

_BEGIN = 2**20  # [B] by which the encoding is recognised, and the longest line
_LONG = 2**20  # [B] of a file that is read by columns
_LONGEST_PREAMBLE = 1000  # lines
_COMMENT = "#%"
_MARKS = (";", "\t", ",")
_NUMBER = re.compile(r"[-+]?[\d.,' \u00a0\u202f]*\d[.,]?(e[-+]?\d+)?|[-+]?(nan|inf)", re.IGNORECASE)
_GROUPED = {
    mark: re.compile(rf"[-+]?\d{{1,3}}([{other}' \u00a0\u202f])\d{{3}}(\1\d{{3}})*({re.escape(mark)}\d*)?")
    for mark, other in (".,", ",.")
}  # digits in groups, by decimal mark
_GROUPS = set(",' \u00a0\u202f")  # marks that group digits
_MISSING = ("", "nan")  # texts of a value that was not measured


def _encoding(begin: bytes, path: Path) -> str:
    """Return the encoding of a text file by its first bytes, which may end within a character."""
    if begin.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if b"\0" in begin[:4096]:
        raise _not_text(path)
    try:
        codecs.getincrementaldecoder("utf-8")().decode(begin)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def _not_text(path: Path) -> InputError:
    return InputError(f"{path}: not a text file; allowed: CSV in UTF-8, UTF-16 with a byte order mark, or Windows-1252")


def _split(line: str, mark: str) -> list[str]:
    """Return the fields of a line; raises csv.Error."""
    if mark == " ":
        return re.sub(r"\s+(?=[\[(])", "", line).split()
    return [field.strip() for field in next(csv.reader([line], delimiter=mark, strict=True), [])]


def _guess(line: str) -> tuple[str, list[str]]:
    """Return the mark between the columns of a line, and its fields; none if it is not CSV."""
    mark = next((mark for mark in _MARKS if mark in line), " ")
    try:
        return mark, _split(line, mark)
    except csv.Error:
        return mark, []


def _decimal_mark(found: Iterable[tuple[int, str]], path: Path, between: str) -> str:
    """Return the decimal mark of numbers, given as line and text, in a table with a mark ``between`` columns."""
    first: dict[str, tuple[int, str]] = {}
    for line, text in found:
        marks = [mark for mark in ".," if mark in text] if _NUMBER.fullmatch(text) else []
        if len(marks) == 2:
            return max(marks, key=text.rfind)
        for mark in marks:
            first.setdefault(mark, (line, text))
    if len(first) == 2:
        (one, early), (line, late) = sorted(first.values())
        raise InputError(
            f"{path}:{line}: {shown(late)!r} after {shown(early)!r} in line {one}; allowed: one decimal mark for all "
            "numbers (a mark between thousands? export without it)"
        )
    if between == "," and "," in first:
        line, text = first[","]
        raise InputError(
            f"{path}:{line}: {shown(text)!r} may have thousands or decimals; allowed: semicolons between columns "
            "beside decimal commas"
        )
    return "," if "," in first else "."


def _pointed(text: str, mark: str) -> str:
    """Return a field with a decimal point and no marks between thousands, if it is a number with decimal ``mark``."""
    if not _NUMBER.fullmatch(text):
        return text
    if _GROUPED[mark].fullmatch(text):
        text = re.sub(rf"[^-+\d{re.escape(mark)}]", "", text)
    return text.replace(",", ".") if mark == "," and "." not in text else text


def read_text(path: Path) -> str:
    """Return the text of a file in any encoding of a table.

    Raises:
        InputError: the file cannot be read, is far too large, or is no text.
    """
    try:
        content = files.contents(path)
        return content.decode(_encoding(content, path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except UnicodeDecodeError:
        raise _not_text(path) from None


class TextTable:
    """Text table, read row by row.

    Args:
        path: path of the file.
        known: whether a text names a column sought; None: the header is the first line.

    Attributes:
        names: names of the columns.
        units: row of units below the header, as texts by column; empty without.
        mark: mark between columns.
        ends: whether the last line that was read had an end.

    Raises:
        InputError: the file cannot be read, is no text, or has no header.
    """

    def __init__(self, path: Path, known: Callable[[str], object] | None = None) -> None:
        self.path = path
        try:
            with open(path, "rb", opener=files.open_file) as stream:
                self._encoding = _encoding(stream.read(_BEGIN), path)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
        self.units: list[str] = []
        self.ends = True
        self._header, self._above, self.mark, self.names = self._beginning(known)
        while self.names and not self.names[-1]:
            self.names.pop()
        if not self.names:
            raise InputError(f"{path}: no header; allowed: a first line with the names of the columns")
        if all(map(_NUMBER.fullmatch, self.names)):
            raise InputError(
                f"{path}:{self._header}: numbers in place of a header; allowed: a first line with the names of columns"
            )
        double = next((name for name in self.names if self.names.count(name) > 1), None)
        if double is not None:
            raise InputError(f"{path}:{self._header}: two columns {double!r}; allowed: each name once")

    def _lines(self) -> Iterator[tuple[int, str]]:
        """Yield the lines that are not empty, with their numbers from 1."""
        try:
            with open(self.path, encoding=self._encoding, newline=None, opener=files.open_file) as stream:
                number = 0
                while line := stream.readline(_BEGIN):
                    number += 1
                    if line.strip():
                        yield number, line
        except UnicodeDecodeError:
            raise _not_text(self.path) from None

    def _beginning(self, known: Callable[[str], object] | None) -> tuple[int, int, str, list[str]]:
        """Find the header: its line, the last line above the rows, the mark between columns, and the names."""
        found = None  # the last line that names columns sought
        above: tuple[int, int, str, list[str]] = (1, 1, ",", [])  # or else the first line, or that above numbers
        before = None
        for number, line in islice(self._lines(), _LONGEST_PREAMBLE):
            comment = line.lstrip()[0] in _COMMENT
            mark, fields = _guess(line.lstrip(f" {_COMMENT}").rstrip("\r\n") if comment else line.rstrip("\r\n"))
            place = (number, number, mark, fields)
            if known is None:
                if comment:
                    continue
                return number, number, mark.replace(" ", ","), fields
            numeric = [] if comment else [field for field in fields if _NUMBER.fullmatch(field)]
            if numeric and found:
                return found
            if len(numeric) == len(list(filter(None, fields))) > 1:
                return before if before and len(before[3]) == len(fields) else above if above[3] else place
            if len([field for field in fields if known(field)]) > 1:
                found = place
            elif found and not self.units and len(fields) == len(found[3]) and all(map(is_unit, fields)):
                self.units = [each.strip("[]()- ") for each in fields]
                found = (found[0], number, *found[2:])
            if not comment:
                before = place
                above = above if above[3] else place
        return found or above

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the number of the line and the fields of each row.

        Raises:
            InputError: a row is not CSV, or not as wide as the header.
        """
        wanted = len(self.names)
        for number, line in self._lines():
            self.ends = line.endswith("\n")
            if number <= self._above or line.lstrip()[0] in _COMMENT:
                continue
            try:
                fields = _split(line.rstrip("\r\n"), self.mark)
            except csv.Error as error:
                raise InputError(f"{self.path}:{number}: not CSV ({error}); allowed: quotes in pairs") from None
            if len(fields) > wanted and not any(fields[wanted:]):
                del fields[wanted:]
            if len(fields) != wanted:
                cure = " (between columns a semicolon, or decimals with a point)" if len(fields) > wanted else ""
                cure = " (the last line has no end: torn? remove it)" if not self.ends else cure
                raise InputError(
                    f"{self.path}:{number}: {len(fields)} values; allowed: {wanted}, as in the header{cure}"
                )
            yield number, fields

    def texts(self, names: Sequence[str], raw: Collection[str] = ()) -> list[tuple[int, list[str]]]:
        """Return the number of the line and the fields of columns, row by row; numbers have a decimal point.

        Args:
            names: columns to read.
            raw: those whose texts stay as they are.

        Raises:
            InputError: a row is malformed, or the decimal marks differ.
        """
        places = [self.names.index(name) for name in names]
        plain = [name not in raw for name in names]
        rows = [(line, [fields[place] for place in places]) for line, fields in self.rows()]
        marked = ((n, text) for n, row in rows for text, is_plain in zip(row, plain, strict=True) if is_plain)
        decimal = _decimal_mark(marked, self.path, self.mark)
        if decimal == "." and not any(_GROUPS.intersection(text) for _, row in rows for text in row):
            return rows
        return [
            (n, [_pointed(text, decimal) if is_plain else text for text, is_plain in zip(row, plain, strict=True)])
            for n, row in rows
        ]

    def numbers(self, names: Sequence[str], gaps: Collection[str] = (), since_first: str = "") -> dict[str, Array]:
        """Return columns of numbers by name, shape (n,) each.

        Args:
            names: columns to read.
            gaps: those that may be empty or NaN in some rows, which are NaN.
            since_first: column whose first value is subtracted before rounding to a double, whose resolution for
                seconds since 1970 is only 0.2 µs.

        Raises:
            InputError: a row is malformed, or contains a number that is not finite.
        """
        if not since_first and self.path.stat().st_size > _LONG and (found := self._by_columns(names)):
            return found
        rows = self.texts(names)
        numbers = np.empty((len(names), len(rows)))
        for k, (line, fields) in enumerate(rows):
            for column, (name, text) in enumerate(zip(names, fields, strict=True)):
                gap = name in gaps and text.casefold() in _MISSING
                numbers[column, k] = np.nan if gap else self._number(text, line, name)
        if since_first and rows:
            times = [Decimal(row[names.index(since_first)]) for _, row in rows]
            numbers[names.index(since_first)] = [float(time - times[0]) for time in times]
        return dict(zip(names, numbers, strict=True))

    def _number(self, text: str, line: int, name: str) -> float:
        """Return the finite number in a field of a column."""
        try:
            found = np.nan if "_" in text else float(text)
        except ValueError:
            found = np.nan
        if not np.isfinite(found):
            what = f"is {shown(text)!r}" if text else "is empty"
            raise InputError(
                f"{self.path}:{line}: {name!r} {what}; allowed: a finite number (remove the row, or correct the value)"
            )
        return found

    def _by_columns(self, names: Sequence[str]) -> dict[str, Array] | None:
        """Return columns of a long file, read in seconds rather than minutes; None if a value is not plain."""
        if self.mark == " ":
            return None
        import pyarrow as pa
        from pyarrow import csv as arrow_csv

        try:
            found = arrow_csv.read_csv(
                self.path,
                read_options=arrow_csv.ReadOptions(
                    column_names=self.names, skip_rows=self._above, encoding=self._encoding.removesuffix("-sig")
                ),
                parse_options=arrow_csv.ParseOptions(delimiter=self.mark),
                convert_options=arrow_csv.ConvertOptions(
                    include_columns=list(names),
                    column_types=dict.fromkeys(names, pa.float64()),
                    decimal_point="." if self.mark == "," or "," not in next(self.rows())[1][0] else ",",
                ),
            )
        except pa.ArrowInvalid:  # comments among the rows, or an error, which rows are read to locate
            return None
        arrays = {name: found.column(name).to_numpy() for name in names}
        return arrays if all(np.isfinite(array).all() for array in arrays.values()) else None


def write_table(path: Path, header: str, rows: Array, comment: str = "", *, digits: int = 15) -> None:
    """Write a CSV file atomically, which `TextTable` reads.

    Args:
        path: path of the file; an existing file is replaced.
        header: names of the columns, separated by commas.
        rows: shape (n, columns).
        comment: first line of the file; empty for none.
        digits: number of significant digits.

    Raises:
        InputError: the path is not writable.
    """
    if comment:
        header = f"# {' '.join(comment.split())}\n{header}"
    with files.written(path) as file:
        np.savetxt(file, rows, fmt=f"%.{digits}g", delimiter=",", header=header, comments="", encoding="utf-8")
