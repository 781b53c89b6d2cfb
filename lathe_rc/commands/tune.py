# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe tune``: parameters of a scenario that meet goals best."""

import json
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

import lathe_rc
from lathe_rc.commands import options
from lathe_rc.commands import scenario as scenarios
from lathe_rc.commands.sweep import INTERRUPTED, Watch, check_crew, measured, pairs, space_of
from lathe_rc.errors import InputError
from lathe_rc.sweep import history, row
from lathe_rc.sweep.study import BATCH
from lathe_rc.sweep.tune import SAMPLERS
from lathe_rc.sweep.tuned import Trial, Tuning

_LAWS = ("normal:", "uniform:")
_STEPS = 5  # of the history that are shown


@click.command()
@click.argument("scenario")
@click.option(
    "--free", multiple=True, metavar="NODE.PARAM=RANGE", help="LOW:HIGH[:log] or A,B,C; % of the scenario's value"
)
@click.option(
    "--goal",
    "goals",
    multiple=True,
    metavar="COLUMN",
    help=f"as small as it can be, -COLUMN: as large: {', '.join(row.NUMBERS)} or TOPIC.FIELD:STATISTIC; repeatable",
)
@click.option("--subject", "subjects", multiple=True, metavar="COLUMN>=NUMBER", help="also <=; has to be met")
@click.option(
    "--over",
    multiple=True,
    metavar="NODE.PARAM=LAW",
    help="plants and spindles that the goal is over: ranges, lists and laws as of lathe sweep --vary and --draw",
)
@click.option("--tie", multiple=True, metavar="NODE.PARAM=FORMULA", help="such as fine_controller.q_time*1.1")
@click.option("--sample", default="", metavar="SAMPLER:N", help="points of --over: sobol, halton, latin, random")
@click.option("--seeds", type=click.IntRange(1), default=1, show_default=True, help="each cell with so many seeds")
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
@measured
@options.overrides
@options.length
@click.option("--out", type=click.Path(path_type=Path), help="folder of the results; default: tune-SCENARIO")
@options.scheduler
@options.workers
@options.allow_code
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
def tune(
    scenario: str,
    free: tuple[str, ...],
    goals: tuple[str, ...],
    subjects: tuple[str, ...],
    over: tuple[str, ...],
    tie: tuple[str, ...],
    sample: str,
    seeds: int,
    percentile: float | None,
    trials: int,
    sampler: str,
    seed: int,
    batch: int,
    measures: tuple[str, ...],
    overrides: tuple[str, ...],
    revolutions: float | None,
    out: Path | None,
    scheduler: str | None,
    workers: int | None,
    *,
    worst: bool,
    no_formulas: bool,
    as_json: bool,
) -> None:
    """Search the parameters of a SCENARIO that meet goals best; the same command goes on where it was stopped."""
    check_crew(scheduler, workers)
    if worst and percentile is not None:
        raise InputError(f"--worst with --percentile {percentile:g}; allowed: one of them")
    if (worst or percentile is not None) and not over and seeds == 1:
        raise InputError(f"{'--worst' if worst else '--percentile'} of one cell; allowed: with --over or --seeds")
    loaded = scenarios.load(scenario, overrides, revolutions=revolutions)
    drawn = [text for text in over if text.partition("=")[2].strip().startswith(_LAWS)]
    varied = [text for text in over if text not in drawn]
    place = out or Path(f"tune-{loaded.name}")
    progress = _Watch(Console(stderr=True), quiet=as_json)
    try:
        with progress:
            found = lathe_rc.tune(
                loaded,
                pairs("--free", free, "NODE.PARAM=LOW:HIGH, =LOW:HIGH:log or =A,B,C"),
                goals,
                place,
                subjects=subjects,
                over=space_of(varied, drawn, tie, sample, seeds, None),
                percentile=100.0 if percentile is None else percentile,
                trials=trials,
                sampler=sampler,
                seed=seed,
                batch=batch,
                ask_formulas=not no_formulas,
                measures=measures,
                scheduler=scheduler,
                workers=workers,
                watch=progress,
            )
    except KeyboardInterrupt:
        click.echo(
            f"lathe: stopped; {progress.told} of {trials} trials are in {place}: the same command goes on", err=True
        )
        raise click.exceptions.Exit(INTERRUPTED) from None
    picture = history.write(found)
    if as_json:
        click.echo(json.dumps(_summary(found)))
    else:
        _show(found, picture)


