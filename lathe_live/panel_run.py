# SPDX-License-Identifier: Apache-2.0
"""Runs of the panel: a thread that advances a run at a pace, and the offline cell that it advances.

Commands are carried out between two blocks. A command that changes the cell is an event at the first sample not yet
computed, and the run lists it, so that the same events in a scenario repeat the run to the bit.
"""

import json
import shlex
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from itertools import count
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Protocol, TypeVar

import numpy as np

from lathe_live.panel_view import View
from lathe_rc import messages
from lathe_rc.bag.writing.record import OfflineRecorder, begin
from lathe_rc.bag.writing.writer import refuse_existing
from lathe_rc.cell import checkpoint, events, time_master
from lathe_rc.cell.ahead import compile_ahead
from lathe_rc.cell.engine import Engine, Sink
from lathe_rc.cell.parameters import Value
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.names import instead

T = TypeVar("T")

_FRAME = 0.04  # [s] of wall time between two advances of a paced run
_PATIENCE = 1.0  # [s] between looks whether the thread that is to answer still runs
_LATE = 0.25  # [s] behind its pace after which a run no longer makes up for the lost time


class PanelRun(Protocol):
    """Run that a thread advances.

    Attributes:
        view: what is shown of it.
    """

    view: View

    @property
    def reached(self) -> int:
        """Number of samples computed or shown."""

    @property
    def samples(self) -> int:
        """Index after the last sample."""

    @property
    def block(self) -> int:
        """Samples between two commands."""

    @property
    def step(self) -> float:
        """Sampling step [s]."""

    def advance(self, end: int) -> None:
        """Compute or show samples up to ``end`` or some blocks less."""

    def turn_end(self) -> int:
        """Return the sample at which the revolution in progress ends."""

    def told(self) -> Mapping[str, Any]:
        """Return the status of the run, for its snapshots."""

    def close(self) -> None:
        """End what is open, such as a recording."""


