# SPDX-License-Identifier: Apache-2.0
"""The cells of a sweep on Dask's workers: as many tasks as keep them busy, each of a few seconds.

Dask schedules, retries and moves data. What is decided here is how many cells a task has: after the first ones, which
compile what is not compiled yet, as many as take `TASK` seconds.
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
from lathe_rc.sweep.row import Measure

TASK = 2.0  #: [s] of a task
_GROWTH = 4  # of a task's cells against the one before
_MOST = 4096  # cells of a task
_LEAST = 8  # towards the end tasks get shorter, down to this part of the others
_AHEAD = 2  # tasks for each thread of the workers
_CONNECT = 5  # [s] to reach a scheduler
_SETTINGS = {  # of this machine's workers
    # A worker that dies is blamed on every task that it has: so it has one, and none waits there.
    "distributed.scheduler.worker-saturation": 1.0,
    # Dask looks every 10 ms where a worker is, every 20 whether its loop is late, and every 100 at its memory: that
    # takes a tenth of the time of short cells.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "200ms",
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.admin.system-monitor.interval": "2s",
}


class Job(NamedTuple):
    """A cell to be computed.

    Attributes:
        number: within the sweep.
        key: its identity.
        values: that differ from the scenario's.
    """

    number: int
    key: str
    values: dict[str, Value]


class Order(NamedTuple):
    """The data that all jobs share; travels to the workers as it is.

    Attributes:
        name: of the scenario.
        text: the scenario as a parameter file; a worker reads it once.
        identity: of the scenario, as it has to be there as well.
        targets: columns of what differs.
        measures: what is measured.
        schema: of the rows.
        code: options that let a worker import packages for it, see `lathe_rc.allowed_code`.
    """

    name: str
    text: str
    identity: str
    targets: Sequence[str]
    measures: Sequence[Measure]
    schema: pa.Schema
    code: Sequence[str]


@dataclass(frozen=True)
class Share:
    """The jobs of a task. Dask looks for other tasks in all lists and tuples that it is given, but not in this."""

    order: Order
    jobs: Sequence[Job]


@lru_cache(maxsize=4)
def _scenario(name: str, text: str, identity: str) -> Scenario:
    """The scenario at a worker.

    Raises:
        InputError: it is not the same there.
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
    """The rows of some cells; a task of Dask."""
    order = share.order
    allowed_code.taken_from(order.code)
    base, bench = _scenario(order.name, order.text, order.identity), CellRunner()
    rows = [
        {"cell": job.number, "key": job.key, **row.compute(base, job.values, order.targets, order.measures, bench)}
        for job in share.jobs
    ]
    return pa.Table.from_pylist(rows, order.schema)


@contextmanager
def client_of(scheduler: str | None, workers: int | None) -> Iterator[distributed.Client]:
    """A client of a scheduler, or of workers of this machine's own, which end with the block.

    Args:
        scheduler: address, such as ``tcp://host:8786``; None: this machine.
        workers: processes of this machine; None: one for each core.

    Raises:
        InputError: nobody is at the address.
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
    """Keep the current folder off the path of Python processes that are started meanwhile."""
    before = os.environ.get("PYTHONSAFEPATH", "")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        os.environ["PYTHONSAFEPATH"] = before  # empty: as if it were not set


def _cluster(workers: int | None) -> distributed.LocalCluster:
    # Ctrl-C is for this process, which ends its workers.
    before = None
    if threading.current_thread() is threading.main_thread():
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with dask.config.set(_SETTINGS):
            return distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",  # a process that reaches a scheduler or a worker runs code there
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            )
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)


def rows(client: distributed.Client, order: Order, jobs: Iterable[Job], count: int) -> Generator[pa.Table]:
    """Compute cells; their rows as they come.

    Args:
        client: whose workers do it.
        order: what the jobs have in common.
        jobs: asked for as workers get free.
        count: of them.

    Raises:
        LatheError: workers died over the same cells again and again.
    """
    waiting = iter(jobs)
    left, size = count, 1
    sent: dict[distributed.Future[pa.Table], Sequence[Job]] = {}
    arriving = distributed.as_completed(loop=client.loop)
    try:
        while True:
            threads = max(sum(client.nthreads().values()), 1)
            while len(sent) < _AHEAD * threads:
                fair = -(-left // (_AHEAD * threads))  # so that all workers end at about the same time
                if not (some := list(islice(waiting, max(min(size, fair), size // _LEAST, 1)))):
                    break
                left -= len(some)
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
    """How many cells the next task has."""
    took: float = sum(found.column("seconds").to_pylist())
    fitting: int = round(TASK * found.num_rows / max(took, 1e-6))
    grown: int = _GROWTH * max(size, found.num_rows)
    return max(1, min(fitting, grown, _MOST))
