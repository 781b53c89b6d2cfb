# SPDX-License-Identifier: Apache-2.0
"""Tuning: a parameter search by Optuna; the workers of a sweep compute its trials.

DIR/trials.log       Optuna's journal: the trials and their scores
DIR/tune.lock        held by the process that computes
DIR/best.yaml        the cell with the best trial's parameters
DIR/front/           for several goals, the cells of the Pareto front
DIR, other files     see `lathe_explore.sweep.folder`: cell n of trial m is row m * (cells per trial) + n
"""

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import distributed

from lathe_explore.sweep import BATCH, SAMPLERS
from lathe_explore.sweep.folder import Folder, Request, locked, writing
from lathe_explore.sweep.objectives import Objectives, objectives
from lathe_explore.sweep.search_space import Dimension, search_space
from lathe_explore.sweep.space import Space, check_distinct
from lathe_explore.sweep.study import TuningStudy
from lathe_explore.sweep.sweep import Watch, crew_for, ignore
from lathe_explore.sweep.tuning import Tuning
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario, of_load
from lathe_rc.errors import InputError
from lathe_rc.names import instead


def tune(
    scenario: Scenario,
    free: Mapping[str, str | Sequence[Value]],
    goals: Sequence[str],
    folder: str | os.PathLike[str],
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
    cell_time: float | None = None,
    watch: Watch = ignore,
) -> Tuning:
    """Search for parameters of a cell; existing trials in the folder are not computed again.

    Args:
        scenario: the cell; its own parameters are the start, trial 0. It must specify a number of revolutions.
        free: search space by ``NODE.PARAM``: ``LOW:HIGH``, ``LOW:HIGH:log``, or values: ``A,B,C`` or a list.
        goals: columns of a row to be minimised, see `lathe_explore.sweep.objectives`; several yield a Pareto front.
        folder: folder of the results.
        subjects: constraints, ``COLUMN>=NUMBER`` or ``COLUMN<=NUMBER``.
        over: uncertain plants and spindles; each goal is its worst value over them, or a percentile; None: only the
            scenario's plant and spindle.
        percentile: percentile of a goal over ``over`` that counts; 100: the worst value.
        trials: total number of trials, including existing ones.
        sampler: ``tpe``; ``cmaes`` for one goal and only ranges; ``nsga2`` for several goals and many trials.
        seed: random seed of the search.
        batch: number of trials that are drawn together, before any of them has a score.
        ask_formulas: whether trial 1 uses the values of `lathe_explore.sweep.formulas`, if they are within the ranges.
        measures: further columns, ``TOPIC.FIELD:STATISTIC`` or ``NODE.FIGURE`` of a loop.
        scheduler: address of a Dask scheduler; None: workers on this machine.
        workers: number of worker processes on this machine; None: one per core.
        client: Dask client, used instead of ``scheduler`` and ``workers``.
        cell_time: time limit of a cell [s]; None: 20 times the slowest cell so far, at least 60 s.
        watch: called with the events of `lathe_explore.run_sweep` (``began`` gives the number of existing trials), with
            ``told`` (tuning: all trials so far) after each batch.

    Raises:
        InputError: the arguments are invalid, the folder has other contents, or another process computes into it.
        LatheError: workers died, or the disk is full; the computed rows are saved.

    Example:
        >>> import lathe_explore
        >>> import lathe_rc
        >>> start = ["spindle_encoder.revolutions=10", "learning_controller.lead_time=1.0e-3"]
        >>> piston = lathe_rc.load("piston", start)
        >>> free = {"learning_controller.lead_time": "0.8e-3:1.6e-3"}
        >>> tuning = lathe_explore.tune(piston, free, ["tool.rms_error"], "lead", subjects=["margin>=0.05"], trials=8)
        >>> tuning
        <Tuning of piston in lead: 8 trials, tool.rms_error = ... in trial ...>
    """
    scenario = of_load(scenario)
    over = Space(**(over or Space()).to_json())
    wanted = objectives(scenario, goals, subjects, measures=measures, percentile=percentile)
    found = search_space(scenario, free)
    if twice := [target for target in found if target in over.targets()]:
        raise InputError(f"{twice[0]}: free, and what the goal is over as well; allowed: one of both")
    over.check(scenario)
    check_distinct([*found, *over.targets()])
    _check_sampler(sampler, wanted, found)
    for name, number in (("trials", trials), ("batch", batch)):
        if number < 1:
            raise InputError(f"{name} = {number}; allowed: from 1")
    request = Request(
        targets=list(dict.fromkeys([*found, *over.targets()])),
        free={target: told if isinstance(told, str) else list(told) for target, told in free.items()},
        goals=list(goals),
        subjects=list(subjects),
        percentile=percentile,
        over=over,
        sampler=sampler,
        seed=seed,
        batch=batch,
        formulas=ask_formulas,
    )
    kept = Folder.begin(Path(folder), scenario, None, wanted.measures, request)
    state = TuningStudy(kept)
    with locked(kept.path / "tune.lock", wait=False), ExitStack() as stack:
        there = state.count_trials()
        watch({"event": "began", "cells": trials * state.count, "computed": there * state.count, "trials": there})
        crew = None
        while asked := state.ask(trials):
            crew = crew or stack.enter_context(crew_for(scenario, client, scheduler, workers, watch))
            state.compute(crew, asked, watch, cell_time)
    with kept.locked(wait=True):
        tuning = state.tuning()
        if len(goals) > 1:
            with writing(kept.path):
                (kept.path / "front").mkdir(exist_ok=True)
                for path in (kept.path / "front").glob("*.yaml"):
                    path.unlink(missing_ok=True)
            for trial in tuning.front:
                tuning.write(trial, kept.path / "front" / f"trial-{trial.number}.yaml")
    return tuning


def _check_sampler(name: str, wanted: Objectives, found: Mapping[str, Dimension]) -> None:
    if name not in SAMPLERS:
        raise InputError(f"sampler {name!r}; {instead(name, SAMPLERS)}")
    if name == "cmaes":
        lists = [target for target, each in found.items() if each.choices is not None]
        if len(wanted.goals) > 1 or lists or len(found) < 2:
            goals = f"{len(wanted.goals)} goals" if len(wanted.goals) > 1 else ""
            why = goals or (f"the list of {lists[0]}" if lists else "one parameter")
            raise InputError(f"sampler cmaes with {why}; allowed: one goal and two or more ranges; or tpe, nsga2")


def load(path: Path) -> Tuning:
    """Load the tuning in a folder.

    Raises:
        InputError: the folder contains no tuning.
    """
    folder = Folder(path)
    if folder.tuning is None:
        raise InputError(f"{path} holds a sweep; allowed: a folder that lathe tune has written")
    return TuningStudy(folder).tuning()
