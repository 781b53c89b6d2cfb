# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers in CSV files of any dialect, with uniform error messages for all readers.

Encoding: UTF-8, UTF-16 with a byte order mark, otherwise Windows-1252. Between columns: semicolon or tabulator if the
header has one, otherwise comma; numbers then have a decimal comma or a point, beside commas a point.
"""

import codecs
import csv
import errno
import math
from collections.abc import Iterable, Iterator, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from lathe_rc import files
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError


def encoding(begin: bytes, path: Path) -> str:
    """Return the encoding of a text file by its first bytes, which may end within a character.

    Raises:
        InputError: the file is not a text file.
    """
    if begin.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(begin)
    except UnicodeDecodeError:
        found = "cp1252"
    else:
        found = "utf-8-sig"
    if b"\0" in begin:
        raise not_text(path)
    return found


def not_text(path: Path) -> InputError:
    """Return the error for a file that is not a text file."""
    return InputError(f"{path}: not a text file; allowed: CSV in UTF-8, UTF-16 or Windows-1252")


def delimiter_of(header: str) -> str:
    """Return the mark between the columns of a table with this header."""
    return next((mark for mark in (";", "\t") if mark in header), ",")


def pointed(text: str, delimiter: str) -> str:
    """Return a number with a decimal point, in a table with this mark between columns."""
    return text if delimiter == "," else text.replace(",", ".")


def rows(lines: Iterable[tuple[int, str]], path: Path, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and fields of lines with their numbers.

    Raises:
        InputError: a line is not CSV.
    """
    for n, line in lines:
        try:
            yield n, next(csv.reader([line], delimiter=delimiter, strict=True), [])
        except csv.Error as error:
            raise InputError(f"{path}:{n}: not CSV ({error})") from None


def check_width(path: Path, line: int, found: int, wanted: int) -> None:
    """Check that a row is as wide as the header.

    Raises:
        InputError: it is not.
    """
    if found != wanted:
        decimals = " (between columns a semicolon, or decimals with a point)" if found > wanted else ""
        raise InputError(f"{path}:{line}: {found} values; allowed: {wanted}, as in the header{decimals}")


def read_text(path: Path, what: str) -> str:
    """Return the text of a CSV file; ``what`` names the content in error messages.

    Raises:
        InputError: the file is missing, far too large, or not a text file.
    """
    try:
        content = files.contents(path)
        return content.decode(encoding(content, path))
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise InputError(f"{path}: larger than {files.MOST // 2**20} MiB; thin the points out") from None
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path of the {what}") from None
    except UnicodeDecodeError:
        raise not_text(path) from None


def lines_of(text: str) -> tuple[list[tuple[int, str]], str]:
    """Return the lines of a table but empty ones and comments, numbered from 1, and the mark between columns."""
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and line.lstrip()[0] != "#"]
    return lines, delimiter_of(lines[0][1]) if lines else ","


def header_and_rows(text: str, path: Path) -> tuple[list[str], list[tuple[int, list[str]]], str]:
    """Return the header of a table, the rows below it with their line numbers, and the mark between columns.

    Raises:
        InputError: a line is not CSV.
    """
    lines, delimiter = lines_of(text)
    (_, header), *found = [*rows(lines, path, delimiter)] or [(0, [])]
    return [name.strip() for name in header], found, delimiter


def number(text: str, path: Path, line: int) -> float:
    """Parse a finite number from a field of a CSV file.

    Raises:
        InputError: the text is no finite number; the message names path and line.
    """
    try:
        found = float(text)
    except ValueError:
        raise InputError(f"{path}:{line}: {text.strip()!r} is not a number") from None
    if not math.isfinite(found):
        raise InputError(f"{path}:{line}: {text.strip()!r}; allowed: finite numbers")
    return found


def read_table(
    path: Path, headers: Sequence[Sequence[str]], what: str, *, since_first: bool = False
) -> tuple[list[str], Array]:
    """Read a CSV file of numbers (see `parse_table`).

    Raises:
        InputError: the file is missing, far too large, malformed, or contains a number that is not finite.
    """
    return parse_table(read_text(path, what), path, headers, since_first=since_first)


def parse_table(
    text: str, path: Path, headers: Sequence[Sequence[str]], *, since_first: bool = False
) -> tuple[list[str], Array]:
    """Parse CSV text with numbers; empty lines and lines starting with # are ignored.

    Args:
        text: content of the file.
        path: path of the file, for error messages.
        headers: allowed headers.
        since_first: whether the first value of the first column is subtracted from the column before rounding to a
            double, whose resolution for seconds since 1970 is only 0.2 µs.

    Returns:
        Header and rows, shape (n, columns).

    Raises:
        InputError: the file is malformed, or contains a number that is not finite.
    """
    header, found, delimiter = header_and_rows(text, path)
    if header not in [list(known) for known in headers]:
        allowed = " or ".join(",".join(known) for known in headers)
        raise InputError(f"{path}: header {delimiter.join(header)!r}; allowed: {allowed}")
    numbers = []
    for n, row in found:
        check_width(path, n, len(row), len(header))
        numbers.append([number(pointed(each, delimiter), path, n) for each in row])
    if since_first and numbers:
        times = [Decimal(pointed(row[0], delimiter)) for _, row in found]
        for taken, time in zip(numbers, times, strict=True):
            taken[0] = float(time - times[0])
    return header, np.array(numbers).reshape(-1, len(header))


def write_table(path: Path, header: str, rows: Array, comment: str = "", *, digits: int = 15) -> None:
    """Write a CSV file atomically, in the format of `read_table`.

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
