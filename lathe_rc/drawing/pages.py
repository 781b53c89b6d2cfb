# SPDX-License-Identifier: Apache-2.0
"""Parts of pages made from bags: text, tables, and the file itself.

Strings from a bag are not trusted: they are truncated and reduced to printable characters, and the templates escape
them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from lathe_rc.errors import InputError, LatheError
from lathe_rc.files import check_place, replacing

_LONGEST_TEXT = 300
MOST_ROWS = 200  #: largest number of rows of a table


@dataclass(frozen=True)
class PageTable:
    """Table of a report; ``texts`` are the columns without numbers."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    texts: Sequence[str]


def own_file(name: str, folder: Path = Path(__file__).parent) -> str:
    """Return the text of a style sheet or script of these pages, or of another folder."""
    return (folder / name).read_text(encoding="utf-8")


def printable(text: str, longest: int = _LONGEST_TEXT) -> str:
    """Return a string from a bag, truncated and reduced to printable characters, line ends and tabs."""
    cut = text[:longest] + (f" … ({len(text)} characters)" if len(text) > longest else "")
    return "".join(letter if letter.isprintable() or letter in "\n\t" else "\ufffd" for letter in cut)


def shown(value: float) -> str:
    """Return a number with four digits; a dash if it is not finite."""
    return f"{value:.4g}" if np.isfinite(value) else "–"


def grid(
    columns: Sequence[str], rows: Iterable[Sequence[object]], texts: Sequence[str] = (), count: int = 0
) -> PageTable | None:
    """Return a table of the first rows and the number of omitted rows out of ``count``; None without rows."""
    cells = [
        [shown(cell) if isinstance(cell, float) else printable(str(cell)) for cell in row]
        for row in islice(rows, MOST_ROWS)
    ]
    if count > len(cells):
        cells.append([f"… and {count - len(cells)} more"])
    return PageTable(columns, cells, texts) if cells else None


def check_page(page: Path, option: str = "-o") -> None:
    """Refuse a file that cannot become a page; ``option`` named it.

    Raises:
        InputError: it does not end in .html, or has no place in its folder.
    """
    if page.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{option} {page}; allowed: a file name that ends in .html")
    check_place(option, page)


def write_page(page: Path, text: str) -> None:
    """Write a page; an existing file of the same name is replaced atomically.

    Raises:
        LatheError: the page cannot be written.
    """
    try:
        with replacing(page) as file:
            file.write(text.encode("utf-8", "replace"))  # strings of a bag may contain lone surrogates
    except OSError as error:
        raise LatheError(f"{page}: cannot be written ({error.strerror})") from None
