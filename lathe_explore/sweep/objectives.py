# SPDX-License-Identifier: Apache-2.0
"""Objectives of a tuning: goals, constraints, and the percentile of the cells that counts.

A goal is a column of a row (`lathe_explore.sweep.row`) or a formula of columns to be minimised; a column is maximised
if a minus precedes it. A constraint is a limit of a column or of a formula. With several cells (plants and spindles),
the worst one or a percentile counts. A cell with the status refused, diverged or failed has an infinite cost.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from lathe_explore.sweep import NUMBERS, OF_LEARNING, row
from lathe_explore.sweep.expression import Expression
from lathe_explore.sweep.row import Measure
from lathe_machine.stages.learning.learner import Learner
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, shown
from lathe_rc.names import instead

_CONSTRAINT = re.compile(r"(?P<column>.+?)\s*(?P<sense>>=|<=)\s*(?P<bound>\S+)")


class Goal(NamedTuple):
    """Goal of a tuning: a column or a formula of columns that is minimised, or maximised if ``largest``."""

    formula: Expression
    largest: bool

    @property
    def column(self) -> str:
        """Column or formula as text."""
        return self.formula.text

    @property
    def sign(self) -> float:
        """Sign of the column in the cost; the cost is minimised."""
        return -1.0 if self.largest else 1.0

    def values(self, table: pa.Table) -> NDArray[np.float64]:
        """Return the value in each row of a table, shape (n,); NaN where there is none."""
        return self.formula.numbers(table)


class Constraint(NamedTuple):
    """Constraint of a tuning: a lower limit of a column or of a formula if ``below``, else an upper limit."""

    formula: Expression
    below: bool
    bound: float

    @property
    def column(self) -> str:
        """Column or formula as text."""
        return self.formula.text

    def violation(self, value: float) -> float:
        """Return the violation relative to the limit; 0 or negative if the value is within the limit."""
        beyond = self.bound - value if self.below else value - self.bound
        return beyond / (abs(self.bound) or 1.0)


class Score(NamedTuple):
    """Score of the cells of a trial.

    Attributes:
        costs: costs of the goals, to be minimised; infinite where a cell that counts has no value.
        violations: violations of "the cell runs to its end" and of the constraints; 0 or negative where they are met.
        margin: margin (see `lathe_explore.sweep.row`) of the cell that counts; NaN without a learning cell.
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
        formulas = [goal.formula for goal in self.goals] + [limit.formula for limit in self.constraints]
        named = [name for formula in formulas for name in formula.names]
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


def _cost(cell: Mapping[str, Any], goal: Goal) -> float:
    value = goal.formula.number(cell)
    return goal.sign * value if cell["status"] == row.DONE and math.isfinite(value) else math.inf


def _stops(cell: Mapping[str, Any], goals: Sequence[Goal]) -> float:
    """Return the violation of completing the run with all goals; for an unstable refused cell, its negative margin."""
    if cell["status"] == row.DONE:
        return 0.0 if all(math.isfinite(goal.formula.number(cell)) for goal in goals) else 1.0
    margin = cell["margin"]
    return -margin if margin is not None and margin < 0.0 else 1.0


def _violation(cell: Mapping[str, Any], limit: Constraint) -> float:
    """Return the violation of a constraint by one cell.

    A refused cell may have a margin; other missing values of an incomplete cell are already covered by `_stops`.
    """
    value = limit.formula.number(cell)
    if math.isfinite(value):
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
        goals: ``COLUMN`` or ``-COLUMN``; a column may be ``TOPIC.FIELD:STATISTIC`` or ``NODE.FIGURE``; or a formula of
            columns that is minimised, in which columns with other characters stand in quotes.
        constraints: ``COLUMN>=NUMBER`` or ``COLUMN<=NUMBER``, also with a formula of columns.
        measures: further columns.
        percentile: see `Objectives`.

    Raises:
        InputError: there is no goal, a column is unknown, or a limit is missing.
    """
    if not goals:
        raise InputError(f"no goal; allowed: --goal COLUMN, of {', '.join(NUMBERS)} or TOPIC.FIELD:STATISTIC")
    if not 0.0 < percentile <= 100.0:
        raise InputError(f"percentile {percentile:g}; allowed: above 0 up to 100, which is the worst")
    wanted = [goal(text) for text in goals]
    limits = [_constraint(text) for text in constraints]
    measured = dict.fromkeys(row.measure(text, scenario) for text in measures)
    cell = Cell(scenario.nodes)
    learns = any(isinstance(stage, Learner) for stage in cell.stages.values())
    has_tool, of_loops = row.has_tool(scenario), row.figures(scenario)
    used = [("goal", goal.formula) for goal in wanted] + [("subject", limit.formula) for limit in limits]
    for what, column in ((what, name) for what, formula in used for name in formula.names):
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


def goal(text: str) -> Goal:
    """Parse a goal, ``COLUMN``, ``-COLUMN`` or a formula of columns.

    Raises:
        InputError: the text is no formula, or has no column.
    """
    formula = Expression(text)
    if formula.text.startswith("-"):
        largest = Expression(formula.text[1:])
        if largest.is_column:
            return Goal(largest, largest=True)
    if not formula.names:
        raise InputError(f"goal {shown(text)!r}: no column in it; allowed: COLUMN, -COLUMN or a formula of columns")
    return Goal(formula, largest=False)


def goal_among(text: str, numbers: Sequence[str]) -> Goal:
    """Parse a goal over the columns of a sweep; a margin is maximised.

    Raises:
        InputError: the text is no formula, or has another column.
    """
    found = goal(text)
    if unknown := [name for name in found.formula.names if name not in numbers]:
        raise InputError(
            f"--goal {shown(text)!r}: no such number in a row: {shown(unknown[0])}; {instead(unknown[0], numbers)}"
        )
    return found._replace(largest=found.largest or found.column in OF_LEARNING)


def front(costs: NDArray[np.float64]) -> list[int]:
    """Return the Pareto front of points: those that no other point equals or betters in all costs.

    Args:
        costs: costs of the points, to be minimised, shape (n, goals); NaN: the point is not on the front.

    Returns:
        Indices of the points, by the first cost; of equal points the first.
    """
    found: list[int] = []
    # In this order, only a point already on the front can be at least as good in all costs.
    for place in np.lexsort(costs.T[::-1]).tolist():
        known = not np.isnan(costs[place]).any()
        if known and not (costs[found] <= costs[place]).all(axis=1).any():
            found.append(place)
    return found


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
    return Constraint(Expression(found["column"]), found["sense"] == ">=", bound)
