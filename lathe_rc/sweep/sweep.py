# SPDX-License-Identifier: Apache-2.0
"""Sweep from its space to its table of results."""

import hashlib
import os
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import distributed
import pyarrow as pa

from lathe_rc import allowed_code
from lathe_rc.cell.ahead import compile_ahead
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario, content
from lathe_rc.cell.wiring import Cell
from lathe_rc.sweep import row
from lathe_rc.sweep.folder import Folder
from lathe_rc.sweep.space import Space, canonical
from lathe_rc.sweep.workers import Job, Order, client_of, rows

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
        """The scenario, and the numbers of cells by outcome."""
        told = ", ".join(f"{count} {status}" for status, count in self.statuses().items())
        return f"<Sweep of {self.folder.scenario.name} in {self.folder.path}: {told or 'nothing computed'}>"

    def table(self) -> pa.Table:
        """Return the rows, in the order of the cells; see `lathe_rc.sweep.row`."""
        return self.folder.table()

    def frame(self) -> "pd.DataFrame":
        """Return the rows as a pandas data frame."""
        return self.table().to_pandas()

    def statuses(self) -> dict[str, int]:
        """Return the numbers of cells by status, most frequent first."""
        return dict(Counter(self.folder.table(["status"]).column("status").to_pylist()).most_common())

    def row(self, number: int) -> dict[str, Any]:
        """Return the row of a cell, by column; raises as `scenario` does."""
        return self.folder.row(number)

    def scenario(self, number: int) -> Scenario:
        """Return the scenario of a cell, to run it again.

        Raises:
            InputError: there is no such cell, it is not computed, or it was refused.
        """
        return self.folder.scenario.varied(self.folder.values(number))


def ignore(event: Mapping[str, Any]) -> None:
    """Ignore the events of a sweep."""


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
    watch: Watch = ignore,
) -> Sweep:
    """Compute the cells of a space that are not in the folder yet.

    Args:
        scenario: the varied cell; it needs a number of revolutions.
        space: its variations.
        folder: folder of the results; a stopped sweep is continued, and further spaces are added.
        measures: further columns, ``TOPIC.FIELD:STATISTIC``.
        models: drive models of controllers, where the scenario does not give them: ``follow`` the varied drives, or
            stay ``nominal``, as when one controller has to serve many drives.
        scheduler: address of a scheduler of Dask; None: workers of this machine.
        workers: number of worker processes of this machine; None: one for each core.
        client: client of Dask, in place of both.
        watch: called with the events ``began`` (cells; computed: number of those that exist already), ``compiling``
            (nodes), ``ready`` (dashboard: address of Dask's) and ``rows`` (statuses: numbers of cells by status).

    Raises:
        InputError: no space of this scenario, the folder holds something else, or no scheduler is at the address.
        LatheError: workers died, or the disk is full; the computed rows are kept.

    Example:
        >>> import lathe_rc
        >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=10"])
        >>> space = lathe_rc.Space(grid={"learning_controller.lead_time": [1.3e-3, 1.425e-3, 3e-3]})
        >>> lathe_rc.run_sweep(piston, space, "leads")
        <Sweep of piston in leads: 2 done, 1 refused>
    """
    asked = [row.measure(text, scenario) for text in measures]
    space = Space(**space.to_json())
    scenario = scenario.with_models_given() if models == "nominal" else scenario
    space.check(scenario)
    kept = Folder.begin(Path(folder), scenario, space, asked)
    with kept.locked():
        there, total = kept.keys(), space.count(scenario)
        left = total - sum(1 for job in _jobs(kept, space) if job.key in there) if there else total
        watch({"event": "began", "cells": total, "computed": total - left})
        if left:
            with crew_for(scenario, client, scheduler, workers, watch) as crew:
                jobs = (job for job in _jobs(kept, space) if job.key not in there)
                keep(kept, rows(crew, order_of(kept), jobs, left), watch)
    return Sweep(kept)


@contextmanager
def crew_for(
    scenario: Scenario, client: distributed.Client | None, scheduler: str | None, workers: int | None, watch: Watch
) -> Iterator[distributed.Client]:
    """Yield the workers for cells of a scenario; arguments and events as in `run_sweep`."""
    # Kernels are compiled here once, into the cache of all processes, instead of in every worker at the same time.
    for stages in compile_ahead(Cell(scenario.nodes).stages.values()):
        watch({"event": "compiling", "nodes": stages})
    with nullcontext(client) if client else client_of(scheduler, workers) as crew:
        watch({"event": "ready", "dashboard": crew.dashboard_link})
        yield crew


def order_of(folder: Folder) -> Order:
    """Return the order that all jobs of a folder share."""
    scenario = folder.scenario
    text = scenario.to_yaml(given=True)
    return Order(
        scenario.name, text, scenario.identity, folder.targets, folder.measures, folder.schema, allowed_code.arguments()
    )


def keep(
    folder: Folder, found: Generator[pa.Table], watch: Watch, take: Callable[[pa.Table], None] | None = None
) -> None:
    """Write rows as they arrive, one file every few seconds, and the last ones also after an interruption.

    Args:
        folder: folder of the rows.
        found: tables of rows, see `lathe_rc.sweep.workers.rows`; closing it cancels the cells not yet computed.
        watch: see `run_sweep`.
        take: called with the rows before they are written.
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
    """Yield the cells of a space, numbered through all spaces of the folder in the order of their requests."""
    key = Key(folder)
    # Of the only space no cell occurs twice: its cells need no table of keys, which may be millions.
    if folder.spaces == [space]:
        for number, values in enumerate(space.cells(folder.scenario)):
            yield Job(number, key.of(values), values)
        return
    numbers: dict[str, int] = {}
    for each in folder.spaces:
        for values in each.cells(folder.scenario):
            found = key.of(values)
            number = numbers.setdefault(found, len(numbers))
            if each == space:
                yield Job(number, found, values)


class Key:
    """Identities of cells: hashes of the scenario, the measures, and the values that differ from the scenario's own."""

    def __init__(self, folder: Folder) -> None:
        scenario = folder.scenario
        self._base = {target: scenario.value(target) for target in [*folder.targets, "seed"]}
        self._files = {target for target in folder.targets if scenario.parameter(target).is_path}
        measured = [each.name for each in folder.measures]
        self._start = hashlib.sha256("\n".join([scenario.identity, *sorted(measured)]).encode())

    def of(self, values: Mapping[str, Value]) -> str:
        """Return the identity of a cell in hexadecimal digits."""
        own = {target: value for target, value in values.items() if value != self._base[target]}
        # A file is identified by its content, not by its path.
        for target in self._files & own.keys():
            own[target] = content(Path(str(own[target])))
        found = self._start.copy()
        found.update(canonical(own).encode())
        return found.hexdigest()[:32]
