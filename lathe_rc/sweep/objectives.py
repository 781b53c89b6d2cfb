# SPDX-License-Identifier: Apache-2.0
"""Objectives of a tuning: goals, constraints, and the percentile of the cells that counts.

A goal is a column of a row (`lathe_rc.sweep.row`) to be minimised, or to be maximised if a minus precedes it. A
constraint is a limit of a column. With several cells (plants and spindles), the worst one or a percentile counts. A
cell with the status refused, diverged or failed has an infinite cost.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stages.learner import Learner
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, shown
from lathe_rc.names import instead
from lathe_rc.sweep import NUMBERS, OF_LEARNING, row
from lathe_rc.sweep.row import Measure

_CONSTRAINT = re.compile(r"(?P<column>.+?)\s*(?P<sense>>=|<=)\s*(?P<bound>\S+)")


class Goal(NamedTuple):
    """Goal of a tuning: a column that is minimised, or maximised if ``largest``."""

    column: str
    largest: bool

    @property
    def sign(self) -> float:
        """Sign of the column in the cost; the cost is minimised."""
        return -1.0 if self.largest else 1.0


class Constraint(NamedTuple):
    """Constraint of a tuning: a lower limit of a column if ``below``, else an upper limit."""

    column: str
    below: bool
    bound: float

    def violation(self, value: float) -> float:
        """Return the violation relative to the limit; 0 or negative if the value is within the limit."""
        beyond = self.bound - value if self.below else value - self.bound
        return beyond / (abs(self.bound) or 1.0)


class Score(NamedTuple):
    """Score of the cells of a trial.

    Attributes:
        costs: costs of the goals, to be minimised; infinite where a cell that counts has no value.
        violations: violations of "the cell runs to its end" and of the constraints; 0 or negative where they are met.
        margin: margin (see `lathe_rc.sweep.row`) of the cell that counts; NaN without a learning cell.
    """

    costs: tuple[float, ...]
    violations: tuple[float, ...]
    margin: float

    @property
    def feasible(self) -> bool:
        """Whether the trial meets all constraints."""
        return all(violation <= 0.0 for violation in self.violations)


@dataclass(frozen=True)
class Objectives:
    """Objectives of a tuning.

    Attributes:
        goals: one goal, or several for a Pareto front.
        constraints: limits that the trials have to meet.
        percentile: percentile of the cells that counts; 100: the worst.
        measures: further columns used by goals and constraints.
    """

    goals: Sequence[Goal]
    constraints: Sequence[Constraint]
    percentile: float
    measures: Sequence[Measure]

    @property
    def columns(self) -> list[str]:
        """Columns needed to compute a score."""
        named = [goal.column for goal in self.goals] + [limit.column for limit in self.constraints]
        return list(dict.fromkeys(["status", "margin", *named]))

    def score(self, rows: Iterable[Mapping[str, Any]]) -> Score:
        """Return the score of the cells of a trial.

        Args:
            rows: rows of the trial's cells with `columns`, at least one.
        """
        cells = list(rows)
        costs = [self._counts(_cost(cell, goal) for cell in cells) for goal in self.goals]
        violations = [self._counts(_stops(cell, self.goals) for cell in cells)]
        violations += [self._counts(_violation(cell, limit) for cell in cells) for limit in self.constraints]
        margins = [-cell["margin"] for cell in cells if cell["margin"] is not None]
        margin = -self._counts(margins) if margins else math.nan
        return Score(tuple(costs), tuple(violations), margin)

    def _counts(self, values: Iterable[float]) -> float:
        """Return the percentile of the cells' values, where smaller values are better."""
        # The inverted distribution returns one of the values: interpolation between infinite values would give NaN.
        return float(np.percentile(list(values), self.percentile, method="inverted_cdf"))


