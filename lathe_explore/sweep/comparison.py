# SPDX-License-Identifier: Apache-2.0
"""Comparison of two sweeps: their scenarios and code, best cells, effects, and the cells that they have in common."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lathe_explore.sweep.effects import Effect
from lathe_explore.sweep.figures import Goal
from lathe_explore.sweep.folder import Folder
from lathe_explore.sweep.inputs import changes
from lathe_explore.sweep.page import effects_of
from lathe_explore.sweep.page_data import PageData
from lathe_rc.cell.scenario import differences
from lathe_rc.errors import InputError


@dataclass(frozen=True, eq=False)
class Side:
    """One of two compared sweeps.

    Attributes:
        folder: folder of the sweep.
        goal: goal of its cells.
        statuses: numbers of cells by status.
        best: row of the best cell: number, parameters and margin; empty without a cell that has a goal value.
        effects: effects of the parameters on the goal, by target.
        versions: versions of lathe_rc that computed the rows.
    """

    folder: Folder
    goal: Goal
    statuses: Mapping[str, int]
    best: Mapping[str, Any]
    effects: Mapping[str, Effect]
    versions: Sequence[str]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparison of two sweeps.

    Attributes:
        sides: the two sweeps.
        differences: differences of the scenarios, of the code and of the versions of lathe_rc, in words.
        changes: change of the goal from the first to the second sweep, in the goal's unit, shape (n,), in the n cells
            with the same parameters and seed that have a goal value in both.
    """

    sides: tuple[Side, Side]
    differences: Sequence[str]
    changes: NDArray[np.float64]

    @property
    def better(self) -> int:
        """Number of common cells that are better in the second sweep."""
        return int((self.changes * (-1.0 if self.sides[0].goal.above else 1.0) < 0.0).sum())


def compare(one: Folder, other: Folder, goal: str = "") -> Comparison:
    """Compare two sweeps.

    Args:
        one: folder of the first sweep.
        other: folder of the second sweep.
        goal: see `PageData`.

    Raises:
        InputError: a sweep has no such goal, or the sweeps have different default goals.
    """
    if not goal and one.description.goal != other.description.goal:
        both = f"{one.description.goal} and {other.description.goal}"
        raise InputError(f"{one.path} and {other.path}: goals {both}; allowed: a --goal that both have")
    seen = PageData(one, goal), PageData(other, goal)
    sides = _side(seen[0]), _side(seen[1])
    told = changes(one.inputs, other.inputs)
    try:
        told = [*differences(one.scenario, other.scenario), *told]
    except InputError as error:
        told.append(f"scenarios cannot be compared ({error})")
    if sides[0].versions != sides[1].versions:
        told.append(f"lathe_rc {', '.join(sides[0].versions)} there, and {', '.join(sides[1].versions)} here")
    values = [_by_cell(each, (one, other)) for each in seen]
    pairs = [(values[0][key], values[1][key]) for key in values[0] if key in values[1]]
    found = np.array([after - before for before, after in pairs])
    return Comparison(sides, told, found[np.isfinite(found)])


def _side(seen: PageData) -> Side:
    best: dict[str, Any] = {}
    if seen.goal.order.size:
        place = int(seen.goal.order[0])
        columns = ["cell", *seen.folder.targets, "margin"]
        (best,) = seen.table.select(list(dict.fromkeys(columns))).slice(place, 1).to_pylist()
    effects = effects_of(seen, [seen.goal], seen.axes)[seen.goal.name] if seen.axes else []
    versions = sorted({version for version in seen.folder.versions().values() if version})
    named = {axis.name: each for axis, each in zip(seen.axes, effects, strict=True)}
    return Side(seen.folder, seen.goal, dict(seen.statuses.most_common()), best, named, versions)


def _by_cell(seen: PageData, both: tuple[Folder, Folder]) -> dict[str, float]:
    """Return the goal by the parameters and the seed of a cell.

    A parameter that only one of the sweeps varies has the value of that sweep's scenario in all cells of the other.
    """
    targets = {name: target.value for folder in both for name, target in folder.description.targets.items()}
    own = set(seen.folder.targets)
    rows = seen.table.select([*seen.folder.targets, "seed"]).to_pylist()
    keys = [
        repr([row["seed"], *(row[name] if name in own else value for name, value in targets.items())]) for row in rows
    ]
    return dict(zip(keys, seen.goal.values.tolist(), strict=True))
