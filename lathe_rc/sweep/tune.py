# SPDX-License-Identifier: Apache-2.0
"""Tuning: parameters of a cell searched by Optuna, its trials computed by the workers of a sweep; see `run`.

DIR/trials.log       Optuna's journal: what was asked, and what came of it
DIR/running/         a lock for each program that computes; who died is known by it
DIR/best.yaml        the cell with the best trial's parameters
DIR/front/           of several goals, the cells of all trials that no other is better than
DIR, the rest        see `lathe_rc.sweep.folder`: cell n of trial m is the row m * (cells of a trial) + n

Trials are asked for a batch at a time. Each is drawn with a random generator of its own, from the seed and its number,
and what came of a batch is told in the order of the numbers: the same search, whoever computes it and when.
"""

import json
import math
import uuid
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import distributed
import filelock
import numpy as np
import optuna
import pyarrow as pa
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState

from lathe_rc import files
from lathe_rc.cell.ahead import compile_ahead
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.names import instead
from lathe_rc.sweep import formulas
from lathe_rc.sweep.aims import Aims, Score, aims
from lathe_rc.sweep.folder import Folder, writing
from lathe_rc.sweep.formulas import Found
from lathe_rc.sweep.free import Free, frees
from lathe_rc.sweep.space import Space, value_of
from lathe_rc.sweep.sweep import Key, Sweep, Watch, ignore, keep, order_of
from lathe_rc.sweep.workers import Job, client_of, rows