class Driver:
    """Thread that advances a run: start, pause, step, pace.

    Args:
        run: the run.
        pace: simulated seconds in a second; 0: as fast as possible.
    """

    def __init__(self, run: PanelRun, pace: float) -> None:
        self.run, self._pace = run, pace
        self._commands: SimpleQueue[tuple[Callable[[], object], Future[Any]] | None] = SimpleQueue()
        self._running = False
        self._stop_at = 0  # sample at which a step ends; 0: none
        self._error = ""
        self._begun, self._from = time.monotonic(), 0  # wall time, and the sample reached then
        self._factor = 0.0
        self._thread = threading.Thread(target=self._work, name="panel run")

    def __enter__(self) -> "Driver":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._commands.put(None)
        self._thread.join()

    def call(self, command: Callable[[], T]) -> T:
        """Carry out a command between two blocks, and return its result.

        Raises:
            LatheError: the command is refused or fails, or the thread has ended with an error.
        """
        answer: Future[T] = Future()
        self._commands.put((command, answer))
        while not wait([answer], _PATIENCE).done:
            if not self._thread.is_alive():
                raise LatheError(f"the run has ended ({self._error}); start lathe panel again")
        return answer.result()

    # ---- commands, in the thread --------------------------------------------------------------------

    def start(self) -> None:
        """Go on to the end, or until `pause`."""
        self._go(0)

    def pause(self) -> None:
        """Stop after the block in progress."""
        self._running, self._stop_at = False, 0

    def step(self) -> None:
        """Go on to the end of the revolution in progress."""
        self._go(self.run.turn_end())

    def pace(self, factor: float) -> None:
        """Set the simulated seconds in a second; 0: as fast as possible."""
        if not 0.0 <= factor <= 1000.0:
            raise InputError(f"pace = {factor:g}; allowed: from 0 (as fast as possible) to 1000")
        self._pace = factor
        self._time_anew()

    def again(self) -> None:
        """Go on after the run has been replaced or has moved to another sample."""
        self._error = ""
        self._time_anew()

    def _go(self, stop_at: int) -> None:
        if self._error or self.run.reached >= self.run.samples:
            raise InputError("the run has ended; allowed: restart it")
        self._running, self._stop_at = True, stop_at
        self._time_anew()

    # ---- the thread ---------------------------------------------------------------------------------

    def _work(self) -> None:
        # NaN and infinity are reported by the engine, so NumPy's warnings are redundant.
        with np.errstate(over="ignore", invalid="ignore"):
            self.run.view.publish(self._told())
            try:
                while self._obey():
                    if self._running:
                        self._advance()
            except Exception as error:
                self._error, self._running = f"{type(error).__name__}: {error}", False
                self.run.view.publish(self._told(), at_once=True)
                raise
            finally:
                self.run.close()

    def _obey(self) -> bool:
        """Carry out the waiting commands, and wait until the next block is due; return False at the end."""
        while True:
            pause = self._due() - time.monotonic() if self._running else None
            try:
                found = (
                    self._commands.get(timeout=pause) if pause is None or pause > 0.0 else self._commands.get_nowait()
                )
            except Empty:
                return True
            if found is None:
                return False
            command, answer = found
            try:
                answer.set_result(command())
            except BaseException as error:  # noqa: BLE001 - the one who asked gets every error
                answer.set_exception(error)
            self.run.view.publish(self._told(), at_once=True)

    def _due(self) -> float:
        """Return the wall time at which the samples reached are due."""
        if not self._pace:
            return 0.0
        return self._begun + (self.run.reached - self._from) * self.run.step / self._pace

    def _advance(self) -> None:
        run = self.run
        most = messages.MAX_BLOCK if not self._pace else min(_FRAME * self._pace / run.step, messages.MAX_BLOCK)
        blocks = max(int(most) // run.block, 1)
        if self._stop_at:
            blocks = min(blocks, -(-(self._stop_at - run.reached) // run.block))
        end = run.reached + blocks * run.block
        self._attempt(lambda: run.advance(min(end, run.samples)))
        now = time.monotonic()
        if (elapsed := now - self._begun) > 0.1:
            self._factor = (run.reached - self._from) * run.step / elapsed
        if elapsed > 1.0 or (self._pace and now - self._due() > _LATE):
            self._time_anew(keep=now <= self._due() + _LATE)
        if run.reached >= run.samples or (self._stop_at and run.reached >= self._stop_at):
            self.pause()
            run.view.publish(self._told(), at_once=True)

    def _time_anew(self, *, keep: bool = False) -> None:
        """Count the time of the pace from now on; ``keep``: from the time at which the reached samples are due."""
        self._begun = self._due() if keep and self._pace else time.monotonic()
        self._from = self.run.reached

    def _attempt(self, what: Callable[[], object]) -> None:
        try:
            what()
        except LatheError as error:
            self._error, self._running = str(error), False
            self.run.view.say(self.run.reached, "panel", str(error))
        self.run.view.publish(self._told(), at_once=bool(self._error))

    def _told(self) -> Mapping[str, Any]:
        ended = self.run.reached >= self.run.samples
        state = "failed" if self._error else "running" if self._running else "ended" if ended else "paused"
        return {
            "state": state,
            "failure": self._error,
            "pace": self._pace,
            "factor": self._factor if self._running else 0.0,
            "samples": self.run.samples,
            **self.run.told(),
        }


class LiveCell:
    """Offline cell that is advanced block by block, with commands between blocks (implements `PanelRun`).

    Args:
        scenario: the scenario.
        compiling: called with the names of the nodes whose steps are still being compiled.

    Attributes:
        cell: the wired cell.
        scenario: scenario of the run, with the parameters of its last restart.
        events: events that the panel has asked for since the start, by node, as in a scenario.

    Raises:
        InputError: the scenario cannot run.
    """

    def __init__(self, scenario: Scenario, compiling: Callable[[list[str]], object] = lambda _: None) -> None:
        self._compiling = compiling
        self._folder = tempfile.TemporaryDirectory(prefix="lathe-panel-")
        self._recorder: OfflineRecorder | None = None
        self._bag, self._version = "", 0
        masters = [f"{name}.{time_master.START_FROM}" for name in scenario.masters]
        self._given = {name: scenario.value(name) for name in masters}  # checkpoint of a restart, if any
        self._changed: dict[str, Value] = {}  # parameters changed since the panel was opened
        self._begin(scenario)
        types = {topic: source.type for topic, source in {**self.cell.dense, **self.cell.sparse}.items()}
        self.view = View(types, scenario.shared.step_ns, self._margin())
        self._remark()

    def _begin(self, scenario: Scenario) -> None:
        """Check a scenario, compile its stages, and be ready to compute its first sample."""
        cell = Cell(scenario.nodes)
        cell.check()
        for left in compile_ahead(cell.stages.values()):
            self._compiling(left)
        self._engine = Engine(cell)
        self.cell, self.scenario = cell, scenario
        self.events: dict[str, list[str]] = {}
        self._version += 1

    def _remark(self) -> None:
        self.view.know(self.scenario, self.cell.stages.values())
        for text in [*self.cell.unchecked, *self.cell.warnings]:
            self.view.say(self.reached, "check", text)

    def _margin(self) -> float | None:
        known = [margin for margin in self.cell.margins.values() if margin is not None]
        return min(known, default=None)

    @property
    def recording(self) -> bool:
        """Whether a bag is being recorded."""
        return self._recorder is not None

    @property
    def reached(self) -> int:
        """Number of samples computed."""
        return self._engine.reached

    @property
    def samples(self) -> int:
        """Index after the last sample."""
        return self._engine.samples

    @property
    def block(self) -> int:
        """Samples between two commands."""
        return self.scenario.shared.block_size

    @property
    def step(self) -> float:
        """Sampling step [s]."""
        return self.scenario.shared.step

    def advance(self, end: int) -> None:
        """Compute the samples before ``end``."""
        # The lamp first: it is never older than the samples beside it.
        sinks: list[Sink] = [self.view.lamp, self.view, *([self._recorder] if self._recorder else [])]
        self._engine.advance(min(end, self.reached + self._engine.piece), sinks)
        if self.reached >= self.samples:
            self.view.finish()
            self.record("")

    def turn_end(self) -> int:
        """Return the sample at which the revolution in progress ends."""
        ends = (self.cell.master.sample_at(2.0 * np.pi * turn) + 1 for turn in count(int(self.view.turns) + 1))
        # The view knows no angle before the first sample, which may be that of a checkpoint.
        return min(next(end for end in ends if end > self.reached), self.samples)

    def told(self) -> Mapping[str, Any]:
        """Return the status of the run, for its snapshots."""
        return {
            "bag": self._bag if self.recording else "",
            "events": " ".join(filter(None, [_parameters(self._changed), as_options(self._all_events())])),
            "begun": self.cell.first,
            "version": self._version,
        }

    # ---- commands -----------------------------------------------------------------------------------

    def act(self, node: str, action: str) -> str:
        """Carry out an event at the first sample not yet computed; return it as in a scenario.

        Raises:
            InputError: there is no such node, it cannot carry out the event, or the cell would diverge after it.
        """
        stage = self.cell.stages.get(node)
        if stage is None:
            raise InputError(f"no node {node!r} in the cell; {instead(node, self.cell.stages)}")
        stage.check_action(action)
        if events.parse(action).verb == events.SET:
            stage.tuned(action).check_cell(self.cell, cures=False)
        stage.schedule(action, self.reached)
        text = f"sample {self.reached}: {action}"
        self.events.setdefault(node, []).append(text)
        return text

    def change(self, values: Mapping[str, Value], *, here: bool) -> None:
        """Go on with other parameters: from a checkpoint, or from the start.

        Args:
            values: values by ``NODE.PARAM``, or ``PARAM`` for a shared parameter.
            here: whether to go on at the first sample not yet computed.

        Raises:
            InputError: a value is not allowed, or the state of the cell depends on it; the run goes on as before.
        """
        changed = self.scenario.varied({**values, **self._given})
        here = here and self.reached > 0
        waiting = self._waiting() if here else {}
        if here:
            file = Path(self._folder.name) / f"{self.reached}.ckpt"
            state = checkpoint.take(self.scenario, self._engine.stages, self.reached, self._engine.past)
            checkpoint.save(file, state)
            changed = changed.varied(dict.fromkeys(self._given, str(file)))
        self._begin(changed)
        self._changed |= values
        self.events = waiting
        self.record("")
        if here:
            self.view.say(self.reached, "panel", f"goes on with {_listed(values)}", kind="parameter")
        else:
            self.view.clear(self._margin())
            self.view.lamp.clear()
            self.view.timeline.clear()
        self._remark()

    def so_far(self) -> tuple[Scenario, int]:
        """Return a scenario that repeats the run up to its newest complete revolution, and its number.

        Raises:
            InputError: the run began at a checkpoint, has no complete revolution, or the tool is out of the part.
        """
        (master,) = self.scenario.masters
        if self.cell.first:
            raise InputError(
                f"the run began at a checkpoint, sample {self.cell.first}; allowed: a restart from sample 0"
            )
        if (turns := int(self.view.turns)) < 1:
            raise InputError("no complete revolution yet; allowed: after the first one")
        if self.view.was_out:
            raise InputError("the tool was out of the part in the last ten revolutions; allowed: while it cuts")
        told = {f"{node}.events": texts for node, texts in self._all_events().items()}
        return self.scenario.varied({f"{master}.revolutions": float(turns), **told}), turns

    def _all_events(self) -> dict[str, list[str]]:
        """Return the events of each node that the panel has asked something of, those of the scenario first."""
        return {node: [*self.scenario.nodes[node].events, *texts] for node, texts in self.events.items()}

    def _waiting(self) -> dict[str, list[str]]:
        """Return the events at the first sample not yet computed; a checkpoint holds them."""
        now = f"sample {self.reached}: "
        found = {node: [text for text in texts if text.startswith(now)] for node, texts in self.events.items()}
        return {node: texts for node, texts in found.items() if texts}

    def record(self, bag: str) -> None:
        """Record from the first sample not yet computed on; an empty text ends the recording.

        Raises:
            InputError: the folder exists or cannot be created.
        """
        if bag:
            if self._recorder:
                raise InputError(f"{self._bag} is being recorded; allowed: end it first")
            if self.reached >= self.samples:
                raise InputError("the run has ended; allowed: restart it")
            refuse_existing(Path(bag))
            writer = begin(Path(bag), self.scenario)
            self._recorder, self._bag = OfflineRecorder(self.cell, self.samples, writer, None, self.reached), bag
        elif self._recorder:
            recorder, self._recorder = self._recorder, None
            recorder.close()
            self.view.say(self.reached, "panel", f"recorded {self._bag}")

    def close(self) -> None:
        """End the recording, and remove the checkpoints."""
        self.record("")
        self._folder.cleanup()


def _listed(values: Mapping[str, Value]) -> str:
    return ", ".join(f"{name} = {value!r}" for name, value in values.items()) or "the same parameters"


def _parameters(changed: Mapping[str, Value]) -> str:
    """Return changed parameters as options of ``lathe run``."""
    return " ".join(f"--set {shlex.quote(f'{name}={json.dumps(value)}')}" for name, value in changed.items())


def as_options(told: Mapping[str, Sequence[str]]) -> str:
    """Return events as options of ``lathe run``."""
    return " ".join(f"--set '{node}.events={json.dumps(list(found))}'" for node, found in told.items())
