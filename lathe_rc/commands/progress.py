# SPDX-License-Identifier: Apache-2.0
"""Progress of a run, a budget, a sweep or a tuning on the error stream."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

import lathe_rc
from lathe_rc import harness
from lathe_rc.analysis.budget import Budget
from lathe_rc.cell.scenario import Scenario

_REFRESH = 0.1  # [s] between updates of the progress line
_LOG_PERIOD = 2.0  # [s] between lines without a terminal
_INTERRUPTED = 130  # exit code


class Watch:
    """Progress of a run on the error stream."""

    def __init__(self, console: Console) -> None:
        self._step = 0.0
        self._start = time.monotonic()
        self._due = {"progress": 0.0, "cycle": 0.0}
        self._silent = ""  # member reported as silent
        self._compiles = False
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[revolution]}  {task.fields[error]}  {task.fields[factor]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("starting", total=None, revolution="", error="", factor="")

    def __enter__(self) -> Callable[[harness.Event], None]:
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def _log(self, event: harness.Event, now: float) -> None:
        """Print a progress line at intervals if the output is not a terminal."""
        if event["event"] == "compiling" and not self._compiles:
            self._compiles = True
            self._bar.console.print(f"compiling {len(event['nodes'])} stages, once on this machine: some 20 s")
        if event["event"] == "cycle" and now >= self._due["cycle"]:
            self._due["cycle"] = now + _LOG_PERIOD
            error = f"error {event['rms_error'] * 1e6:.3g} µm RMS"
            self._bar.console.print(f"revolution {event['cycle']:.0f}: {error}", highlight=False)

    def __call__(self, event: harness.Event) -> None:
        """Update the progress from an event of the run."""
        kind, update = event["event"], self._bar.update
        now = time.monotonic()
        if kind in TROUBLE and (text := TROUBLE[kind](event)):
            self._bar.console.print(text)
        if self._bar.disable:
            self._log(event, now)
            return
        if kind in ("progress", "cycle"):
            if now < self._due[kind]:
                return  # more frequent updates are not readable, and would slow an offline run down
            self._due[kind] = now + _REFRESH
        if kind == "checked":
            # Not earlier, because the output of a rejected scenario is a single line.
            self._step = event["step"]
            update(self._task, total=event["samples"])
            self._bar.start()
        elif kind == "compiling":
            text = f"compiling {len(event['nodes'])} stages, once on this machine: {', '.join(event['nodes'])}"
            update(self._task, description=text)
        elif kind == "block0":
            self._start = now
            update(self._task, description="turning")
        elif kind == "progress":
            self._silent = ""
            simulated = event["samples"] * self._step
            elapsed = max(now - self._start, 1e-9)
            update(self._task, completed=event["samples"], factor=f"{simulated / elapsed:.1f}x real time")
        elif kind == "cycle":
            update(
                self._task,
                revolution=f"revolution {event['cycle']:.0f}",
                error=f"error {event['rms_error'] * 1e6:.3g} µm RMS",
            )
        elif kind == "stall" and event["member"] != self._silent:
            self._silent = event["member"]  # all other members report a silent time master
            self._bar.console.print(f"{event['member']} is silent at block {event['blocks']}: the cell stands still")


def watched_budget(scenario: Scenario) -> Budget:
    """Return the budget of a scenario, showing the number of finished runs meanwhile."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("runs of the budget", total=None)
        return lathe_rc.budget(scenario, watch=lambda done, known: bar.update(task, completed=done, total=known))


class SweepWatch:
    """Progress of a sweep or a tuning: cells, cells per second, remaining time, outcomes.

    Ctrl-C ends the command with a line about the saved results.

    Args:
        place: folder of the results.
        trials: number of trials of a tuning; 0 for a sweep.
        quiet: whether to print neither lines nor a progress bar.
    """

    def __init__(self, place: Path, *, trials: int = 0, quiet: bool = False) -> None:
        self._place, self._trials, self._quiet = place, trials, quiet
        self._cells = self._done = self._trials_done = 0
        self._statuses: Counter[str] = Counter()
        self._console = Console(stderr=True, highlight=False, quiet=quiet)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[speed]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[statuses]}"),
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal or quiet,
        )
        self._task = self._bar.add_task("starting workers", total=None, statuses="", speed="")

    def __enter__(self) -> "SweepWatch":
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, _error: object, _traceback: TracebackType | None) -> None:
        self._bar.stop()
        if kind is KeyboardInterrupt:
            kept = (
                f"{self._trials_done} of {self._trials} trials"
                if self._trials
                else f"{self._done} of {self._cells} cells"
            )
            click.echo(f"lathe: stopped; {kept} are in {self._place}: the same command goes on", err=True)
            raise click.exceptions.Exit(_INTERRUPTED) from None

    def __call__(self, event: Mapping[str, Any]) -> None:
        """Update the progress from an event of `lathe_rc.run_sweep` or `lathe_rc.tune`."""
        update = self._bar.update
        if event["event"] == "began":
            self._cells, self._done = event["cells"], event["computed"]
            self._trials_done = event.get("trials", 0)
            there = f", {self._done} of them are there already" if self._done else ""
            self._console.print(f"{self._cells} cells{there}")
            for version, count in event.get("others", {}).items():
                digest = f"lathe sweep show {self._place} --cell N compares a digest"
                self._console.print(f"{count} cells are of lathe_rc {version}, not of this one; {digest}")
            update(self._task, total=self._cells, completed=self._done)
        elif event["event"] == "compiling":
            update(self._task, description="compiling, once on this machine")
        elif event["event"] == "ready":
            self._console.print(f"Dask's dashboard: {event['dashboard']}")
            self._bar.reset(self._task, total=self._cells, completed=self._done, description="computing")
        elif event["event"] == "waiting":
            update(self._task, description="another program computes the last trials")
        elif event["event"] == "told":
            tuning = event["tuning"]
            self._trials_done = len(tuning.trials)
            if best := tuning.best:
                goals = ", ".join(tuning.goals_shown(best).values())
                update(self._task, description=f"best: {goals} (trial {best.number})")
        else:
            self._statuses += event["statuses"]
            self._done += event["statuses"].total()
            others = [f"{count} {status}" for status, count in self._statuses.most_common() if status != "done"]
            speed = self._bar.tasks[0].speed
            rate = f"{speed:.3g} cells/s" if speed else ""
            update(self._task, completed=self._done, statuses=", ".join(others), speed=rate)


TROUBLE: dict[str, Callable[[harness.Event], str]] = {
    "paused": lambda event: f"{event['node']} waits for {'; '.join(event['missing'])}",
    "stuck": lambda event: f"{event['node']} did not end{event['place']}; the bag is closed: no longer waited for",
    "foreign_message": lambda event: (
        f"{event['node']} refuses: {event['message']}; publishers: {', '.join(event['publishers'])}"
    ),
    "dead": lambda event: (
        f"{event['member']} has died at block {event['blocks']}: "
        + ("another process goes on in its place" if event["restarts"] else "the cell goes to its safe state")
    ),
    "exit": lambda event: harness.how_it_ended(event) if event["code"] < 0 else "",
    "not_reached": lambda event: f"{event['node']}: the run ends before {'; '.join(event['events'])}",
    "unchecked": lambda event: f"not checked: {event['message']}",
    "warning": lambda event: f"warning: {event['message']}",
    "behind": lambda event: str(event["message"]),
    "safe": lambda event: f"{event['why']}; the run ends at sample {event['end']}",
}  #: lines for events that are always printed
