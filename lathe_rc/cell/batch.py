# SPDX-License-Identifier: Apache-2.0
"""Many cells at once, all through the same compiled program, on all cores.

    piston = lathe_rc.load("piston")
    cells = (piston.varied({"learning_controller.learning_gain": gain}) for gain in (0.25, 0.5, 1.0))
    for outcome in lathe_rc.run_many(cells):
        print(outcome.kept.rms[-1])

A cell gets the bits that it gets alone, though it shares with the one before what does not differ: see `CellRunner`.
Nothing is kept of its signals but what is asked for, and cells are made when their turn comes, so that the memory that
a batch takes does not depend on how many they are.
"""

import os
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Protocol, TypeVar, overload

from lathe_rc import messages
from lathe_rc.analysis.form_errors import FormErrors, RunningErrors
from lathe_rc.cell.collect import Collector
from lathe_rc.cell.engine import Engine, Sink
from lathe_rc.cell.recording import Recording
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.stage_cache import StageCache
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError
from lathe_rc.messages import Signals

K_co = TypeVar("K_co", covariant=True)

_AHEAD = 2  # cells that are made for each thread before the first of them has been taken


class Keeper(Sink, Protocol[K_co]):
    """A sink that keeps of a run what is asked for; the cell's stages run again in the next one."""

    @property
    def heard(self) -> Collection[str]:
        """Relative topics that it takes, or single fields, ``TOPIC.FIELD``; nothing else is kept."""

    def kept(self) -> K_co:
        """The kept result, at the end of the run."""


Make = Callable[[Cell, int], Keeper[K_co]]  #: makes a keeper for a cell and so many samples


@dataclass(frozen=True)
class Outcome(Generic[K_co]):
    """The outcome of a cell.

    Attributes:
        scenario: of the cell.
        kept: what its keeper kept; None if it failed.
        error: why it was refused or failed; None if it was not.
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
    """Run cells to their ends.

    Args:
        scenarios: of the cells; each needs a number of revolutions. They are asked for as their turn comes; variations
            of a `Scenario.named` are made in half the time.
        keep: the part of a run that is kept: None: its form error by revolution; relative topics: these, whole; or a
            function that makes a `Keeper` for a cell and a number of samples.
        threads: that compute; None: one for each core.

    Yields:
        The outcomes, in the order of the scenarios. A cell that is refused, or that fails on the way, is one of them.

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
    make = keep if callable(keep) else Errors if keep is None else partial(Topics, topics=keep)
    count = threads or os.cpu_count() or 1
    waiting: deque[Future[Outcome[Any]]] = deque()
    # A runner a thread; a deque hands one out and takes it back without a lock.
    pool, idle = ThreadPoolExecutor(count), deque(CellRunner() for _ in range(count))
    try:
        for number, scenario in enumerate(scenarios):
            waiting.append(pool.submit(_outcome, scenario, make, idle))
            # The first compiles what the others use.
            if number == 0 or len(waiting) > _AHEAD * count:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


class CellRunner:
    """Runs cells one after the other. Those that are alike share what does not differ: engine, and stages."""

    def __init__(self) -> None:
        self._stages = StageCache()
        self._engine: Engine | None = None

    def cell(self, scenario: Scenario) -> Cell:
        """Return the cell of a scenario; it is good until the next one is asked for.

        Raises:
            InputError: see `Cell`.
        """
        return Cell(scenario.nodes, stage=self._stages.take)

    def run(self, cell: Cell, keeper: Keeper[K_co]) -> K_co:
        """Run a cell that has passed its check to its end.

        Raises:
            LatheError: it cannot go on.
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
        return Outcome(scenario, runner.run(cell, keep(cell, cell.samples)))
    except LatheError as error:
        return Outcome(scenario, None, error)
    finally:
        idle.append(runner)


class Errors:
    """Keeps the form error by revolution."""

    def __init__(self, cell: Cell, samples: int) -> None:
        named = {source.type: topic for topic, source in reversed(cell.dense.items())}
        self._encoder, self._tool = named.get(messages.ENCODER), named.get(messages.TOOL)
        read = {self._encoder: "angle_true", self._tool: "error"}
        self.heard: Collection[str] = [f"{topic}.{field}" for topic, field in read.items() if topic]
        self._errors = RunningErrors()

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Take a piece of the run, as a sink of the engine."""
        if self._encoder and self._tool:
            self._errors.add(dense[self._encoder]["angle_true"], dense[self._tool]["error"])

    def kept(self) -> FormErrors:
        """Return the form error of each complete revolution; of none if the scenario has no tool."""
        return self._errors.found()


class Topics(Collector):
    """Keeps some topics whole.

    Args:
        cell: that runs.
        samples: of the run.
        topics: relative names.

    Raises:
        InputError: the cell has no such topic.
    """

    def __init__(self, cell: Cell, samples: int, topics: Collection[str]) -> None:
        super().__init__(cell, samples, topics)
        self.heard = topics

    def kept(self) -> Recording:
        """Return the recording of the topics."""
        return self.recording()
