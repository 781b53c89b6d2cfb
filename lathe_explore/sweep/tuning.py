# SPDX-License-Identifier: Apache-2.0
"""Result of a tuning: its trials, the best trial, and the values given by formulas."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lathe_explore.sweep import row
from lathe_explore.sweep.folder import Folder, writing
from lathe_explore.sweep.formulas import FormulaValue
from lathe_explore.sweep.objectives import Objectives, Score, front
from lathe_explore.sweep.space import Space
from lathe_explore.sweep.sweep import Sweep
from lathe_rc import files
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError


class Trial(NamedTuple):
    """Trial of a tuning.

    Attributes:
        number: number of the trial; trial 0 has the scenario's own parameters.
        values: values of the free parameters, by target.
        score: score of the trial's cells.
    """

    number: int
    values: Mapping[str, Value]
    score: Score


@dataclass(frozen=True, repr=False)
class Tuning:
    """Result of a tuning.

    Attributes:
        folder: folder of the tuning.
        objectives: goals and constraints.
        over: plants and spindles on which each trial is evaluated, as a space.
        trials: computed trials, in order.
        formulas: values given by formulas, for free parameters that have a formula.
    """

    folder: Folder
    objectives: Objectives
    over: Space
    trials: Sequence[Trial]
    formulas: Mapping[str, FormulaValue] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return the scenario and its best trial as a string."""
        told = "nothing feasible"
        if best := self.best:
            told = ", ".join(f"{column} = {value:.4g}" for column, value in self.goals(best).items())
            told = f"{told} in trial {best.number}"
        return f"<Tuning of {self.folder.scenario.name} in {self.folder.path}: {len(self.trials)} trials, {told}>"

    @property
    def sweep(self) -> Sweep:
        """Sweep with all cells of all trials."""
        return Sweep(self.folder)

    @property
    def cells(self) -> int:
        """Number of cells per trial."""
        return self.over.count(self.folder.scenario)

    @property
    def feasible(self) -> list[Trial]:
        """Feasible trials, which meet all constraints."""
        return [trial for trial in self.trials if trial.score.feasible]

    @property
    def start(self) -> Trial | None:
        """Trial with the scenario's own parameters; None if it is not computed yet."""
        return next((trial for trial in self.trials if trial.number == 0), None)

    @property
    def by_formula(self) -> Trial | None:
        """Trial with the values given by formulas; None if there are no such values, or they are out of range."""
        given = {target: found.value for target, found in self.formulas.items()}
        scenario = self.folder.scenario

        def own(trial: Trial) -> dict[str, Value]:
            return {target: given.get(target, scenario.value(target)) for target in trial.values}

        return next((trial for trial in self.trials if given and trial.values == own(trial)), None)

    @property
    def improvements(self) -> list[Trial]:
        """Successive improvements: trials with a better first goal than all earlier ones."""
        found: list[Trial] = []
        for trial in self.feasible:
            if not found or trial.score.costs[0] < found[-1].score.costs[0]:
                found.append(trial)
        return found

    @property
    def front(self) -> list[Trial]:
        """Pareto front of the feasible trials, sorted by the first goal; for one goal, only the best trial."""
        trials = self.feasible
        return [trials[place] for place in front(np.array([trial.score.costs for trial in trials]))] if trials else []

    @property
    def best(self) -> Trial | None:
        """Best trial: for several goals, the one on the front nearest to the best of each; None if none is feasible."""
        trials = self.front
        if not trials:
            return None
        # Each goal is scaled by its span over the front: goals have different units.
        costs = np.array([trial.score.costs for trial in trials])
        span = np.ptp(costs, axis=0)
        distance = np.linalg.norm((costs - costs.min(axis=0)) / np.where(span > 0.0, span, 1.0), axis=1)
        return trials[int(np.argmin(distance))]

    def goals(self, trial: Trial) -> dict[str, float]:
        """Return the goal values of a trial, by column [SI units]; infinite for missing values."""
        pairs = zip(self.objectives.goals, trial.score.costs, strict=True)
        return {goal.column: goal.sign * cost for goal, cost in pairs}

    def goals_shown(self, trial: Trial) -> dict[str, str]:
        """Format the goal values of a trial with their units, by column."""
        found = {}
        for column, value in self.goals(trial).items():
            factor, name = row.unit(column, self.folder.scenario)
            found[column] = f"{value * factor:.4g} {name}".rstrip() if math.isfinite(value) else "none"
        return found

    def results(self, trial: Trial) -> dict[str, str]:
        """Format the goals and the margin of a trial, by name."""
        percentile = self.objectives.percentile
        which = "" if self.cells == 1 else ", worst" if percentile == 100.0 else f", {percentile:g} %"
        found = {f"{name}{which}": value for name, value in self.goals_shown(trial).items()}
        if not math.isnan(trial.score.margin):
            found[f"margin{which}"] = f"{trial.score.margin:.4g}"
        return found

    def compared(self) -> tuple[list[str], list[list[str]], list[list[str]]]:
        """Return columns, rows of parameters and rows of results of a table of start, best trial and formulas."""
        start, best = self.start, self.best
        if start is None or best is None:
            return ["", "start", "best"], [], []

        def text(value: object) -> str:
            return f"{value:.6g}" if isinstance(value, float) else str(value)

        given = {target: text(found.value) for target, found in self.formulas.items()}
        columns = ["", "start", "best", *(["by formula"] if given else [])]
        values = [
            [target, text(start.values[target]), text(value), *([given.get(target, "")] if given else [])]
            for target, value in best.values.items()
        ]
        trials = [trial for trial in (start, best, self.by_formula) if trial]
        found = [self.results(trial) for trial in trials]
        rows = [[name, *(result.get(name, "") for result in found)] for name in found[0]]
        rows.append(["meets all subjects", *("yes" if trial.score.feasible else "no" for trial in trials)])
        return columns, values, rows

    def scenario(self, trial: Trial) -> Scenario:
        """Return the scenario with a trial's parameters and the nominal plant and spindle."""
        return self.folder.scenario.varied(trial.values)

    def trial(self, number: int) -> Trial:
        """Return a trial by its number.

        Raises:
            InputError: the trial does not exist, or is not computed yet.
        """
        known = {trial.number: trial for trial in self.trials}
        if number not in known:
            last = f"0 to {max(known)}, of those that are computed" if known else "none: nothing is computed"
            raise InputError(f"trial {number} of {self.folder.path}; allowed: {last}")
        return known[number]

    def write(self, trial: Trial, path: Path) -> None:
        """Write the cell with a trial's parameters as a parameter file for ``lathe run``.

        Raises:
            LatheError: the file cannot be written.
        """
        text = f"# Trial {trial.number} of the tuning {self.folder.path} of {self.folder.scenario.name}.\n"
        with writing(path.parent), files.replacing(path) as stream:
            stream.write((text + self.scenario(trial).to_yaml(given=True)).encode())