class _Watch(Watch):
    """Shows the progress of a tuning: that of its cells, and the best so far."""

    def __init__(self, console: Console, *, quiet: bool = False) -> None:
        super().__init__(console, quiet=quiet)
        self.told = 0

    def __call__(self, event: Mapping[str, Any]) -> None:
        """Take an event of `lathe_rc.tune`."""
        if event["event"] == "waiting":
            self.describe("another program computes the last trials")
            return
        if event["event"] != "told":
            self.told = event.get("trials", self.told)
            super().__call__(event)
            return
        tuning: Tuning = event["tuning"]
        self.told = len(tuning.trials)
        if best := tuning.best:
            self.describe(f"best: {', '.join(_goals(tuning, best).values())} (trial {best.number})")


def _number(column: str, value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return "none"
    factor, name = history.unit(column)
    return f"{value * factor:.4g} {name}".strip()


def _goals(tuning: Tuning, trial: Trial) -> dict[str, str]:
    """The goals of a trial, by column, as they are shown."""
    pairs = zip(tuning.aims.goals, trial.score.costs, strict=True)
    return {goal.column: _number(goal.column, goal.sign * cost) for goal, cost in pairs}


def _value(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _show(tuning: Tuning, picture: Path) -> None:
    console = Console()

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    if told := _told_history(tuning):
        say(told)
    if len(tuning.front) > 1:
        _show_front(console, tuning)
    best, start = tuning.best, tuning.start
    if best and start:
        _show_best(console, tuning, start, best)
        if cost := _cost_of(start, best):
            say(cost)
    for formula in dict.fromkeys(found.formula for found in tuning.formulas.values()):
        targets = [target for target, found in tuning.formulas.items() if found.formula == formula]
        say(f"by formula, {', '.join(targets)}: {formula}")
    feasible = sum(trial.score.feasible for trial in tuning.trials)
    say(f"{len(tuning.trials)} trials, {feasible} meet all subjects")
    folder = tuning.folder.path
    if best:
        say(f"best:    lathe run {folder / 'best.yaml'} (trial {best.number})")
    else:
        say("nothing meets all subjects; allowed: wider ranges, weaker subjects, more trials")
        reasons = Counter(filter(None, tuning.folder.table(["reason"]).column("reason").to_pylist()))
        for reason, count in reasons.most_common(1):
            say(f"{count} cells did not run to their end, as this one: {reason}")
    say(f"history: {picture}, {picture.with_suffix('.html')}")
    say(f"rows:    lathe sweep show {folder} --cell {_first_cell(tuning, best or start)}")


def _first_cell(tuning: Tuning, trial: Trial | None) -> int:
    return trial.number * tuning.over.count(tuning.folder.scenario) if trial else 0


def _show_best(console: Console, tuning: Tuning, start: Trial, best: Trial) -> None:
    """Parameters and what came of them: of the start, the best, and what the formulas give."""
    by_formula = tuning.by_formula
    table = Table(show_edge=False, header_style="bold")
    table.add_column("", overflow="fold")
    for name in ("start", "best", *(["by formula"] if tuning.formulas else [])):
        table.add_column(name, justify="right", no_wrap=True)
    for target, value in best.values.items():
        found = tuning.formulas.get(target)
        given = [_value(found.value) if found else ""] if tuning.formulas else []
        table.add_row(target, _value(start.values[target]), _value(value), *given)
    table.add_section()
    columns = [_results(tuning, trial) for trial in (start, best, by_formula) if trial]
    for name in columns[0]:
        table.add_row(name, *(column.get(name, "") for column in columns))
    met = ["yes" if trial.score.feasible else "no" for trial in (start, best, by_formula) if trial]
    table.add_row("meets all subjects", *met)
    console.print(table)


def _results(tuning: Tuning, trial: Trial) -> dict[str, str]:
    """Goals and margin of a trial, by what they are."""
    count = tuning.over.count(tuning.folder.scenario)
    which = "" if count == 1 else ", worst" if tuning.aims.percentile == 100.0 else f", {tuning.aims.percentile:g} %"
    shown = {f"{name}{which}": value for name, value in _goals(tuning, trial).items()}
    if not math.isnan(trial.score.margin):
        shown[f"margin{which}"] = f"{trial.score.margin:.4g}"
    return shown


def _cost_of(start: Trial, best: Trial) -> str:
    """The margin that the best costs, in a sentence; empty if no cell learns."""
    if math.isnan(best.score.margin):
        return ""
    if math.isnan(start.score.margin):
        return f"the best has {best.score.margin:.4g} of margin; the start was refused before it had one"
    change = best.score.margin - start.score.margin
    return (
        f"the best {'costs' if change < 0.0 else 'gains'} {abs(change):.4g} of margin: {best.score.margin:.4g} in "
        f"place of the start's {start.score.margin:.4g}"
    )


def _improvements(tuning: Tuning) -> list[Trial]:
    """The trials that were better in the first goal than all before."""
    found: list[Trial] = []
    for trial in tuning.trials:
        if trial.score.feasible and (not found or trial.score.costs[0] < found[-1].score.costs[0]):
            found.append(trial)
    return found


def _told_history(tuning: Tuning) -> str:
    """A trial that was better than all before, in a line."""
    column = tuning.aims.goals[0].column
    steps: dict[str, int] = {}
    for trial in _improvements(tuning):
        steps.setdefault(_goals(tuning, trial)[column], trial.number)
    shown = list(steps.items())
    shown = shown if len(shown) <= _STEPS else [shown[0], *shown[1 - _STEPS :]]
    told = " → ".join(f"{value} (trial {number})" for value, number in shown)
    return f"{column}: {told}" if told else ""


def _show_front(console: Console, tuning: Tuning) -> None:
    table = Table(title="no other trial is better in all goals", title_justify="left", show_edge=False)
    front = tuning.front
    table.add_column("trial", justify="right", no_wrap=True)
    for name in _results(tuning, front[0]):
        table.add_column(name, justify="right", overflow="fold")
    for trial in front:
        table.add_row(str(trial.number), *_results(tuning, trial).values())
    console.print(table)
    console.print(f"{tuning.folder.path / 'front'}: a parameter file of each", highlight=False, soft_wrap=True)


def _told(tuning: Tuning, trial: Trial | None) -> dict[str, Any] | None:
    """A trial for programs; in SI units, null for what is not known."""
    if trial is None:
        return None
    costs = zip(tuning.aims.goals, trial.score.costs, strict=True)
    return {
        "trial": trial.number,
        "values": dict(trial.values),
        "goals": {goal.column: goal.sign * cost if math.isfinite(cost) else None for goal, cost in costs},
        "margin": None if math.isnan(trial.score.margin) else trial.score.margin,
        "feasible": trial.score.feasible,
    }


def _summary(tuning: Tuning) -> dict[str, Any]:
    return {
        "folder": str(tuning.folder.path),
        "scenario": tuning.folder.scenario.name,
        "trials": len(tuning.trials),
        "feasible": sum(trial.score.feasible for trial in tuning.trials),
        "cells": tuning.over.count(tuning.folder.scenario),
        "start": _told(tuning, tuning.start),
        "best": _told(tuning, tuning.best),
        "by_formula": _told(tuning, tuning.by_formula),
        "formulas": {target: found._asdict() for target, found in tuning.formulas.items()},
        "front": [_told(tuning, trial) for trial in tuning.front],
        "history": [_told(tuning, trial) for trial in _improvements(tuning)],
    }
