# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe tune``: search for the parameters of a scenario that meet goals best."""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import lathe_explore
from lathe_explore.commands import options as many
from lathe_explore.commands.sweep import check_crew, space_of
from lathe_explore.sweep import BATCH, NUMBERS, SAMPLERS
from lathe_rc.commands import options
from lathe_rc.errors import InputError
from lathe_rc.names import pairs

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from lathe_explore.sweep.tuning import Trial, Tuning

_STEPS = 5  # number of displayed steps of the history


@click.command()
@options.scenario
@options.of_targets("--free", metavar="NODE.PARAM=RANGE", help="LOW:HIGH[:log] or A,B,C; % of the scenario's value")
@click.option(
    "--goal",
    "goals",
    multiple=True,
    metavar="COLUMN",
    help=f"as small as it can be, -COLUMN: as large: {', '.join(NUMBERS)}, NODE.FIGURE or TOPIC.FIELD:STATISTIC "
    "as of --measure, or a formula of these; repeatable",
)
@click.option("--subject", "subjects", multiple=True, metavar="COLUMN>=NUMBER", help="also <=, and formulas of columns")
@options.of_targets(
    "--over",
    metavar="NODE.PARAM=LAW",
    help="plants and spindles that the goal is over: ranges, lists and laws as of lathe sweep --vary and --draw",
)
@many.tie
@many.sampling
@many.seeds
@click.option("--worst", is_flag=True, help="of --over the worst counts (default)")
@click.option("--percentile", type=float, help="of --over this percentile counts, such as 95")
@click.option("--trials", type=click.IntRange(1), default=100, show_default=True, help="in all, those there included")
@click.option(
    "--sampler",
    type=click.Choice(SAMPLERS),
    default=SAMPLERS[0],
    show_default=True,
    help="cmaes: one goal, ranges alone; nsga2: several goals and many trials",
)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="of the search")
@click.option("--batch", type=click.IntRange(1), default=BATCH, show_default=True, help="trials asked for at once")
@click.option("--no-formulas", is_flag=True, help="do not let what formulas give be trial 1")
@many.measures
@many.many_cells("tune-SCENARIO")
def tune(
    scenario: str,
    free: tuple[str, ...],
    goals: tuple[str, ...],
    over: tuple[str, ...],
    tie: tuple[str, ...],
    sampling: many.Sampling,
    seeds: int,
    percentile: float | None,
    trials: int,
    overrides: tuple[str, ...],
    revolutions: float | None,
    start_from: Path | None,
    out: Path | None,
    scheduler: str | None,
    workers: int | None,
    *,
    worst: bool,
    no_formulas: bool,
    as_json: bool,
    **search: Any,
) -> None:
    """Search for the parameters of a SCENARIO that best meet goals; the same command resumes a stopped search."""
    from lathe_explore.commands.progress import SweepWatch
    from lathe_explore.sweep import history
    from lathe_explore.sweep.distributions import is_law
    from lathe_rc.commands import scenario as scenarios
    from lathe_rc.commands import tables

    check_crew(scheduler, workers)
    if worst and percentile is not None:
        raise InputError(f"--worst with --percentile {percentile:g}; allowed: one of them")
    if (worst or percentile is not None) and not over and seeds == 1:
        raise InputError(f"{'--worst' if worst else '--percentile'} of one cell; allowed: with --over or --seeds")
    loaded = scenarios.load(scenario, overrides, revolutions=revolutions, start_from=start_from)
    drawn = [text for text in over if is_law(text.partition("=")[2].strip())]
    varied = [text for text in over if text not in drawn]
    place = out or Path(f"tune-{loaded.name}")
    with SweepWatch(place, trials=trials, quiet=as_json) as watch:
        found = lathe_explore.tune(
            loaded,
            pairs("--free", free, "NODE.PARAM=LOW:HIGH, =LOW:HIGH:log or =A,B,C"),
            goals,
            place,
            over=space_of(varied, drawn, tie, seeds, sampling),
            percentile=100.0 if percentile is None else percentile,
            trials=trials,
            ask_formulas=not no_formulas,
            scheduler=scheduler,
            workers=workers,
            watch=watch,
            **search,
        )
    picture = history.write(found)
    tables.show(_summary(found), _told(found, picture), as_json=as_json)


