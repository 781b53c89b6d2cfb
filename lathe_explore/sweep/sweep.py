# SPDX-License-Identifier: Apache-2.0
"""Execution of a sweep, from its space to the table of results."""

import hashlib
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import distributed
import numpy as np
import pyarrow as pa
import pyarrow.compute

from lathe_explore.sweep import inputs, row
from lathe_explore.sweep.alone import KILLED
from lathe_explore.sweep.folder import Folder
from lathe_explore.sweep.objectives import front, goal_among
from lathe_explore.sweep.outcomes import CellsOutcome, outcomes
from lathe_explore.sweep.space import Space, canonical
from lathe_explore.sweep.workers import Job, Order, client_of, rows
from lathe_rc import allowed_code
from lathe_rc.cell.ahead import compile_ahead
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario, of_load
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

Models = Literal["follow", "nominal"]
Watch = Callable[[Mapping[str, Any]], None]

_WRITE = 10.0  # [s] between files of rows


@dataclass(frozen=True, repr=False)
class Sweep:
    """Result of a sweep.

    Attributes:
        folder: folder of the rows.
    """

    folder: Folder

    def __repr__(self) -> str:
        """Return the scenario and the numbers of cells by status as a string."""
        told = ", ".join(f"{count} {status}" for status, count in self.statuses().items())
        return f"<Sweep of {self.folder.name} in {self.folder.path}: {told or 'nothing computed'}>"

    def table(self) -> pa.Table:
        """Return the table of rows in cell order (columns: `lathe_explore.sweep.row`)."""
        return self.folder.table()

    def frame(self) -> "pd.DataFrame":
        """Return the rows of the sweep as a pandas data frame."""
        return self.table().to_pandas()

    def statuses(self) -> dict[str, int]:
        """Return the numbers of cells by status, most frequent first."""
        return dict(Counter(self.folder.table(["status"]).column("status").to_pylist()).most_common())

    def outcomes(self) -> list[CellsOutcome]:
        """Return the statuses and reasons of the cells, most frequent first."""
        return outcomes(self.folder.table(["cell", "status", "reason"]))

    def best(self, *goals: str, most: int = 5) -> list[dict[str, Any]]:
        """Return the best cells for a goal, or the Pareto front for several: parameters, goals and margin, by column.

        Args:
            goals: goals as of `lathe_explore.tune`, the margins being maximised; none: the largest error.
            most: number of cells for one goal.

        Raises:
            InputError: a goal has no such column, or is no formula.
        """
        about, whole = self.folder.description, self.table()
        wanted = [goal_among(goal, self.folder.numbers) for goal in goals or (about.goal,)]
        values = np.stack([goal.values(whole) for goal in wanted], axis=1)
        costs = values * [goal.sign for goal in wanted]
        if len(wanted) > 1:
            order = front(costs)
        else:
            order = [place for place in np.argsort(costs[:, 0], kind="stable")[:most] if np.isfinite(costs[place, 0])]
        columns = ["cell", *self.folder.carried, *self.folder.targets]
        more = [about.goal, about.goal.replace("max_error", "rms_error")]
        more.append("margin" if about.goal.startswith("tool.") else about.goal.replace("max_error", "settling"))
        rows = whole.select(list(dict.fromkeys([*columns, *more]))).take(pa.array(order, pa.int64())).to_pylist()
        named = [goal.column for goal in wanted]
        ranked = [dict(zip(named, values[place].tolist(), strict=True)) for place in order]
        rest = [name for name in more if name not in named]
        return [
            {name: row[name] for name in columns} | goal | {name: row[name] for name in rest}
            for row, goal in zip(rows, ranked, strict=True)
        ]

    def count_without(self, goal: str) -> int:
        """Return the number of done cells in which a goal has no value, for example because it divides by zero."""
        done = self.table().filter(pyarrow.compute.field("status") == row.DONE)
        return int(np.isnan(goal_among(goal, self.folder.numbers).values(done)).sum())

    def row(self, number: int) -> dict[str, Any]:
        """Return the row of a cell, by column; raises the same errors as `scenario`."""
        return self.folder.row(number)

    def scenario(self, number: int) -> Scenario:
        """Return the scenario of a cell, for example to run it again.

        Raises:
            InputError: the cell does not exist, is not computed yet, or was refused; or its code or files are missing.
        """
        return self.folder.scenario.varied(self.folder.values(number))


