# SPDX-License-Identifier: Apache-2.0
"""Notebooks of the course: their gaps, and the solutions of docs/tutorials/course.md that fill them.

A gap is the first lines of a cell, up to an empty one; on the page, a Python block with the notebook as title holds the
lines that replace them, and the text block behind it the output of the cell.
"""

import ast
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import nbformat
import pages

PAGE = pages.ROOT / "docs" / "tutorials" / "course.md"
UNITS = sorted((pages.ROOT / "examples" / "course").glob("*.ipynb"))


class Solution(NamedTuple):
    """Lines that fill a gap, and the output of the cell with them."""

    code: str
    shown: str


def solutions(unit: Path) -> list[Solution]:
    """Return the solutions of a notebook in the order of the page."""
    return [
        Solution(first.text, second.text)
        for first, second in pairwise(pages.blocks(PAGE))
        if first.title == unit.name and second.language == "text"
    ]


def gaps(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """Return the cells with a gap."""
    return [cell for cell in notebook.cells if cell.cell_type == "code" and "# fill in" in cell.source]


def fill(notebook: nbformat.NotebookNode, filling: list[Solution]) -> list[nbformat.NotebookNode]:
    """Fill the gaps of a notebook, and return their cells."""
    cells = gaps(notebook)
    for cell, solution in zip(cells, filling, strict=True):
        _, _, rest = cell.source.partition("\n\n")
        cell.source = f"{solution.code}\n{rest}"
    return cells


def names(code: str) -> set[str]:
    """Return the names that the first level of a program assigns or defines."""
    found = set()
    for line in ast.parse(code).body:
        assigned = line.targets if isinstance(line, ast.Assign) else []
        found |= {each.id for each in assigned if isinstance(each, ast.Name)}
        found |= {line.name} if isinstance(line, ast.FunctionDef) else set()
    return found
