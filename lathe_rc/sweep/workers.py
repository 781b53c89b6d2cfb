# SPDX-License-Identifier: Apache-2.0
"""Computation of a sweep's cells on Dask workers, in tasks of a few seconds.

Dask schedules, retries and moves data. This module sets the number of cells per task: the first tasks, which compile
missing kernels, are small, and later ones are sized to take `TASK` seconds.
"""

import logging
import os
import signal
import tempfile
import threading
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import dask
import distributed
import pyarrow as pa
from distributed.scheduler import KilledWorker

from lathe_rc import allowed_code
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.batch import CellRunner
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.sweep import row
from lathe_rc.sweep.inputs import Inputs, check_here
from lathe_rc.sweep.row import Measure

TASK = 2.0  #: target duration of a task [s]
_GROWTH = 4  # largest ratio of a task's cells to those of the previous task
_MOST = 4096  # most cells of a task
_LEAST = 8  # towards the end, tasks get shorter, down to 1/8 of the others
_AHEAD = 2  # tasks per worker thread: one is running, and the next is ready at the scheduler
_CONNECT = 5  # [s] allowed for reaching a scheduler
_SETTINGS = {  # settings of this machine's workers
    # Dask counts the death of a worker against every task assigned to it, so only the running task is assigned.
    "distributed.scheduler.worker-saturation": 1.0,
    # By default Dask profiles a worker every 10 ms, checks its event loop every 20 ms and its memory every 100 ms,
    # which takes 10 % of the time of short cells.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "200ms",
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.admin.system-monitor.interval": "2s",
}


class Job(NamedTuple):
    """Cell to be computed by a worker.

    Attributes:
        number: number within the sweep.
        key: hash that identifies the cell.
        values: values of the varied parameters, by target.
        code: hash of the third-party classes of the cell; None if there are none.
    """

    number: int
    key: str
    values: dict[str, Value]
    code: str | None


class Order(NamedTuple):
    """Data shared by all jobs of a sweep, sent to the workers with each task.

    Attributes:
        name: name of the scenario.
        text: the scenario as a parameter file; a worker parses it once.
        identity: identity of the scenario, which the worker verifies.
        targets: columns of the varied parameters.
        measures: further columns.
        schema: schema of the rows.
        allowed: options that allow a worker to import packages, see `lathe_rc.allowed_code`.
        inputs: third-party classes and files, which the worker verifies.
    """

    name: str
    text: str
    identity: str
    targets: Sequence[str]
    measures: Sequence[Measure]
    schema: pa.Schema
    allowed: Sequence[str]
    inputs: Inputs


@dataclass(frozen=True)
class Share:
    """Jobs of one task; a class, because Dask searches lists and tuples in its arguments for other tasks."""

    order: Order
    jobs: Sequence[Job]


@lru_cache(maxsize=4)
def _scenario(name: str, text: str, identity: str) -> Scenario:
    """Return the scenario on a worker.

    Raises:
        InputError: its identity differs from that of the client's scenario.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.yaml"
        path.write_text(text, encoding="utf-8")
        found = replace(scenarios.load(path), name=name)
    if found.identity != identity:
        raise InputError(
            f"{name} is another cell at a worker: another lathe_rc, or files that it names differ; allowed: the same"
        )
    return found.named()


def compute(share: Share) -> pa.Table:
    """Compute the rows of several cells (task function for Dask)."""
    order = share.order
    allowed_code.taken_from(order.allowed)
    base, bench = _scenario(order.name, order.text, order.identity), CellRunner()
    rows = [
        {"cell": job.number, "key": job.key, "code": job.code}
        | row.compute(base, job.values, order.targets, order.measures, bench)
        for job in share.jobs
    ]
    check_here(order.inputs)  # not earlier: a cell imports the classes that its values name
    return pa.Table.from_pylist(rows, order.schema)


@contextmanager
def client_of(scheduler: str | None, workers: int | None) -> Iterator[distributed.Client]:
    """Yield a Dask client of a scheduler, or of local workers that end with the block.

    Args:
        scheduler: address, such as ``tcp://host:8786``; None: local workers on this machine.
        workers: number of worker processes on this machine; None: one per core.

    Raises:
        InputError: there is no scheduler at the address.
    """
    if scheduler is not None:
        try:
            client = distributed.Client(scheduler, timeout=_CONNECT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                f"scheduler {scheduler}: {shown(error)}; allowed: the address that dask scheduler prints"
            ) from None
        with client:
            yield client
        return
    with _safe_path(), _cluster(workers) as cluster, distributed.Client(cluster, set_as_default=False) as client:
        yield client


@contextmanager
def _safe_path() -> Iterator[None]:
    """Exclude the current folder from the import path of Python processes started within the block."""
    before = os.environ.get("PYTHONSAFEPATH", "")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        os.environ["PYTHONSAFEPATH"] = before  # empty: as if it were not set


def _cluster(workers: int | None) -> distributed.LocalCluster:
    # A terminal sends Ctrl-C to all processes. The workers inherit the setting to ignore it; this process ends them.
    before = None
    if threading.current_thread() is threading.main_thread():
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with dask.config.set(_SETTINGS):
            return distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",  # any process that reaches a scheduler or a worker can run code there
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            )
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)


def rows(client: distributed.Client, order: Order, jobs: Iterable[Job], count: int) -> Generator[pa.Table]:
    """Compute cells and yield their rows as they arrive.

    Args:
        client: client whose workers compute the cells.
        order: data shared by the jobs.
        jobs: cells, taken from the iterator when workers become free.
        count: number of jobs.

    Raises:
        LatheError: workers died repeatedly while computing the same cells.
    """
    waiting = iter(jobs)
    left, size = count, 1
    sent: dict[distributed.Future[pa.Table], Sequence[Job]] = {}
    arriving = distributed.as_completed(loop=client.loop)
    try:
        while True:
            threads = max(sum(client.nthreads().values()), 1)
            while len(sent) < _AHEAD * threads:
                fair = -(-left // (_AHEAD * threads))  # rounded up: all workers end at about the same time
                if not (some := list(islice(waiting, max(min(size, fair), size // _LEAST, 1)))):
                    break
                left -= len(some)
                # Not pure; otherwise Dask would hash all jobs of a task in order to recognise the task.
                future = client.submit(compute, Share(order, some), pure=False)
                sent[future] = some
                arriving.add(future)
            if not sent:
                return
            future = next(arriving)
            found = _result(future, sent.pop(future))
            size = _next(size, found)
            yield found
    finally:
        client.cancel(list(sent))


def _result(future: distributed.Future[pa.Table], jobs: Sequence[Job]) -> pa.Table:
    try:
        return future.result()
    except KilledWorker:
        raise LatheError(
            f"workers died again and again over cells {jobs[0].number} to {jobs[-1].number}, perhaps out of memory; "
            "what is computed is kept; allowed: fewer workers (--workers), or shorter runs"
        ) from None
    except (distributed.CancelledError, OSError) as error:
        raise LatheError(f"the scheduler is gone ({shown(error)}); what is computed is kept") from None


def _next(size: int, found: pa.Table) -> int:
    """Return the number of cells for the next task, based on the computing times of the last task."""
    took: float = sum(found.column("seconds").to_pylist())
    fitting: int = round(TASK * found.num_rows / max(took, 1e-6))
    grown: int = _GROWTH * max(size, found.num_rows)
    return max(1, min(fitting, grown, _MOST))
