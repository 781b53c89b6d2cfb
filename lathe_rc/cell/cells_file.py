# SPDX-License-Identifier: Apache-2.0
"""Cells given by a file, each with values of some parameters."""

import re
from collections.abc import Collection
from pathlib import Path

from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import Value
from lathe_rc.signals import table

_DECIMAL = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")  # beside semicolons or tabulators


def read(path: Path, carried: Collection[str] = ()) -> list[dict[str, Value]]:
    """Read cells from a file: CSV with targets in its first row, or a YAML list of ``{TARGET: VALUE, ...}``.

    Args:
        path: the file.
        carried: names of columns that are no targets; their values stay text.

    Raises:
        InputError: the file cannot be read, or is in neither format.
    """
    text = table.read_text(path, "cells")
    if path.suffix.lower() != ".csv":
        return [
            {name: str(value) if name in carried else value for name, value in cell.items()}
            for cell in ros_yaml.rows(text, str(path))
        ]
    targets, rows, mark = table.header_and_rows(text, path)
    for line, row in rows:
        table.check_width(path, line, len(row), len(targets))

    def value(target: str, text: str) -> Value:
        if target in carried:
            return text
        text = table.pointed(text, mark) if _DECIMAL.fullmatch(text) else text
        return ros_yaml.parse_value(text, f"{path}: {target}")

    return [{target: value(target, text) for target, text in zip(targets, row, strict=True)} for _, row in rows]
