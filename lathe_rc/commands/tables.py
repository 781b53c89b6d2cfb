# SPDX-License-Identifier: Apache-2.0
"""Results of commands: as one JSON object, or as tables and text lines for the terminal."""

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

import click
import numpy as np
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

Row = TypeVar("Row")

_HEADING = 13  # characters of a line of a broken heading
_UNBOUNDED = 10_000  # [characters] width of an output that is no terminal


def console(*, soft_wrap: bool = True) -> Console:
    """Return a console for standard output, without highlighting, markup or line wrapping, which would split paths.

    A pipe or a file has no width, unless COLUMNS gives one: no column is cut there, and no line broken.

    Args:
        soft_wrap: leave the wrapping of lines of text to the terminal; otherwise they are wrapped between words.
    """
    out = Console(highlight=False, markup=False, emoji=False, soft_wrap=soft_wrap)
    if not out.file.isatty() and "COLUMNS" not in os.environ:
        out.width = _UNBOUNDED
    return out


def show(
    data: Mapping[str, object] | Callable[[], Mapping[str, object]], text: Iterable[RenderableType], *, as_json: bool
) -> None:
    """Print a result.

    Args:
        data: content for JSON, or a function that computes it.
        text: content for people: tables and `Text`, fitted to the terminal, and strings, whose lines are not broken.
        as_json: whether to print ``data`` or ``text``.
    """
    if as_json:
        click.echo(json.dumps(data() if callable(data) else data))
        return
    out = console()
    for each in text:
        out.print(each, soft_wrap=isinstance(each, str))


def spread(whole: int) -> list[int]:
    """Return up to ten indices below ``whole``, including the first and the last, denser at the beginning."""
    return sorted({round(place) - 1 for place in np.geomspace(1, whole, 10).tolist()})


def broken(columns: Sequence[str], width: int) -> list[str]:
    """Return headings in lines that end after a dot or an underscore, if together they are wider than ``width``."""
    if sum(map(len, columns)) + 3 * len(columns) <= width:
        return [*columns]
    found = []
    for column in columns:
        lines = [""]
        for piece in re.findall(r"[^_.]*[_.]?", column):
            if lines[-1] and len(lines[-1] + piece) > _HEADING:
                lines.append("")
            lines[-1] += piece
        found.append("\n".join(lines))
    return found


def table(*columns: str, title: str | None = None, left: int = 0, **options: Any) -> Table:
    """Return an empty table with columns.

    Args:
        columns: headings of the columns.
        title: title above the table.
        left: number of leading text columns, aligned left; the others hold numbers, aligned right.
        options: options of every column, see `rich.table.Table.add_column`.
    """
    made = Table(title=title, title_justify="left", show_edge=False, header_style="bold")
    for place, column in enumerate(columns):
        made.add_column(Text(column), justify="left" if place < left else "right", **options)
    return made


def of_rows(rows: Iterable[Row], columns: Mapping[str, Callable[[Row], str]], **options: Any) -> Table:
    """Return a table of rows; ``columns``: the text of a row's cell by heading; ``options``: see `table`."""
    made = table(*columns, **options)
    for row in rows:
        made.add_row(*(text(row) for text in columns.values()))
    return made
