# SPDX-License-Identifier: Apache-2.0
"""Progress of a run or a budget on the error stream."""

import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

import lathe_rc
from lathe_rc import harness
from lathe_rc.analysis.budget import Budget
from lathe_rc.cell.scenario import Scenario

_REFRESH = 0.1  # [s] between updates of the progress line
_LOG_PERIOD = 2.0  # [s] between lines without a terminal
INTERRUPTED = 130  #: exit code of a command that Ctrl-C ends


class RunProgress:
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