def ignore(event: Mapping[str, Any]) -> None:
    """Ignore an event of a sweep (default of ``watch``)."""


def run_sweep(
    scenario: Scenario,
    space: Space,
    folder: str | os.PathLike[str],
    *,
    measures: Sequence[str] = (),
    models: Models = "follow",
    scheduler: str | None = None,
    workers: int | None = None,
    client: distributed.Client | None = None,
    cell_time: float | None = None,
    retry: bool = False,
    watch: Watch = ignore,
) -> Sweep:
    """Compute all cells of a space that are not in the folder yet.

    Args:
        scenario: the cell to vary; it must specify a number of revolutions.
        space: variations of the cell.
        folder: folder of the results; an interrupted sweep is continued, and further spaces are added.
        measures: further columns, ``TOPIC.FIELD:STATISTIC`` or ``NODE.FIGURE`` of a loop; a cell without a tool has
            all figures of its loops.
        models: drive models of controllers, if the scenario does not set them: ``follow`` the varied drives, or
            stay ``nominal``, as for one controller design for many drives.
        scheduler: address of a Dask scheduler; None: workers on this machine.
        workers: number of worker processes on this machine; None: one per core.
        client: Dask client, used instead of ``scheduler`` and ``workers``.
        cell_time: time limit of a cell [s]; None: 20 times the slowest cell so far, at least 60 s.
        retry: whether to compute all failed cells again; otherwise only those that another version of lathe_rc has
            computed, that reached a shorter time limit, or whose process was killed.
        watch: called with the events ``began`` (cells; computed: number of existing rows; others: their numbers by
            other version of lathe_rc), ``compiling`` (nodes), ``ready`` (dashboard: address of Dask's dashboard) and
            ``rows`` (statuses: numbers of cells by status).

    Raises:
        InputError: the space is invalid, the folder has other contents, or there is no scheduler at the address.
        LatheError: workers died, or the disk is full; the computed rows are saved.

    Example:
        >>> import lathe_explore
        >>> import lathe_rc
        >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=10"])
        >>> space = lathe_explore.Space(grid={"learning_controller.lead_time": [1.3e-3, 1.425e-3, 3e-3]})
        >>> lathe_explore.run_sweep(piston, space, "leads")
        <Sweep of piston in leads: 2 done, 1 refused>
    """
    scenario = of_load(scenario)
    standard = [] if row.has_tool(scenario) else row.figures(scenario)
    asked = [row.measure(text, scenario) for text in dict.fromkeys([*standard, *measures])]
    if not isinstance(space, Space):
        raise InputError(
            f"space = {space!r:.60}; allowed: a lathe_explore.Space, such as Space(grid={{'NODE.PARAM': [VALUES]}})"
        )
    space = Space(**space.to_json())
    scenario = scenario.with_models_given() if models == "nominal" else scenario
    space.check(scenario)
    kept = Folder.begin(Path(folder), scenario, space, asked)
    with kept.locked():
        if again := _failures(kept, cell_time, retry=retry):
            kept.forget({job.key for job in _jobs(kept, space) if job.key in again})
        there, total = kept.versions(), space.count(scenario)
        versions = Counter(there[job.key] for job in _jobs(kept, space) if job.key in there) if there else Counter()
        left = total - versions.total()
        watch(
            {
                "event": "began",
                "cells": total,
                "computed": total - left,
                "others": versions - Counter({row.revision(): total}),
            }
        )
        if left:
            with crew_for(scenario, client, scheduler, workers, watch) as crew:
                jobs = (job for job in _jobs(kept, space) if job.key not in there)
                keep(kept, rows(crew, order_of(kept), jobs, left, cell_time), watch)
    return Sweep(kept)


def _failures(folder: Folder, cell_time: float | None, *, retry: bool) -> set[str]:
    """Return the keys of failed cells of which another try may help (arguments as of `run_sweep`)."""
    found = folder.table(["key", "status", "reason", "version", "time_limit"])
    return {
        each["key"]
        for each in found.filter(pyarrow.compute.field("status") == row.FAILED).to_pylist()
        if retry
        or each["version"] != row.revision()
        or (each["time_limit"] or math.inf) < (cell_time or 0.0)
        or KILLED in each["reason"]
    }


