# SPDX-License-Identifier: Apache-2.0
"""A budget with its progress on the error stream."""

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

import lathe_rc
from lathe_rc.analysis.budget import Budget
from lathe_rc.cell.scenario import Scenario


def shown(scenario: Scenario) -> Budget:
    """The budget of a scenario; the runs that it takes are counted while they go on, if a terminal shows it."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("runs of the budget", total=None)
        return lathe_rc.budget(scenario, watch=lambda done, known: bar.update(task, completed=done, total=known))