SAMPLERS = ("tpe", "cmaes", "nsga2")
BATCH = 8  #: trials that are asked for at once
_STUDY = "tuning"
_POPULATION = 3 * BATCH  # of NSGA-II
_UNKNOWN = 1e9  # what the samplers are told in place of a cost that there is not: beyond all that there are
_BY, _SCORE = "by", "score"  # attributes of a trial: who computes it, what came of it


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
    """What a tuning gave.

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
        """What it is of, and what its best is."""
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
            return {target: given.get(target, value_of(scenario, target)) for target in trial.values}

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

    @staticmethod
    def load(path: Path) -> "Tuning":
        """The tuning of a folder.

        Raises:
            InputError: it holds none.
        """
        folder = Folder(path)
        if folder.tuning is None:
            raise InputError(f"{path} holds a sweep; allowed: a folder that lathe tune has written")
        return _State(folder).tuning()


def _dominates(one: Score, other: Score) -> bool:
    pairs = list(zip(one.costs, other.costs, strict=True))
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def run(
    scenario: Scenario,
    free: Mapping[str, str | Sequence[Value]],
    goals: Sequence[str],
    folder: Path,
    *,
    subjects: Sequence[str] = (),
    over: Space | None = None,
    percentile: float = 100.0,
    trials: int = 100,
    sampler: str = "tpe",
    seed: int = 0,
    batch: int = BATCH,
    ask_formulas: bool = True,
    measures: Sequence[str] = (),
    scheduler: str | None = None,
    workers: int | None = None,
    client: distributed.Client | None = None,
    watch: Watch = ignore,
) -> Tuning:
    """Search parameters of a cell; what the folder has already is not computed again.

    Args:
        scenario: the cell; its own parameters are the start, trial 0. It needs a number of revolutions.
        free: what is searched, by ``NODE.PARAM``: ``LOW:HIGH``, ``LOW:HIGH:log``, or values: ``A,B,C`` or a list.
        goals: columns of a row, see `lathe_rc.sweep.aims`; several are traded off.
        folder: of the results. Several programs, on this machine or others, may compute into it at the same time.
        subjects: what has to be met.
        over: plants and spindles; what counts is the worst of them, or a percentile. None: the scenario's own.
        percentile: see `over`; 100: the worst.
        trials: so many in all, those that are there already among them.
        sampler: ``tpe``; ``cmaes`` for one goal and ranges alone; ``nsga2`` for several goals and many trials.
        seed: of the search.
        batch: trials that are asked for before the first of them is told.
        ask_formulas: let trial 1 be what `lathe_rc.sweep.formulas` gives, if it is within the ranges.
        measures: further columns, ``TOPIC.FIELD:STATISTIC``.
        scheduler: see `lathe_rc.sweep.sweep.run`, as the next two.
        workers: processes of this machine.
        client: of Dask, in place of both.
        watch: called with the events of `lathe_rc.sweep.sweep.run`, ``began`` with the trials that are there, and with
            ``told`` (tuning: what is there), after each batch.

    Raises:
        InputError: what is asked for cannot be, or the folder holds something else.
        LatheError: workers died, or the disk is full; what was computed is kept.

    Example:
        >>> from pathlib import Path
        >>> from lathe_rc import harness, resources
        >>> from lathe_rc.cell import scenario
        >>> start = ["spindle_encoder.revolutions=10", "learning_controller.lead_time=1.0e-3"]
        >>> piston = scenario.load(resources.find(Path("piston.yaml")), start)
        >>> free = {"learning_controller.lead_time": "0.8e-3:1.6e-3"}
        >>> tuning = harness.tune(piston, free, ["tool.rms_error"], Path("lead"), subjects=["margin>=0.05"], trials=8)
        >>> tuning
        <Tuning of piston in lead: 8 trials, tool.rms_error = ... in trial ...>
    """
    over = Space(**(over or Space()).to_json())
    wanted = aims(scenario, goals, subjects, measures=measures, percentile=percentile)
    found = frees(scenario, free)
    if twice := [target for target in found if target in over.targets()]:
        raise InputError(f"{twice[0]}: free, and what the goal is over as well; allowed: one of both")
    over.check(scenario)
    _check_sampler(sampler, wanted, found)
    for name, number in (("trials", trials), ("batch", batch)):
        if number < 1:
            raise InputError(f"{name} = {number}; allowed: from 1")
    told = {
        "targets": list(dict.fromkeys([*found, *over.targets()])),
        "free": {target: told if isinstance(told, str) else list(told) for target, told in free.items()},
        "goals": list(goals),
        "subjects": list(subjects),
        "percentile": percentile,
        "over": over.to_json(),
        "sampler": sampler,
        "seed": seed,
        "batch": batch,
        "formulas": ask_formulas,
    }
    kept = Folder.begin(folder, scenario, None, wanted.measures, json.loads(json.dumps(told)))
    state = _State(kept)
    with state.present() as me:
        asked = state.ask(me, trials)
        there = state.finished()
        watch({"event": "began", "cells": trials * state.count, "computed": there * state.count, "trials": there})
        if asked:
            for stages in compile_ahead(Cell(scenario.nodes).stages.values()):
                watch({"event": "compiling", "nodes": stages})
            with nullcontext(client) if client else client_of(scheduler, workers) as crew:
                watch({"event": "ready", "dashboard": crew.dashboard_link})
                while asked:
                    state.compute(crew, asked, watch)
                    asked = state.ask(me, trials)
    tuning = state.tuning()
    if len(goals) > 1:
        _write_front(tuning)
    return tuning


def _write_front(tuning: Tuning) -> None:
    place = tuning.folder.path / "front"
    with writing(tuning.folder.path):
        place.mkdir(exist_ok=True)
        for path in place.glob("*.yaml"):
            path.unlink(missing_ok=True)
    for trial in tuning.front:
        tuning.write(trial, place / f"trial-{trial.number}.yaml")


def _check_sampler(name: str, wanted: Aims, found: Mapping[str, Free]) -> None:
    if name not in SAMPLERS:
        raise InputError(f"sampler {name!r}; {instead(name, SAMPLERS)}")
    if name == "cmaes":
        lists = [target for target, each in found.items() if each.choices is not None]
        if len(wanted.goals) > 1 or lists or len(found) < 2:
            goals = f"{len(wanted.goals)} goals" if len(wanted.goals) > 1 else ""
            why = goals or (f"the list of {lists[0]}" if lists else "one parameter")
            raise InputError(f"sampler cmaes with {why}; allowed: one goal and two or more ranges; or tpe, nsga2")


class _Lock(JournalFileOpenLock):
    """Of the journal. The system releases it when who holds it dies; Optuna's own would have to be waited for."""

    def __init__(self, path: Path) -> None:
        self._lock = filelock.FileLock(path)

    def acquire(self) -> bool:
        """See `JournalFileOpenLock`."""
        self._lock.acquire()
        return True

    def release(self) -> None:
        """See `JournalFileOpenLock`."""
        self._lock.release()


