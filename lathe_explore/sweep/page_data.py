# SPDX-License-Identifier: Apache-2.0
"""Data for the page of a sweep: parameters as axes, goals, and the results of the cells."""

from collections import Counter
from dataclasses import replace
from functools import cached_property

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from lathe_explore.sweep import NUMBERS, OF_LEARNING
from lathe_explore.sweep.effects import Axis
from lathe_explore.sweep.figures import Goal, said
from lathe_explore.sweep.folder import Folder
from lathe_explore.sweep.objectives import goal_among
from lathe_rc.errors import shown

_LARGE = OF_LEARNING  # goals that are better the larger they are
_MOST_TEXTS = 24  # strings of an axis with separate colours; the others share one


class PageData:
    """Rows of a sweep, prepared for its page.

    Args:
        folder: folder of the sweep.
        goal: column or formula of columns by which the cells are ranked, see `lathe_explore.sweep.objectives`; empty:
            the largest error of the part, or of the first loop.

    Attributes:
        folder: see above.
        goals: possible goals: columns with a value in at least one cell.
        goal: the chosen goal.
        axes: parameters that differ between the cells.
        cells: numbers of the computed cells.
        table: the rows, without the columns of values by revolution.

    Raises:
        InputError: there is no such goal.
    """

    def __init__(self, folder: Folder, goal: str = "") -> None:
        known = [*NUMBERS, *(each.name for each in folder.measures)]
        asked = goal_among(goal or folder.description.goal, folder.numbers)
        formula = asked.formula
        self.folder = folder
        self.table = folder.table(["cell", "status", "reason", "limits", "seed", *folder.targets, *known])
        self.cells: NDArray[np.int64] = self.table.column("cell").to_numpy()
        if formula.text not in known:
            self.table = self.table.append_column(formula.text, pa.array(asked.values(self.table)))
            known.append(formula.text)
        found = [self._goal(name) for name in known]
        place = known.index(formula.text)
        self.goal = found[place] = replace(found[place], above=asked.largest)
        self.goals = [each for each in found if np.isfinite(each.values).any()]
        axes = [self._axis(target) for target in folder.targets]
        self.axes = [axis for axis in axes if axis.distinct.size > 1]

    def _goal(self, name: str) -> Goal:
        values = self.table.column(name).to_numpy().astype(np.float64)
        factor, unit = self.folder.description.unit(name)
        values = np.where(np.isfinite(values), values * factor, np.nan)
        return Goal(name, f"{name} [{unit}]" if unit else name, unit, values, name in _LARGE)

    def _axis(self, target: str) -> Axis:
        column = self.table.column(target)
        found = column.to_pylist()
        if pa.types.is_list(column.type) and all(value is None or len(value) == 1 for value in found):
            found = [None if value is None else value[0] for value in found]  # lists of one number are numbers
        tied = any(target in space.ties for space in self.folder.spaces)
        unit = self.folder.description.targets[target].unit
        label = target if unit in ("", "1") else f"{target} [{unit}]"
        if all(value is None or (isinstance(value, int | float) and not isinstance(value, bool)) for value in found):
            values = np.array([np.nan if value is None else value for value in found], dtype=np.float64)
            log = any(told.endswith(":log") for told in self._told(target)) and bool(np.nanmin(values) > 0.0)
            return Axis(target, label, values, log=log, tied=tied)
        texts = [None if value is None else text_of(value) for value in found]
        names = list(dict.fromkeys(text for text in texts if text is not None))
        names = sorted(names) if set(names) <= {"true", "false"} else names
        if len(names) > _MOST_TEXTS:
            names = [*names[: _MOST_TEXTS - 1], f"{len(names) - _MOST_TEXTS + 1} others"]
        place = {name: float(index) for index, name in enumerate(names)}
        values = np.array([np.nan if text is None else place.get(text, _MOST_TEXTS - 1.0) for text in texts])
        return Axis(target, target, values, texts=names, tied=tied)

    def _told(self, target: str) -> list[str]:
        """Return the variation of a target in each space, in the notation of the request."""
        found: list[str] = []
        for space in self.folder.spaces:
            if (axis := space.grid.get(target)) is not None:
                found.append(axis if isinstance(axis, str) else ", ".join(text_of(value) for value in axis))
            if target in space.sampled:
                found.append(space.sampled[target])
            if target in space.ties:
                found.append(f"= {space.ties[target]}")
            if any(target in cell for cell in space.given):
                found.append("cell by cell")
        return list(dict.fromkeys(found))

    def asked(self) -> list[list[str]]:
        """Return one row per target: label, request, lowest, highest, number of values, and the scenario's value."""
        found = []
        axes = {axis.name: axis for axis in self.axes}
        for target in self.folder.targets:
            told, own = "; ".join(self._told(target)), text_of(self.folder.description.targets[target].value)
            axis = axes.get(target)
            if axis is None:
                found.append([target, told, "", "", "1", own])
                continue
            ends = ["", ""] if axis.texts else [said(float(axis.distinct[0])), said(float(axis.distinct[-1]))]
            found.append([axis.label, told, *ends, str(axis.distinct.size), own])
        return found

    @cached_property
    def statuses(self) -> Counter[str]:
        """Number of cells by status."""
        return Counter(self.table.column("status").to_pylist())

    @cached_property
    def seeds(self) -> int:
        """Number of different seeds in the cells."""
        return len(set(self.table.column("seed").to_pylist()) - {None})

    @property
    def lot(self) -> int:
        """Number of cells that depend on the same drawn point: more than one in a Saltelli sample."""
        spaces = self.folder.spaces
        is_saltelli = len(spaces) == 1 and spaces[0].sample.startswith("saltelli") and spaces[0].seeds == 1
        return len(spaces[0].sampled) + 2 if is_saltelli else 1

    @property
    def is_sampled(self) -> bool:
        """Whether all cells are sample points, so that their shares are estimates for the population."""
        return all(space.sample and not space.grid and not space.given for space in self.folder.spaces)

    @property
    def tolerance(self) -> float | None:
        """Tolerance of the goal's error, in the unit of the goal; None: not set, varied, or of another goal."""
        if any(target.endswith(".tolerance") for target in self.folder.targets):
            return None
        about, name = self.folder.description, self.goal.name
        return about.tolerances[name] * about.unit(name)[0] if name in about.tolerances else None


def text_of(value: object) -> str:
    """Format a parameter value for the page."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.6g}"
    return shown(value) if value != "" else "(empty)"