@contextmanager
def crew_for(
    scenario: Scenario, client: distributed.Client | None, scheduler: str | None, workers: int | None, watch: Watch
) -> Iterator[distributed.Client]:
    """Compile the kernels of a scenario, and yield a Dask client; arguments and events as in `run_sweep`."""
    # Kernels are compiled once here, into the shared cache, instead of in every worker at the same time.
    for stages in compile_ahead(Cell(scenario.nodes).stages.values()):
        watch({"event": "compiling", "nodes": stages})
    with nullcontext(client) if client else client_of(scheduler, workers) as crew:
        watch({"event": "ready", "dashboard": crew.dashboard_link})
        yield crew


def order_of(folder: Folder) -> Order:
    """Return the data shared by all jobs in a folder."""
    scenario = folder.scenario
    text = scenario.to_yaml(given=True)
    return Order(
        scenario.name,
        text,
        scenario.identity,
        folder.targets,
        folder.measures,
        folder.schema,
        allowed_code.arguments(),
        folder.inputs,
    )


def keep(
    folder: Folder, found: Generator[pa.Table], watch: Watch, take: Callable[[pa.Table], None] | None = None
) -> None:
    """Write rows as they arrive, one file every few seconds; after an interruption, the remaining rows are written too.

    Args:
        folder: folder of the rows.
        found: tables of rows, see `lathe_explore.sweep.workers.rows`; the generator is closed at the end, which cancels
            the remaining cells.
        watch: see `run_sweep`.
        take: called with each table before it is written.
    """
    waiting: list[pa.Table] = []
    written = time.monotonic()
    with closing(found):
        try:
            for table in found:
                waiting.append(table)
                if take:
                    take(table)
                watch({"event": "rows", "statuses": Counter(table.column("status").to_pylist())})
                if time.monotonic() > written + _WRITE:
                    some, waiting = waiting, []
                    folder.write(some)
                    written = time.monotonic()
        finally:
            if waiting:
                folder.write(waiting)


def _jobs(folder: Folder, space: Space) -> Iterator[Job]:
    """Yield the cells of a space as jobs, numbered across all spaces of the folder in the order of their requests."""
    key = Key(folder)
    # A single space has no duplicate cells, so no table of keys is needed, which could have millions of entries.
    if folder.spaces == [space]:
        for number, values in enumerate(space.cells(folder.scenario)):
            yield key.job(number, values)
        return
    numbers: dict[str, int] = {}
    for each in folder.spaces:
        for values in each.cells(folder.scenario):
            found = key.job(len(numbers), values)
            number = numbers.setdefault(found.key, len(numbers))
            if each == space:
                yield found._replace(number=number)


class Key:
    """Keys of cells: hashes of the scenario, the measures, and the values that differ from the scenario's own.

    A hash covers the content of the third-party classes and the files that the cell names.
    """

    def __init__(self, folder: Folder) -> None:
        self._scenario = scenario = folder.scenario
        self._base = {target: scenario.value(target) for target in [*folder.targets, "seed"]}
        # Such a parameter has the scenario's value in a cell only if it is given: otherwise it follows a varied drive.
        for target in [target for target in folder.targets if scenario.follows(target)]:
            del self._base[target]
        self._naming = [target for target in folder.targets if inputs.names_inputs(scenario, target)]
        self._named: dict[str, dict[str, str]] = {}
        self._carried = folder.carried
        self._inputs = inputs.of_cell(scenario, folder.measures)
        self._code = inputs.code(self._inputs)
        measured = sorted(each.name for each in folder.measures)
        self._start = hashlib.sha256("\n".join([scenario.identity, *measured, *filter(None, [self._code])]).encode())

    def job(self, number: int, values: dict[str, Value]) -> Job:
        """Return the job of a cell, with its key in hexadecimal digits."""
        carried = {name: str(values.pop(name)) for name in self._carried if name in values}
        own: dict[str, Any] = {
            target: value for target, value in values.items() if value != self._base.get(target)
        } | carried
        code = self._code
        if naming := {target: own[target] for target in self._naming if target in own}:
            text = canonical(naming)
            if text not in self._named:
                self._named[text] = inputs.of_values(self._scenario, naming)
            own["inputs"] = sorted(self._named[text].values())
            code = inputs.code(self._inputs | self._named[text])
        found = self._start.copy()
        found.update(canonical(own).encode())
        return Job(number, found.hexdigest()[:32], values, code, carried)