def _known(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _cost(cell: Mapping[str, Any], goal: Goal) -> float:
    value = cell[goal.column]
    return goal.sign * value if cell["status"] == row.DONE and _known(value) else math.inf


def _stops(cell: Mapping[str, Any], goals: Sequence[Goal]) -> float:
    """Return the violation of completing the run with all goals; for an unstable refused cell, its negative margin."""
    if cell["status"] == row.DONE:
        return 0.0 if all(_known(cell[goal.column]) for goal in goals) else 1.0
    margin = cell["margin"]
    return -margin if _known(margin) and margin < 0.0 else 1.0


def _violation(cell: Mapping[str, Any], limit: Constraint) -> float:
    """Return the violation of a constraint by one cell.

    A refused cell may have a margin; other missing values of an incomplete cell are already covered by `_stops`.
    """
    value = cell[limit.column]
    if _known(value):
        return limit.violation(value)
    return 0.0 if cell["status"] != row.DONE else 1.0


def objectives(
    scenario: Scenario,
    goals: Sequence[str],
    constraints: Sequence[str] = (),
    *,
    measures: Sequence[str] = (),
    percentile: float = 100.0,
) -> Objectives:
    """Parse the goals and constraints of a tuning.

    Args:
        scenario: scenario to be tuned.
        goals: ``COLUMN`` or ``-COLUMN``; a column may be ``TOPIC.FIELD:STATISTIC`` or ``NODE.FIGURE``.
        constraints: ``COLUMN>=NUMBER`` or ``COLUMN<=NUMBER``.
        measures: further columns.
        percentile: see `Objectives`.

    Raises:
        InputError: there is no goal, a column is unknown, or a limit is missing.
    """
    if not goals:
        raise InputError(f"no goal; allowed: --goal COLUMN, of {', '.join(NUMBERS)} or TOPIC.FIELD:STATISTIC")
    if not 0.0 < percentile <= 100.0:
        raise InputError(f"percentile {percentile:g}; allowed: above 0 up to 100, which is the worst")
    wanted = [Goal(text.strip().removeprefix("-"), text.strip().startswith("-")) for text in goals]
    limits = [_constraint(text) for text in constraints]
    measured = dict.fromkeys(row.measure(text, scenario) for text in measures)
    cell = Cell(scenario.nodes)
    learns = any(isinstance(stage, Learner) for stage in cell.stages.values())
    has_tool, of_loops = row.has_tool(scenario), row.figures(scenario)
    for what, column in [("goal", goal.column) for goal in wanted] + [("subject", limit.column) for limit in limits]:
        if ":" in column or column in of_loops:
            measured[row.measure(column, scenario)] = None
        elif column not in NUMBERS:
            told = instead(column, [*NUMBERS, *of_loops])
            told = told if told.startswith("allowed") else f"{told} (or TOPIC.FIELD:STATISTIC)"
            raise InputError(f"{what} {shown(column)!r}: no such column; {told}")
        elif not (learns if column in OF_LEARNING else has_tool):
            missing = "learning controller" if column in OF_LEARNING else "tool"
            raise InputError(
                f"{what} {column}: there is no {missing} in {scenario.name}; "
                f"allowed: {next(iter(of_loops), f'TOPIC.FIELD:STATISTIC, such as {next(iter(cell.dense))}.FIELD:rms')}"
            )
    if len({goal.column for goal in wanted}) < len(wanted):
        raise InputError("a goal is given twice; allowed: each once")
    return Objectives(wanted, limits, percentile, list(measured))


def _constraint(text: str) -> Constraint:
    found = _CONSTRAINT.fullmatch(text.strip())
    allowed = "allowed: COLUMN>=NUMBER or COLUMN<=NUMBER, such as margin>=0.2"
    if not found:
        raise InputError(f"subject {shown(text)!r}; {allowed}")
    try:
        bound = float(found["bound"])
    except ValueError:
        bound = math.nan
    if not math.isfinite(bound):
        raise InputError(f"subject {shown(text)!r}: {shown(found['bound'])!r} is no number; {allowed}")
    return Constraint(found["column"], found["sense"] == ">=", bound)
