# SPDX-License-Identifier: Apache-2.0
"""Computation of a sweep's cells on Dask workers, in tasks of a few seconds.

Dask schedules and moves data. This module sets the number of cells per task: the first tasks, which compile missing
kernels, are small, and later ones are sized to take `TASK` seconds. If a worker dies, its cells are computed once more,
each such that it cannot end the worker (`lathe_explore.sweep.alone`).
"""

import logging
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import dask
import distributed
import pyarrow as pa
from distributed.scheduler import KilledWorker

from lathe_explore.sweep import row
from lathe_explore.sweep.alone import NO_END, Watchdog, alone, limit_memory
from lathe_explore.sweep.inputs import Inputs, check_here
from lathe_explore.sweep.row import Measure
from lathe_rc import allowed_code
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.batch import CellRunner
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, LatheError, shown

TASK = 2.0  #: target duration of a task [s]
_GROWTH = 4  # largest ratio of a task's cells to those of the previous task
_MOST = 4096  # most cells of a task
_LEAST = 8  # towards the end, tasks get shorter, down to 1/8 of the others
_AHEAD = 2  # tasks per worker thread: one is running, and the next is ready at the scheduler
_CONNECT = 5  # [s] allowed for reaching a scheduler
# Time limit of a cell [s]: of the first ones, the least, and relative to the slowest cell so far.
_UNKNOWN, _SHORTEST, _SLOWER = 600.0, 60.0, 20.0
_DEATHS = 4  # workers that may die with a task; a task that waits at a worker dies with it as well
_MEMORY = 0.9  # share of a worker's memory that its cells may use; Dask ends a worker with 0.95
_SETTINGS = {  # settings of this machine's workers
    # Dask counts the death of a worker against every task assigned to it, so only the running task is assigned.
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.scheduler.allowed-failures": 0,
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
        carried: values of columns that are no parameters.
    """

    number: int
    key: str
    values: dict[str, Value]
    code: str | None
    carried: Mapping[str, str] = {}


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
    limit: float  # time limit of a cell [s]


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
    order, bench = share.order, CellRunner()
    allowed_code.taken_from(order.allowed)
    rows = []
    with _guarded(share.limit) as begin:
        for job in share.jobs:
            begin()
            rows.append(_row(order, job, bench))
    check_here(order.inputs)  # not earlier: a cell imports the classes that its values name
    return pa.Table.from_pylist(rows, order.schema)


def compute_alone(share: Share) -> pa.Table:
    """Compute the rows of several cells, none of which can end the worker (task function for Dask)."""
    order, began = share.order, time.perf_counter()
    allowed_code.taken_from(order.allowed)
    work = partial(_row, order)
    rows = []
    for job, found in zip(share.jobs, alone(work, share.jobs, share.limit, _memory()), strict=True):
        rows.append(_failed(order, job, found, share.limit) if isinstance(found, str) else found)
        rows[-1].setdefault("seconds", time.perf_counter() - began)
        began = time.perf_counter()
    check_here(order.inputs)
    return pa.Table.from_pylist(rows, order.schema)


def _row(order: Order, job: Job, bench: CellRunner | None = None) -> dict[str, Any]:
    base = _scenario(order.name, order.text, order.identity)
    found = row.compute(base, job.values, order.targets, order.measures, bench)
    return _head(job) | found


def _head(job: Job) -> dict[str, Any]:
    return {"cell": job.number, "key": job.key, "code": job.code, **job.carried}


def _failed(order: Order, job: Job, reason: str, limit: float) -> dict[str, Any]:
    """Return the row of a cell that has ended its process."""
    found = _head(job) | {"status": row.FAILED, "reason": reason}
    found |= {"version": row.revision(), "time_limit": limit if reason.startswith(NO_END) else None, "limits": ""}
    base, values = _scenario(order.name, order.text, order.identity), dict(job.values)
    with suppress(InputError):
        scenario = base.varied(values)
        values = row.effective(scenario, order.targets) | {"seed": scenario.shared.seed}
    return found | values


def _worker() -> distributed.Worker | None:
    """Return the Dask worker that this process consists of; None in a process of the user's own."""
    worker = distributed.get_worker()
    return worker if worker.nanny and worker.state.nthreads == 1 else None


def _memory() -> int | None:
    """Return the memory limit of cells [B]; None: no limit."""
    worker = _worker()
    limit = worker.memory_manager.memory_limit if worker else None
    return int(_MEMORY * limit) if limit else None


@contextmanager
def _guarded(limit: float) -> Iterator[Callable[[], None]]:
    """Limit the time and the memory of a worker's cells; yield a function that begins a cell."""
    if _worker() is None:
        yield lambda: None
        return
    if memory := _memory():
        limit_memory(memory)
    with Path(os.devnull).open("w") as stream:
        watchdog = Watchdog(limit, stream)
        try:
            yield watchdog.begin
        finally:
            watchdog.end()


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
    except RuntimeError as error:
        cause: BaseException = error
        while before_it := cause.__cause__ or cause.__context__:
            cause = before_it
        raise LatheError(
            f"Dask starts no workers on this machine ({shown(cause)}); they need a writable /dev/shm; or "
            "--scheduler with the address of a scheduler elsewhere"
        ) from None
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)


def rows(
    client: distributed.Client, order: Order, jobs: Iterable[Job], count: int, limit: float | None = None
) -> Generator[pa.Table]:
    """Compute cells and yield their rows as they arrive.

    Args:
        client: client whose workers compute the cells.
        order: data shared by the jobs.
        jobs: cells, taken from the iterator when workers become free.
        count: number of jobs.
        limit: time limit of a cell [s]; None: a multiple of the time of the slowest cell so far.

    Raises:
        LatheError: workers died repeatedly with the same task, although its cells could not end them.
    """
    waiting = iter(jobs)
    left, size, longest = count, 1, _UNKNOWN
    sent: dict[distributed.Future[pa.Table], tuple[Sequence[Job], int]] = {}

    def submit(some: Sequence[Job], deaths: int) -> None:
        # Not pure; otherwise Dask would hash all jobs of a task in order to recognise the task.
        task = compute_alone if deaths else compute
        future = client.submit(task, Share(order, some, limit or longest), pure=False)
        sent[future] = some, deaths
        arriving.add(future)

    arriving = distributed.as_completed(loop=client.loop)
    try:
        while True:
            threads = max(sum(client.nthreads().values()), 1)
            while len(sent) < _AHEAD * threads:
                fair = -(-left // (_AHEAD * threads))  # rounded up: all workers end at about the same time
                if not (some := list(islice(waiting, max(min(size, fair), size // _LEAST, 1)))):
                    break
                left -= len(some)
                submit(some, 0)
            if not sent:
                return
            future = next(arriving)
            sharing, deaths = sent.pop(future)
            found = _result(future, sharing, last=deaths == _DEATHS)
            if found is None:
                submit(sharing, deaths + 1)
                continue
            if not deaths:
                slowest = _SLOWER * max(found.column("seconds").to_pylist())
                size, longest = _next(size, found), max(slowest, _SHORTEST, longest if longest < _UNKNOWN else 0.0)
            yield found
    finally:
        client.cancel(list(sent))


def _result(future: distributed.Future[pa.Table], jobs: Sequence[Job], *, last: bool) -> pa.Table | None:
    """Return the rows of a task; None if its worker died, unless it was the last try."""
    try:
        return future.result()
    except KilledWorker:
        if not last:
            return None
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
