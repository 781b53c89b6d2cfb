# SPDX-License-Identifier: Apache-2.0
"""Tuning on disk: Optuna's study, and the results of its trials' cells.

Trials are drawn in batches. Each trial has its own random generator, seeded by the search's seed and the trial's
number. The results of a batch are reported to Optuna in the order of the trial numbers. The search therefore depends
neither on the number of processes nor on their timing.
"""

import hashlib
import json
import os
import sys
import warnings
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import distributed
import numpy as np
import optuna
import pyarrow as pa
from optuna.storages import JournalStorage
from optuna.storages.journal import BaseJournalBackend
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from lathe_explore.sweep import BATCH, formulas
from lathe_explore.sweep.folder import Folder, writing
from lathe_explore.sweep.objectives import Score, objectives
from lathe_explore.sweep.search_space import search_space
from lathe_explore.sweep.sweep import Key, Watch, keep, order_of
from lathe_explore.sweep.tuning import Trial, Tuning
from lathe_explore.sweep.workers import Job, rows
from lathe_rc.cell.parameters import Value
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.files import open_file

_STUDY = "tuning"
_POPULATION = 3 * BATCH  # population of NSGA-II
_UNKNOWN = 1e9  # stands for an infinite cost, which the samplers do not accept; larger than all other costs
_CHECKSUM = "checksum"  # key of a journal line's checksum, stored in the line itself
_SCORE = "score"  # attribute of a trial: its result


class _Journal(BaseJournalBackend):
    """Optuna journal with a checksum in each line; lines of older versions have none.

    Optuna's own class mistakes a damaged last line for an unfinished one and skips it. Here only a process that holds
    the folder's lock writes, so every damaged line is an error.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._starts = path, [0]
        self.line = 0  #: number of the last line read
        path.touch()
        if self._cut():
            print(f"lathe: {path}: the last line is not whole: left out, and done again", file=sys.stderr)

    def _cut(self) -> bool:
        """Remove an incomplete last line; the next line would be appended to it, and both would be unreadable."""
        with open(self._path, "rb+", opener=open_file) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 1, 0))
            if file.read() in (b"", b"\n"):
                return False
            file.seek(0)
            file.truncate(file.read().rfind(b"\n") + 1)
        return True

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Append lines to the journal and flush them to the disk."""
        self._cut()
        lines = (json.dumps(log | {_CHECKSUM: _checksum(log)}, separators=(",", ":")) + "\n" for log in logs)
        with open(self._path, "ab", opener=open_file) as file:
            file.write("".join(lines).encode())
            file.flush()
            os.fsync(file.fileno())

    def read_logs(self, log_number_from: int) -> Generator[dict[str, Any]]:
        """Yield the journal's lines, starting at line number ``log_number_from``.

        Raises:
            InputError: a line is damaged.
        """
        with open(self._path, "rb", opener=open_file) as file:
            file.seek(self._starts[log_number_from])  # Optuna reads often, each time starting at its last line
            for self.line, line in enumerate(file, log_number_from + 1):
                if not line.endswith(b"\n"):  # the line is still being written
                    return
                self._starts[self.line :] = [self._starts[self.line - 1] + len(line)]
                try:
                    log = json.loads(line)
                except ValueError as error:
                    raise self.refusal(error) from None
                if not isinstance(log, dict):
                    raise self.refusal("no log")
                checksum = _checksum(log)
                if log.pop(_CHECKSUM, checksum) != checksum:
                    raise self.refusal("its checksum is that of another content")
                yield log

    def refusal(self, reason: object) -> InputError:
        """Return the error for the line read last."""
        return InputError(
            f"{self._path}, line {self.line}: no journal of Optuna, or damaged ({shown(reason)}); "
            "allowed: as it was written, or a new folder"
        )


def _checksum(log: Mapping[str, Any]) -> str:
    text = json.dumps({name: value for name, value in log.items() if name != _CHECKSUM})
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _opened(path: Path, goals: int) -> tuple[JournalStorage, optuna.Study]:
    """Open a journal and its study.

    Raises:
        InputError: the journal cannot be read.
    """
    try:
        journal = _Journal(path)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or shown(error)}") from None
    try:
        storage = JournalStorage(journal)
        directions = [StudyDirection.MINIMIZE] * goals
        return storage, optuna.create_study(
            study_name=_STUDY, storage=storage, directions=directions, load_if_exists=True
        )
    except (LatheError, OSError):
        raise
    except Exception as error:  # noqa: BLE001 - Optuna lets through whatever a foreign line leads to
        raise journal.refusal(f"{type(error).__name__}: {error}") from None


