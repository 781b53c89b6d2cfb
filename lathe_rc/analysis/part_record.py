# SPDX-License-Identifier: Apache-2.0
"""Roundness and profile records of finished parts, from CSV files of any columns and from X3P (ISO 25178-72)."""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lathe_rc.analysis.form_correction import Revolution
from lathe_rc.errors import InputError, shown
from lathe_rc.signals.table import read_text

Array = npt.NDArray[np.float64]

_TURN = 2.0 * np.pi
_LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9, "in": 25.4e-3}
UNITS: Mapping[str, Mapping[str, float]] = {
    "angle": {"deg": _TURN / 360.0, "°": _TURN / 360.0, "rad": 1.0, "rev": _TURN},
    "radius": _LENGTHS,
    "height": _LENGTHS,
    "revolution": {"1": 1.0},
}  #: factors to rad and m by quantity and unit
_USUAL = {"angle": "angle_deg", "radius": "radius_um", "height": "height_mm", "revolution": "revolution"}
_UNIT = re.compile(r"(?:_|\s*[\[(]\s*)([^\s\[\]()_]+)\s*[\])]?$")  # at the end of a column's name
_WHOLE = 0.75  # least part of a revolution that a record has to cover


def _unit(path: Path, quantity: str, column: str, given: str) -> float:
    """Return the factor of a column's unit, as given or from the end of its name."""
    if quantity == "revolution":
        return 1.0
    found = _UNIT.search(column)
    text = given or (found[1] if found else "")
    if text not in UNITS[quantity]:
        known = ", ".join(UNITS[quantity])
        what = f"unit {text!r}" if given else "no unit"
        raise InputError(
            f"{path}: {what} of {quantity} in column {shown(column)!r}; allowed: --column "
            f"{quantity}={shown(column)}:UNIT with one of {known}"
        )
    return UNITS[quantity][text]


