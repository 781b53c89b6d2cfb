# SPDX-License-Identifier: Apache-2.0
"""Cells given by a file, each with values of some parameters."""

from collections.abc import Collection, Mapping
from pathlib import Path

from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import Value
from lathe_rc.errors import InputError
from lathe_rc.signals.quantities import Mapped
from lathe_rc.signals.table import TextTable, read_text


def read(
    path: Path, carried: Collection[str] = (), columns: Mapping[str, Mapped] | None = None
) -> list[dict[str, Value]]:
    """Read cells from a file: CSV with targets in its first row, or a YAML list of ``{TARGET: VALUE, ...}``.

    Args:
        path: the file.
        carried: names of columns that are no targets; their values stay text.
        columns: columns that are named otherwise in the file, by target; their units are factors.

    Raises:
        InputError: the file cannot be read, is in neither format, has no cells, or lacks a column.
    """
    cells = _of_yaml(path, carried) if path.suffix.lower() != ".csv" else _of_table(path, carried)
    if not cells:
        raise InputError(f"{path}: no cells; allowed: one or more rows below a header of targets")
    for number, cell in enumerate(cells, 1):
        for target, (name, unit) in (columns or {}).items():
            value = cell.pop(name, None)
            if target in cell:
                raise InputError(f"{path}: a column {target} beside --column {target}={name}; allowed: one of them")
            if value is None or (unit and not isinstance(value, int | float)):
                reason = f"is {value!r}; allowed: a number" if name in cells[0] else "is missing"
                raise InputError(f"{path}: row {number}: {name!r} {reason} (--column {target}={name})")
            cell[target] = value * float(unit) if unit and isinstance(value, int | float) else value
    return cells


def _of_yaml(path: Path, carried: Collection[str]) -> list[dict[str, Value]]:
    cells = ros_yaml.rows(read_text(path), str(path))
    return [{name: str(value) if name in carried else value for name, value in cell.items()} for cell in cells]


def _of_table(path: Path, carried: Collection[str]) -> list[dict[str, Value]]:
    table = TextTable(path)
    found: list[dict[str, Value]] = []
    for line, row in table.texts(table.names, raw=carried):
        cell: dict[str, Value] = {}
        for name, text in zip(table.names, row, strict=True):
            if not text and name not in carried:
                raise InputError(f"{path}:{line}: {name} is empty; allowed: a value")
            cell[name] = text if name in carried else ros_yaml.parse_value(text, f"{path}:{line}: {name}")
        found.append(cell)
    return found
