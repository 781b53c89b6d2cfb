# SPDX-License-Identifier: Apache-2.0
"""Batches of cells that run through the same compiled program, on all cores.

    piston = lathe_rc.load("piston")
    cells = (piston.varied({"learning_controller.learning_gain": gain}) for gain in (0.25, 0.5, 1.0))
    for outcome in lathe_rc.run_many(cells):
        print(outcome.kept.rms[-1])

Results are bit-identical to those of single runs, although consecutive cells share unchanged parts (`CellRunner`).
Only the requested signals are kept, and each cell is created just before its run, so that the memory required by a
batch does not depend on the number of cells.
"""

import os
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Protocol, TypeVar, overload

from lathe_rc import messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.collect import Collector
from lathe_rc.cell.engine import Engine, Sink
from lathe_rc.cell.recording import Recording
from lathe_rc.cell.running_form import RunningForm
from lathe_rc.cell.scenario import Scenario, of_load
from lathe_rc.cell.stage_cache import StageCache
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.messages import Signals
from lathe_rc.signals.form_errors import FormErrors
from lathe_rc.signals.zones import Zone

K_co = TypeVar("K_co", covariant=True)

_AHEAD = 2  # cells created ahead for each thread


class Keeper(Sink, Protocol[K_co]):
    """Sink that keeps the requested part of a run; the cell's stages may be reused in the next run."""

    @property
    def heard(self) -> Collection[str]:
        """Relative topics, or single fields ``TOPIC.FIELD``, that the sink receives; no others are kept."""

    def kept(self) -> K_co:
        """Return the result to keep, at the end of the run."""


Make = Callable[[Cell, int], Keeper[K_co]]  #: factory of the keeper for a cell and a number of samples


@dataclass(frozen=True)
class Outcome(Generic[K_co]):
    """Outcome of a cell's run.

    Attributes:
        scenario: scenario of the cell.
        kept: result of the cell's keeper; None if the cell failed.
        error: reason for rejection or failure; None after success.
    """

    scenario: Scenario
    kept: K_co | None
    error: LatheError | None = None


@overload
def run_many(scenarios: Iterable[Scenario], *, threads: int | None = None) -> Iterator[Outcome[FormErrors]]: ...


@overload
def run_many(
    scenarios: Iterable[Scenario], keep: Sequence[str], *, threads: int | None = None
) -> Iterator[Outcome[Recording]]: ...


@overload
def run_many(
    scenarios: Iterable[Scenario], keep: Make[K_co], *, threads: int | None = None
) -> Iterator[Outcome[K_co]]: ...


def run_many(
    scenarios: Iterable[Scenario], keep: Make[Any] | Sequence[str] | None = None, *, threads: int | None = None
) -> Iterator[Outcome[Any]]:
    """Run cells to completion, in parallel.

    Args:
        scenarios: scenarios of the cells, read lazily; each needs a number of revolutions. Variations of a
            `Scenario.named` are created in half the time.
        keep: the part of each run that is kept. None: the form error by revolution; relative topics: all samples of
            these; or a factory of the `Keeper` for a cell and a number of samples.
        threads: number of computing threads; None: one per core.

    Yields:
        The outcomes, in the order of the scenarios, including those of rejected and failed cells.

    Example:
        >>> import lathe_rc
        >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=10"])
        >>> cells = [piston.varied({"learning_controller.lead_time": lead}) for lead in (1.425e-3, 1.3e-3, 3e-3)]
        >>> for outcome in lathe_rc.run_many(cells):
        ...     lead = outcome.scenario.nodes["learning_controller"].lead_time
        ...     told = outcome.error or f"{outcome.kept.rms[-1] * 1e6:.3f} µm RMS"
        ...     print(f"{lead * 1e3} ms: {told}"[:60])
        1.425 ms: 0.545 µm RMS
        1.3 ms: 0.656 µm RMS
        3.0 ms: learning_controller: learning diverges with electrod
        >>> (outcome,) = lathe_rc.run_many([piston], ["tool"])
        >>> len(outcome.kept.frame("/tool"))
        38395
    """
    if isinstance(scenarios, Scenario):
        raise InputError("run_many of one scenario; allowed: a list, [scenario]")
    make = keep if callable(keep) else Errors if keep is None else partial(Topics, topics=keep)
    count = threads or os.cpu_count() or 1
    waiting: deque[Future[Outcome[Any]]] = deque()
    # There is one runner per thread; a deque hands out runners and takes them back without a lock.
    pool, idle = ThreadPoolExecutor(count), deque(CellRunner() for _ in range(count))
    try:
        for number, scenario in enumerate(scenarios):
            waiting.append(pool.submit(_outcome, of_load(scenario), make, idle))
            # The first run compiles the code that the others use.
            if number == 0 or len(waiting) > _AHEAD * count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


class CellRunner:
    """Sequential runner of cells; similar cells share the engine and the unchanged stages."""

    def __init__(self) -> None:
        self._stages = StageCache()
        self._engine: Engine | None = None

    def cell(self, scenario: Scenario) -> Cell:
        """Return the cell of a scenario; it is valid until the next call.

        Raises:
            InputError: see `Cell`.
        """
        return Cell(scenario.nodes, stage=self._stages.take)

    def run(self, cell: Cell, keeper: Keeper[K_co]) -> K_co:
        """Run a checked cell to completion.

        Raises:
            LatheError: the cell cannot continue.
        """
        if self._engine is None or not self._engine.begin(cell, keeper.heard):
            self._engine = Engine(cell, keeper.heard)
        self._engine.run([keeper])
        return keeper.kept()


def _outcome(scenario: Scenario, keep: Make[K_co], idle: deque[CellRunner]) -> Outcome[K_co]:
    runner = idle.pop()
    try:
        cell = runner.cell(scenario)
        cell.check(cures=False)
        return Outcome(scenario, runner.run(cell, keep(cell, cell.samples - cell.first)))
    except LatheError as error:
        return Outcome(scenario, None, error)
    finally:
        idle.append(runner)


class Errors:
    """Keeper of the form error by revolution (``form``), by zones if there are some."""

    def __init__(self, cell: Cell, samples: int, zones: Sequence[Zone] = ()) -> None:
        self.form = RunningForm.of({topic: source.type for topic, source in cell.dense.items()}, zones)
        encoder, tool = self.form.encoder, self.form.tool
        read = [(encoder, "angle_true"), (tool, "error"), *([(tool, "height")] if zones else [])]
        self.heard: Collection[str] = [f"{topic}.{field}" for topic, field in read if topic]
        if any(stage.shared.faults for stage in cell.stages.values()):
            self.heard = [*self.heard, *(t for t, source in cell.sparse.items() if source.type == messages.EVENT)]

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Process a chunk of the run, as a sink of the engine."""
        self.form.chunk(first, samples, dense, sparse)

    def kept(self) -> FormErrors:
        """Return the form error of each complete revolution; empty if the scenario has no tool."""
        return self.form.found()


class Topics(Collector):
    """Keeper of complete topics.

    Args:
        cell: the running cell.
        samples: length of the run [sample].
        topics: relative topic names.

    Raises:
        InputError: the cell has no such topic.
    """

    def __init__(self, cell: Cell, samples: int, topics: Collection[str]) -> None:
        super().__init__(cell, samples, topics, cell.first)
        self.heard = topics

    def kept(self) -> Recording:
        """Return the recording of the kept topics."""
        return self.recording()