def parse_columns(given: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Parse ``QUANTITY=COLUMN`` or ``QUANTITY=COLUMN:UNIT`` into column and unit by quantity.

    Raises:
        InputError: an unknown quantity, or no column.
    """
    found = {}
    for text in given:
        quantity, _, rest = text.partition("=")
        column, _, unit = rest.rpartition(":") if rest.rpartition(":")[2] in UNITS.get(quantity, {}) else (rest, "", "")
        if quantity not in UNITS or not column:
            raise InputError(f"--column {text!r}; allowed: QUANTITY=COLUMN[:UNIT] with one of {', '.join(UNITS)}")
        found[quantity] = (column, unit)
    return found


def _table(path: Path) -> tuple[list[str], list[tuple[int, list[str]]], bool]:
    """Return header and rows of a CSV file with their line numbers, and whether decimals have a comma."""
    lines = [
        (n, line)
        for n, line in enumerate(read_text(path, "record").splitlines(), 1)
        if line.strip() and line.lstrip()[0] != "#"
    ]
    if not lines:
        raise InputError(f"{path}: no rows; allowed: a header with the names of the columns, and rows of numbers")
    separator = next((mark for mark in ";\t" if mark in lines[0][1]), ",")
    rows = []
    for n, line in lines:
        try:
            rows += [
                (n, [field.strip() for field in row]) for row in csv.reader([line], delimiter=separator, strict=True)
            ]
        except csv.Error as error:
            raise InputError(f"{path}:{n}: not CSV ({error})") from None
    return rows[0][1], rows[1:], separator != ","


def _number(path: Path, line: int, text: str, *, comma: bool) -> float:
    try:
        number = float(text.replace(",", ".") if comma else text)
    except ValueError:
        raise InputError(f"{path}:{line}: {shown(text)!r} is not a number") from None
    if not math.isfinite(number):
        raise InputError(
            f"{path}:{line}: {shown(text)!r}; allowed: finite numbers, or no row where nothing is measured"
        )
    return number


def read_csv(path: Path, columns: Mapping[str, tuple[str, str]]) -> list[Revolution]:
    """Read the revolutions of a record from a CSV file.

    Columns are separated by commas, or by semicolons or tabs, where decimals may have a comma. Other columns than those
    of the mapping are ignored.

    Args:
        path: file with a header; lines that begin with # are comments.
        columns: name and unit of the column by quantity: ``angle`` and ``radius``, optionally ``height`` and
            ``revolution``. Missing ones are named as in the profiles of lathe_rc; the unit may be the end of the name.

    Raises:
        InputError: the file is missing or malformed, a column or unit is missing, or a revolution is incomplete.
    """
    header, rows, comma = _table(path)
    values: dict[str, Array] = {}
    for quantity, usual in _USUAL.items():
        column, unit = columns.get(quantity, (usual, ""))
        if column not in header:
            if quantity not in columns and quantity in ("height", "revolution"):
                continue
            raise InputError(
                f"{path}: no column {shown(column)!r} for the {quantity}; allowed: --column {quantity}=COLUMN:UNIT "
                f"with one of {shown(', '.join(header))}"
            )
        place, factor = header.index(column), _unit(path, quantity, column, unit)
        short = next((n for n, row in rows if len(row) <= place), 0)
        if short:
            raise InputError(f"{path}:{short}: no value in column {shown(column)!r}")
        values[quantity] = factor * np.array([_number(path, n, row[place], comma=comma) for n, row in rows])
    return _split(path, values)


def _split(path: Path, values: Mapping[str, Array]) -> list[Revolution]:
    """Split rows into revolutions: by their number, by height, or after each turn from the first row, either way."""
    angle = values["angle"]
    known = "height" in values
    heights = values.get("height", np.zeros(angle.size))
    if "revolution" in values:
        number = values["revolution"]
    elif np.unique(heights).size > 1:
        number = heights
    else:
        goes_on = angle.size and np.ptp(angle) > 1.01 * _TURN
        turned = (angle if goes_on else np.unwrap(angle)) - angle[:1]
        number = np.floor(np.abs(turned) / _TURN + 1e-9)
    found = []
    for each in dict.fromkeys(number.tolist()):
        rows = number == each
        revolution = Revolution(
            np.mod(angle[rows], _TURN), values["radius"][rows], float(heights[rows].mean()) if known else None
        )
        if _covered(revolution.angle) >= _WHOLE:
            found.append(revolution)
    if not found:
        span = np.degrees(np.ptp(angle)) if angle.size else 0.0
        raise InputError(
            f"{path}: no complete revolution: {angle.size} points over {span:.4g}°; allowed: a record of one "
            "revolution or more, and the right unit of the angle"
        )
    return found


def _covered(angle: Array) -> float:
    """Return the part of a revolution that angles cover, all gaps above 15° left out."""
    if angle.size < 3:
        return 0.0
    around = np.sort(angle)
    steps = np.diff(np.append(around, around[0] + _TURN))
    return float(steps[steps < np.radians(15.0)].sum() / _TURN)


def read_x3p(path: Path) -> list[Revolution]:
    """Read the revolutions of a record from an X3P file: layers of a profile, or rows of a surface.

    The points of a revolution are even, its first is at angle 0; points that are not measured are left out.

    Raises:
        InputError: the file is no X3P file, or has no such grid.
    """
    import x3pio

    try:
        file: Any = x3pio.read(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path of the record") from None
    except x3pio.X3pError as error:
        raise InputError(f"{path}: no X3P file ({shown(error)})") from None
    if (
        not isinstance(file, (x3pio.Profile, x3pio.Surface))
        or file.header.x.axis_type is not x3pio.AxisType.INCREMENTAL
    ):
        raise InputError(
            f"{path}: {type(file).__name__} with coordinates of its own; allowed: a profile or surface of even points, "
            "or CSV with an angle column"
        )
    rows = [row for layer in file.layers for row in np.atleast_2d(np.asarray(layer.z, dtype=np.float64))]
    found = []
    for row in rows:
        there = np.isfinite(row)
        angle = _TURN * np.arange(row.size) / row.size
        if _covered(angle[there]) >= _WHOLE:
            found.append(Revolution(angle[there], row[there]))
    if not found:
        raise InputError(f"{path}: no complete revolution; allowed: measured points over {_WHOLE:.0%} of it")
    return found


def read(path: Path, columns: Mapping[str, tuple[str, str]]) -> list[Revolution]:
    """Read a record by its ending: ``.x3p``, otherwise CSV (see `read_csv`).

    Raises:
        InputError: see `read_csv` and `read_x3p`; or columns are given for an X3P file.
    """
    if path.suffix.lower() != ".x3p":
        return read_csv(path, columns)
    if columns:
        raise InputError(f"{path}: --column with an X3P file; allowed: none, its radius is in metres")
    return read_x3p(path)