class TuningStudy:
    """Tuning on disk: Optuna's study, and the rows of its trials.

    Attributes:
        count: number of cells per trial.
    """

    def __init__(self, folder: Folder) -> None:
        assert folder.tuning is not None, "a tuning"
        self._folder, self._asked, scenario = folder, folder.tuning, folder.scenario
        self._objectives = objectives(
            scenario,
            self._asked.goals,
            self._asked.subjects,
            measures=[each.name for each in folder.measures],
            percentile=self._asked.percentile,
        )
        self._space = search_space(scenario, self._asked.free)
        self.count = self._asked.over.count(scenario)
        self._start = {target: scenario.value(target) for target in self._space}
        margins = [each.bound for each in self._objectives.constraints if each.column == "margin" and each.below]
        self._formulas = formulas.settings(scenario, list(self._space), *margins[:1]) if self._asked.formulas else {}
        self._key = Key(folder)
        self._known: dict[str, dict[str, Any]] = {}
        self._take(folder.table(["key", *self._objectives.columns]))
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        with writing(folder.path), folder.locked(wait=True):
            self._storage, self._study = _opened(folder.path / "trials.log", len(self._objectives.goals))
            if not self._study.get_trials(deepcopy=False):
                with _quiet():
                    self._study.set_metric_names(
                        [f"-{goal.column}" if goal.largest else goal.column for goal in self._objectives.goals]
                    )
                given = self._start | {target: found.value for target, found in self._formulas.items()}
                for values in [self._start, given] if given != self._start else [given]:
                    if all(dimension.contains(values[target]) for target, dimension in self._space.items()):
                        self._study.enqueue_trial(
                            {name: each.encoded(values[name]) for name, each in self._space.items()}
                        )

    def count_trials(self) -> int:
        """Return the number of computed trials."""
        return len(self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))

    def ask(self, most: int) -> list[FrozenTrial]:
        """Return the next batch: trials that a stopped process has left, and new ones up to a total of ``most``."""
        with writing(self._folder.path), self._folder.locked(wait=True), _quiet():
            there = self._study.get_trials(deepcopy=False)
            asked = [trial for trial in there if trial.state != TrialState.WAITING]
            left = [trial.number for trial in asked if trial.state == TrialState.RUNNING]
            number, batch = len(asked), self._asked.batch
            # Batches end at multiples of their size, even after a restart, so that each trial uses the same results.
            missing = batch - number % batch if number % batch or not left else 0
            for _ in range(max(0, min(missing, most - number))):
                self._study.sampler = self._sampler(number)
                left.append(self._study.ask().number)
                number += 1
            left = left[:batch]
            for each in left:
                self._study.sampler = self._sampler(each)
                trial = self._trial(each)
                for target, dimension in self._space.items():  # a stopped process may not have drawn all values
                    dimension.suggest(trial, target)
            return [trial for trial in self._study.get_trials() if trial.number in left]

    def _trial(self, number: int) -> optuna.Trial:
        study = self._storage.get_study_id_from_name(_STUDY)
        return optuna.Trial(self._study, self._storage.get_trial_id_from_study_id_trial_number(study, number))

    def _sampler(self, number: int) -> optuna.samplers.BaseSampler:
        """Return a sampler for one trial, with a separate seed."""
        seed = int(np.random.SeedSequence([self._asked.seed, number]).generate_state(1)[0])
        if self._asked.sampler == "cmaes":
            return optuna.samplers.CmaEsSampler(x0=self._start, seed=seed)
        if self._asked.sampler == "nsga2":
            return optuna.samplers.NSGAIISampler(population_size=_POPULATION, seed=seed)
        return optuna.samplers.TPESampler(multivariate=True, seed=seed)

    def compute(
        self, crew: distributed.Client, asked: Sequence[FrozenTrial], watch: Watch, cell_time: float | None = None
    ) -> None:
        """Compute the cells of a batch and report the scores to Optuna."""
        jobs = {trial.number: self._jobs(trial) for trial in asked}
        missing = {job.key: job for each in jobs.values() for job in each if job.key not in self._known}
        found = rows(crew, order_of(self._folder), missing.values(), len(missing), cell_time)
        keep(self._folder, found, watch, self._take)
        with writing(self._folder.path), self._folder.locked(wait=True), _quiet():
            for number, each in jobs.items():
                self._tell(number, self._objectives.score(self._known[job.key] for job in each))
            tuning = self.tuning()
            if best := tuning.best:
                tuning.write(best, self._folder.path / "best.yaml")
        watch({"event": "told", "tuning": tuning})

    def _take(self, table: pa.Table) -> None:
        for found in table.select(["key", *self._objectives.columns]).to_pylist():
            self._known[found.pop("key")] = found

    def _values(self, trial: FrozenTrial) -> dict[str, Value]:
        return {target: dimension.value(trial.params[target]) for target, dimension in self._space.items()}

    def _jobs(self, trial: FrozenTrial) -> list[Job]:
        values = self._values(trial)
        given = [{**values, **each} for each in self._asked.over.given or ({},)]
        cells = replace(self._asked.over, given=given).cells(self._folder.scenario)
        first = trial.number * self.count
        return [self._key.job(first + place, each) for place, each in enumerate(cells)]

    def _tell(self, number: int, score: Score) -> None:
        trial = self._trial(number)
        trial.set_user_attr(_SCORE, [list(score.costs), list(score.violations), score.margin])
        for place, violation in enumerate(score.violations):
            trial.set_constraint(str(place), violation)
        known = [min(cost, _UNKNOWN) for cost in score.costs]
        # CMA-ES has no constraints, so an infeasible trial costs more than all others, increasing with its violation.
        if self._asked.sampler == "cmaes" and not score.feasible:
            known = [_UNKNOWN * (1.0 + sum(max(violation, 0.0) for violation in score.violations))]
        self._study.sampler = self._sampler(number)
        self._study.tell(number, known)

    def tuning(self) -> Tuning:
        """Return the tuning with its trials so far."""
        found = []
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            if _SCORE not in trial.user_attrs or not trial.params.keys() >= self._space.keys():
                raise InputError(
                    f"{self._folder.path / 'trials.log'}: trial {trial.number} is another program's; allowed: as "
                    "lathe tune has written it, or a new folder"
                )
            costs, violations, margin = cast("tuple[list[float], list[float], float]", trial.user_attrs[_SCORE])
            found.append(Trial(trial.number, self._values(trial), Score(tuple(costs), tuple(violations), margin)))
        return Tuning(self._folder, self._objectives, self._asked.over, found, self._formulas)


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Optuna's warnings about experimental features."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
