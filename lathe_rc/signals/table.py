# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers in CSV files, with uniform error messages for all readers."""

import csv
import errno
import math
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np

from lathe_rc import files
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError


def read_text(path: Path, what: str) -> str:
    """Return the text of a CSV file; ``what`` names the content in error messages.

    Raises:
        InputError: the file is missing, far too large, or not a text file.
    """
    try:
        return files.contents(path).decode("utf-8-sig")
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise InputError(f"{path}: larger than {files.MOST // 2**20} MiB; thin the points out") from None
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path of the {what}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; allowed: CSV in UTF-8") from None


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
    rows: list[tuple[int, list[str]]] = []
    for n, line in enumerate(text.splitlines(), 1):
        if line.strip() and line.lstrip()[0] != "#":
            try:
                rows += [(n, row) for row in csv.reader([line], strict=True)]
            except csv.Error as error:
                raise InputError(f"{path}:{n}: not CSV ({error})") from None
    header = [name.strip() for name in rows[0][1]] if rows else []
    if header not in [list(known) for known in headers]:
        allowed = " or ".join(",".join(known) for known in headers)
        parted = " (parted by commas, decimals with a point)" if {";", "\t"} & set("".join(header)) else ""
        raise InputError(f"{path}: header {','.join(header)!r}; allowed: {allowed}{parted}")
    numbers = []
    for n, row in rows[1:]:
        if len(row) != len(header):
            decimals = " (decimals with a point)" if len(row) > len(header) else ""
            raise InputError(f"{path}:{n}: {len(row)} values; allowed: {len(header)}, as in the header{decimals}")
        numbers.append([number(text, path, n) for text in row])
    if since_first and numbers:
        first = Decimal(rows[1][1][0])
        for taken, (_, row) in zip(numbers, rows[1:], strict=True):
            taken[0] = float(Decimal(row[0]) - first)
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
