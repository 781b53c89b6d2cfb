# SPDX-License-Identifier: Apache-2.0
"""Tables and lines for the terminal."""

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text


def console() -> Console:
    """Return the standard output: no colours by content, no markup, and no wrapped lines, so that paths stay whole."""
    return Console(highlight=False, markup=False, emoji=False, soft_wrap=True)


def spread(whole: int, count: int = 10) -> list[int]:
    """Return places from 0, the first and the last of all among them, denser at the beginning; at most ``count``."""
    return sorted({round(place) - 1 for place in np.geomspace(1, whole, count).tolist()})


def table(*columns: str, title: str | None = None, left: int = 0, **options: Any) -> Table:
    """Return a table without rows.

    Args:
        columns: their headings.
        title: above it.
        left: so many columns are of text, the others of numbers, which end at the same place.
        options: of each column, see `rich.table.Table.add_column`.
    """
    made = Table(title=title, title_justify="left", show_edge=False, header_style="bold")
    for place, column in enumerate(columns):
        made.add_column(Text(column), justify="left" if place < left else "right", **options)
    return made