def _told(tuning: "Tuning", picture: Path) -> Iterator["RenderableType"]:
    folder, start, best = tuning.folder.path, tuning.start, tuning.best
    if improvements := _history(tuning):
        yield improvements
    if len(tuning.front) > 1:
        yield _front_table(tuning)
        yield f"{folder / 'front'}: a parameter file of each"
    if best and start:
        yield _best_table(tuning)
        if not math.isnan(best.score.margin):
            yield _cost_of(start, best)
    for formula in dict.fromkeys(found.formula for found in tuning.formulas.values()):
        targets = [target for target, found in tuning.formulas.items() if found.formula == formula]
        yield f"by formula, {', '.join(targets)}: {formula}"
    yield f"{len(tuning.trials)} trials, {len(tuning.feasible)} meet all subjects"
    if best:
        yield f"best:    lathe run {folder / 'best.yaml'} (trial {best.number})"
    else:
        yield "nothing meets all subjects; allowed: wider ranges, weaker subjects, more trials"
        reasons = Counter(filter(None, tuning.folder.table(["reason"]).column("reason").to_pylist()))
        for reason, count in reasons.most_common(1):
            yield f"{count} cells did not run to their end, as this one: {reason}"
    yield f"history: {picture}"
    shown = best or start
    yield f"rows:    lathe sweep show {folder} --cell {shown.number * tuning.cells if shown else 0}"


def _best_table(tuning: "Tuning") -> "Table":
    """Return a table of parameters and results for the start, the best trial, and the formulas."""
    from lathe_rc.commands.tables import table

    columns, values, results = tuning.compared()
    made = table(*columns, left=1, overflow="fold")
    for column in made.columns[1:]:
        column.no_wrap = True
    for row in values:
        made.add_row(*row)
    made.add_section()
    for row in results:
        made.add_row(*row)
    return made


def _cost_of(start: "Trial", best: "Trial") -> str:
    """Describe in a sentence how the stability margins of the start and the best trial differ."""
    before, margin = start.score.margin, best.score.margin
    if math.isnan(before):
        return f"the best has {margin:.4g} of margin; the start was refused before it had one"
    verb = "costs" if margin < before else "gains"
    return f"the best {verb} {abs(margin - before):.4g} of margin: {margin:.4g} in place of the start's {before:.4g}"


def _history(tuning: "Tuning") -> str:
    """Return the successive improvements of the first goal as a line of text."""
    column = tuning.objectives.goals[0].column
    steps: dict[str, int] = {}
    for trial in tuning.improvements:
        steps.setdefault(tuning.goals_shown(trial)[column], trial.number)
    shown = list(steps.items())
    shown = shown if len(shown) <= _STEPS else [shown[0], *shown[1 - _STEPS :]]
    values = " → ".join(f"{value} (trial {number})" for value, number in shown)
    return f"{column}: {values}" if values else ""


def _front_table(tuning: "Tuning") -> "Table":
    from lathe_rc.commands.tables import table

    results = {trial.number: tuning.results(trial) for trial in tuning.front}
    names = next(iter(results.values()))
    made = table("trial", *names, title="no other trial is better in all goals", overflow="fold")
    made.columns[0].no_wrap = True
    for number, result in results.items():
        made.add_row(str(number), *result.values())
    return made


def _summary(tuning: "Tuning") -> dict[str, Any]:
    """Return the JSON summary of a tuning, in SI units, with null for unknown numbers."""

    def summary(trial: "Trial | None") -> dict[str, Any] | None:
        if trial is None:
            return None
        goals = tuning.goals(trial).items()
        return {
            "trial": trial.number,
            "values": dict(trial.values),
            "goals": {column: value if math.isfinite(value) else None for column, value in goals},
            "margin": None if math.isnan(trial.score.margin) else trial.score.margin,
            "feasible": trial.score.feasible,
        }

    return {
        "folder": str(tuning.folder.path),
        "scenario": tuning.folder.scenario.name,
        "trials": len(tuning.trials),
        "feasible": len(tuning.feasible),
        "cells": tuning.cells,
        "start": summary(tuning.start),
        "best": summary(tuning.best),
        "by_formula": summary(tuning.by_formula),
        "formulas": {target: found._asdict() for target, found in tuning.formulas.items()},
        "front": [summary(trial) for trial in tuning.front],
        "history": [summary(trial) for trial in tuning.improvements],
    }
