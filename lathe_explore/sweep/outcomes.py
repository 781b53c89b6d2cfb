# SPDX-License-Identifier: Apache-2.0
"""Outcomes of a sweep's cells: statuses and reasons, where reasons that differ only in numbers are one outcome."""

import re
from typing import NamedTuple

import pyarrow as pa

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


class CellsOutcome(NamedTuple):
    """Outcome of several cells.

    Attributes:
        status: status of the cells, see `lathe_explore.sweep.row`.
        cells: number of cells.
        cell: number of the first of them.
        reason: its reason; empty if there is none.
    """

    status: str
    cells: int
    cell: int
    reason: str

    @property
    def example(self) -> str:
        """The first cell and its reason."""
        return f"cell {self.cell}: {self.reason}" if self.reason else ""


def outcomes(table: pa.Table) -> list[CellsOutcome]:
    """Return the outcomes of rows with the columns cell, status and reason, most frequent first."""
    found: dict[tuple[str, str], CellsOutcome] = {}
    for row in table.select(["cell", "status", "reason"]).to_pylist():
        reason = row["reason"] or ""
        outcome = found.setdefault(
            (row["status"], _NUMBER.sub("…", reason)), CellsOutcome(row["status"], 0, row["cell"], reason)
        )
        found[row["status"], _NUMBER.sub("…", reason)] = outcome._replace(cells=outcome.cells + 1)
    return sorted(found.values(), key=lambda outcome: -outcome.cells)