def _opened(path: Path, goals: int) -> tuple[JournalStorage, optuna.Study]:
    """The journal, and the study in it.

    Raises:
        LatheError: it cannot be read.
    """
    try:
        storage = JournalStorage(JournalFileBackend(str(path), _Lock(path.with_suffix(".lock"))))
        directions = [StudyDirection.MINIMIZE] * goals
        return storage, optuna.create_study(
            study_name=_STUDY, storage=storage, directions=directions, load_if_exists=True
        )
    except (ValueError, KeyError) as error:
        raise LatheError(
            f"{path}: no journal of Optuna ({shown(error)}); allowed: as it was written, or a new folder"
        ) from None


class _State:
    """A tuning on the disk: Optuna's study, and the rows of its trials.

    Attributes:
        count: cells of a trial.
    """

    def __init__(self, folder: Folder) -> None:
        assert folder.tuning is not None, "a tuning"
        self._folder, told = folder, folder.tuning
        scenario = folder.scenario
        measures = [each.name for each in folder.measures]
        self._aims = aims(scenario, told["goals"], told["subjects"], measures=measures, percentile=told["percentile"])
        self._free = frees(scenario, told["free"])
        self._over = Space(**told["over"])
        self.count = self._over.count(scenario)
        self._told = told
        self._formulas = self._by_formula() if told["formulas"] else {}
        self._key = Key(folder)
        self._known: dict[str, dict[str, Any]] = {}
        self._take(folder.table(["key", *self._aims.columns]))
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        with writing(folder.path), folder.locked(wait=True):
            self._storage, self._study = _opened(folder.path / "trials.log", len(self._aims.goals))
            if not self._study.get_trials(deepcopy=False):
                self._enqueue()

    def _by_formula(self) -> dict[str, Found]:
        asked = [each.bound for each in self._aims.subjects if each.column == "margin" and each.below]
        return formulas.settings(self._folder.scenario, list(self._free), *asked[:1])

    def _enqueue(self) -> None:
        """The start, and what the formulas give."""
        start = {target: value_of(self._folder.scenario, target) for target in self._free}
        given = {**start, **{target: found.value for target, found in self._formulas.items()}}
        for values in [start, given] if given != start else [start]:
            if all(free.holds(values[target]) for target, free in self._free.items()):
                self._study.enqueue_trial({target: free.told(values[target]) for target, free in self._free.items()})

    @contextmanager
    def present(self) -> Iterator[str]:
        """Be known to be computing; yields one's name."""
        place = self._folder.path / "running"
        me = uuid.uuid4().hex
        with writing(self._folder.path):
            place.mkdir(exist_ok=True)
            lock = filelock.FileLock(place / me)
            lock.acquire()
        try:
            yield me
        finally:
            lock.release()
            (place / me).unlink(missing_ok=True)

    def _gone(self, trial: FrozenTrial, me: str) -> bool:
        """Whether nobody computes a trial."""
        by = trial.user_attrs.get(_BY)
        path = self._folder.path / "running" / str(by)
        if by is None or not path.exists():
            return True
        if by == me:
            return False
        lock = filelock.FileLock(path)
        try:
            lock.acquire(blocking=False)
        except filelock.Timeout:
            return False
        lock.release()
        path.unlink(missing_ok=True)
        return True

    def finished(self) -> int:
        """How many trials are computed."""
        return len(self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))

    def ask(self, me: str, most: int) -> list[FrozenTrial]:
        """The next batch: trials that somebody has left, filled up with new ones to ``most`` in all."""
        with writing(self._folder.path), self._folder.locked(wait=True), _quiet():
            there = self._study.get_trials(deepcopy=False)
            asked = [trial for trial in there if trial.state != TrialState.WAITING]
            left = [trial.number for trial in asked if trial.state == TrialState.RUNNING and self._gone(trial, me)]
            number, batch = len(asked), int(self._told["batch"])
            missing = batch - number % batch if number % batch or not left else 0
            for _ in range(max(0, min(missing, most - number))):
                self._study.sampler = self._sampler(number)
                left.append(self._study.ask().number)
                number += 1
            left = left[:batch]
            for each in left:
                self._study.sampler = self._sampler(each)
                trial = self._trial(each)
                trial.set_user_attr(_BY, me)
                for target, free in self._free.items():  # who was stopped in the middle may have left some out
                    free.suggest(trial, target)
            return [trial for trial in self._study.get_trials() if trial.number in left]

    def _trial(self, number: int) -> optuna.Trial:
        study = self._storage.get_study_id_from_name(_STUDY)
        return optuna.Trial(self._study, self._storage.get_trial_id_from_study_id_trial_number(study, number))

    def _sampler(self, number: int) -> optuna.samplers.BaseSampler:
        """Of a trial."""
        seed = int(np.random.SeedSequence([self._told["seed"], number]).generate_state(1)[0])
        if self._told["sampler"] == "cmaes":
            start = {target: value_of(self._folder.scenario, target) for target in self._free}
            return optuna.samplers.CmaEsSampler(x0=start, seed=seed)
        if self._told["sampler"] == "nsga2":
            return optuna.samplers.NSGAIISampler(population_size=_POPULATION, seed=seed)
        return optuna.samplers.TPESampler(multivariate=True, seed=seed)

    def compute(self, crew: distributed.Client, asked: Sequence[FrozenTrial], watch: Watch) -> None:
        """Compute the cells of a batch, and tell what came of it."""
        jobs = {trial.number: self._jobs(trial) for trial in asked}
        missing = {job.key: job for each in jobs.values() for job in each if job.key not in self._known}
        keep(
            self._folder,
            rows(crew, order_of(self._folder), missing.values(), len(missing)),
            watch,
            self._take,
        )
        with writing(self._folder.path), self._folder.locked(wait=True), _quiet():
            for number, each in jobs.items():
                self._tell(number, self._aims.score(self._known[job.key] for job in each))
        tuning = self.tuning()
        if best := tuning.best:
            tuning.write(best, self._folder.path / "best.yaml")
        watch({"event": "told", "tuning": tuning})

    def _take(self, table: pa.Table) -> None:
        for found in table.select(["key", *self._aims.columns]).to_pylist():
            self._known[found.pop("key")] = found

    def _values(self, trial: FrozenTrial) -> dict[str, Value]:
        return {target: free.value(trial.params[target]) for target, free in self._free.items()}

    def _jobs(self, trial: FrozenTrial) -> list[Job]:
        values = self._values(trial)
        given = [{**values, **each} for each in self._over.given or ({},)]
        cells = replace(self._over, given=given).cells(self._folder.scenario)
        first = trial.number * self.count
        return [Job(first + place, self._key.of(each), each) for place, each in enumerate(cells)]

    def _tell(self, number: int, score: Score) -> None:
        trial = self._trial(number)
        trial.set_user_attr(_SCORE, [list(score.costs), list(score.violations), score.margin])
        for place, violation in enumerate(score.violations):
            trial.set_constraint(str(place), violation)
        known = [min(cost, _UNKNOWN) for cost in score.costs]
        if self._told["sampler"] == "cmaes" and not score.feasible:  # it knows no constraints: the nearer the better
            known = [_UNKNOWN * (1.0 + sum(max(violation, 0.0) for violation in score.violations))]
        self._study.sampler = self._sampler(number)
        self._study.tell(number, known)

    def tuning(self) -> Tuning:
        """What is there."""
        found = []
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            costs, violations, margin = cast("tuple[list[float], list[float], float]", trial.user_attrs[_SCORE])
            found.append(Trial(trial.number, self._values(trial), Score(tuple(costs), tuple(violations), margin)))
        return Tuning(self._folder, self._aims, self._over, found, self._formulas)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Optuna's warnings of what it may change one day."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
