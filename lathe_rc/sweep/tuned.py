# SPDX-License-Identifier: Apache-2.0
"""The result of a tuning: its trials, the best of them, and the values by formulas."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lathe_rc import files
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError
from lathe_rc.sweep.aims import Aims, Score
from lathe_rc.sweep.folder import Folder, writing
from lathe_rc.sweep.formulas import Found
from lathe_rc.sweep.space import Space
from lathe_rc.sweep.sweep import Sweep


class Trial(NamedTuple):
    """One trial.

    Attributes:
        number: of it; 0 is the start, the scenario's own parameters.
        values: of the free parameters.
        score: what came of its cells.
    """

    number: int
    values: Mapping[str, Value]
    score: Score


@dataclass(frozen=True, repr=False)
class Tuning:
    """The result of a tuning.

    Attributes:
        folder: where it is.
        aims: what was wanted.
        over: the plants and spindles of each trial.
        trials: that are computed, in order.
        formulas: what formulas give, by free parameter, where there is one.
    """

    folder: Folder
    aims: Aims
    over: Space
    trials: Sequence[Trial]
    formulas: Mapping[str, Found] = field(default_factory=dict)

    def __repr__(self) -> str:
        """The scenario and its best trial."""
        told = "nothing feasible"
        if best := self.best:
            costs = zip(self.aims.goals, best.score.costs, strict=True)
            told = ", ".join(f"{goal.column} = {goal.sign * cost:.4g}" for goal, cost in costs)
            told = f"{told} in trial {best.number}"
        return f"<Tuning of {self.folder.scenario.name} in {self.folder.path}: {len(self.trials)} trials, {told}>"

    @property
    def sweep(self) -> Sweep:
        """All cells of all trials."""
        return Sweep(self.folder)

    @property
    def start(self) -> Trial | None:
        """The scenario's own parameters; None if they are not computed yet."""
        return next((trial for trial in self.trials if trial.number == 0), None)

    @property
    def by_formula(self) -> Trial | None:
        """The trial with what the formulas give; None: they give nothing, or it is outside of the ranges."""
        given = {target: found.value for target, found in self.formulas.items()}
        scenario = self.folder.scenario

        def own(trial: Trial) -> dict[str, Value]:
            return {target: given.get(target, scenario.value(target)) for target in trial.values}

        return next((trial for trial in self.trials if given and trial.values == own(trial)), None)

    @property
    def front(self) -> list[Trial]:
        """The trials that no other is better than in all goals, by the first goal; of one goal, the best."""
        found: list[Trial] = []
        least = math.inf
        feasible = [trial for trial in self.trials if trial.score.feasible]
        for trial in sorted(feasible, key=lambda trial: (trial.score.costs, trial.number)):
            if len(self.aims.goals) == 1:
                return [trial]
            if len(self.aims.goals) == 2:
                if trial.score.costs[1] < least:
                    found.append(trial)
                    least = trial.score.costs[1]
            elif not any(_dominates(other.score, trial.score) for other in feasible):
                found.append(trial)
        return found

    @property
    def best(self) -> Trial | None:
        """The best trial; of several goals, that of the front nearest to the best of each. None: none is feasible."""
        front = self.front
        if not front:
            return None
        costs = np.array([trial.score.costs for trial in front])
        span = np.ptp(costs, axis=0)
        distance = np.linalg.norm((costs - costs.min(axis=0)) / np.where(span > 0.0, span, 1.0), axis=1)
        return front[int(np.argmin(distance))]

    def scenario(self, trial: Trial) -> Scenario:
        """The cell with a trial's parameters, on its own plant and spindle."""
        return self.folder.scenario.varied(trial.values)

    def trial(self, number: int) -> Trial:
        """A trial by its number.

        Raises:
            InputError: there is none, or it is not computed.
        """
        known = {trial.number: trial for trial in self.trials}
        if number not in known:
            last = f"0 to {max(known)}, of those that are computed" if known else "none: nothing is computed"
            raise InputError(f"trial {number} of {self.folder.path}; allowed: {last}")
        return known[number]

    def write(self, trial: Trial, path: Path) -> None:
        """Write the cell with a trial's parameters as a parameter file that ``lathe run`` takes.

        Raises:
            LatheError: it cannot be written.
        """
        text = f"# Trial {trial.number} of the tuning {self.folder.path} of {self.folder.scenario.name}.\n"
        with writing(path.parent), files.replacing(path) as stream:
            stream.write((text + self.scenario(trial).to_yaml(given=True)).encode())


def _dominates(one: Score, other: Score) -> bool:
    pairs = list(zip(one.costs, other.costs, strict=True))
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)
