# SPDX-License-Identifier: Apache-2.0
"""Tables and text lines for the terminal."""

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text


def console() -> Console:
    """Return a console for standard output, without highlighting, markup or line wrapping, which would split paths."""
    return Console(highlight=False, markup=False, emoji=False, soft_wrap=True)


def spread(whole: int, count: int = 10) -> list[int]:
    """Return up to ``count`` indices below ``whole``, including the first and the last, denser at the beginning."""
    return sorted({round(place) - 1 for place in np.geomspace(1, whole, count).tolist()})


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
