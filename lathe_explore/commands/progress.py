# SPDX-License-Identifier: Apache-2.0
"""Progress of a sweep or a tuning on the error stream."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from lathe_rc.commands.progress import INTERRUPTED


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
            raise click.exceptions.Exit(INTERRUPTED) from None

    def __call__(self, event: Mapping[str, Any]) -> None:
        """Update the progress from an event of `lathe_explore.run_sweep` or `lathe_explore.tune`."""
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
