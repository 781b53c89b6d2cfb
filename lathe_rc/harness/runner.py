# SPDX-License-Identifier: Apache-2.0
"""Execution of one scenario in any host, from the checks to the bag.

The modules that write and read bags are imported only when a bag is requested, so that other runs start faster.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, get_args

from lathe_rc import messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.ahead import compile_ahead
from lathe_rc.cell.collect import Collector, check_room
from lathe_rc.cell.engine import Engine, Sink
from lathe_rc.cell.scenario import Scenario, of_load
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError
from lathe_rc.harness import bags
from lathe_rc.harness.result import Event, Mode, Result
from lathe_rc.messages import Signals
from lathe_rc.names import checked_namespace

if TYPE_CHECKING:
    from lathe_rc.process_launcher import Start


def run(
    scenario: Scenario,
    *,
    mode: Mode = "offline",
    groups: Sequence[Sequence[str]] | None = None,
    bag: str | os.PathLike[str] | None = None,
    watch: Callable[[Event], None] = lambda _event: None,
    domain: int | None = None,
    namespace: str = "/",
    start: "Start" = "fork",
    start_from: str | os.PathLike[str] | None = None,
    checkpoints: Mapping[str, str | os.PathLike[str]] = MappingProxyType({}),
) -> Result:
    """Run a scenario to its end.

    Args:
        scenario: the scenario to run; its spindle must have a number of revolutions.
        mode: ``offline``: a loop in this process; ``composed``: all nodes in one process; ``processes``: each node in
            a process of its own.
        groups: groups of nodes that share a process, for ``processes``; every other node has its own; None: as in the
            scenario.
        bag: folder to record to; None: nothing is recorded. If the recorder's ``mode`` is ``snapshot``, the folder of
            the snapshots is named after this one, and the recording of the whole run is deleted at the end.
        watch: called with every event, from the thread that called `run`. The event ``checked``, with the number of
            samples and the step [s], indicates that the run has passed its checks.
        domain: ROS domain; None: a free one.
        namespace: ROS namespace of the cell; cells with different namespaces can share a domain.
        start: ``fork``: processes are forks of a server with preloaded imports; ``spawn``: each process is a new
            interpreter.
        start_from: checkpoint from which the run goes on; None: it starts at sample 0.
        checkpoints: files to which the state of the cell is written, by point of time: ``revolution:R``, ``second:T``
            or ``sample:N``. Only offline; the state in the other hosts is the same.

    Raises:
        InputError: the scenario is invalid, the checkpoint is not one of this cell, the run does not fit into memory,
            or the bag's folder exists or has no parent folder.
        LatheError: a node failed or was killed; a requested bag is still readable.
        LossyRunError: a free-running cell lost blocks.

    Example:
        >>> import lathe_rc
        >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=3"])
        >>> lathe_rc.run(piston, bag="piston_bag")
        <Result of piston: offline, 3 revolutions, form error 150.8 to 1.166 µm RMS, bag piston_bag>
        >>> lathe_rc.run(piston, bag="piston_bag")
        Traceback (most recent call last):
        lathe_rc.errors.InputError: piston_bag exists; a bag is never overwritten...
    """
    scenario = of_load(scenario)
    if mode not in get_args(Mode):
        raise InputError(f"mode = {mode!r}; allowed: {', '.join(get_args(Mode))}")
    if mode != "offline" and start == "fork":
        from lathe_rc import process_launcher

        process_launcher.server()  # the server imports while the cell is checked
    if start_from:
        scenario = scenario.varied({f"{name}.start_from": os.fspath(start_from) for name in scenario.masters})
    scenario.check_members()
    cell = Cell(scenario.nodes)
    if mode != "offline" and checkpoints:
        raise InputError(f"a checkpoint written with mode {mode}; allowed: offline, where the state is the same")
    if cell.begun and bag is not None and scenario.recorder[1].mode != "continuous":
        from lathe_rc.bag.snapshot import SNAPSHOTS_GONE_ON

        raise InputError(SNAPSHOTS_GONE_ON)
    cell.check()
    check_room(cell)
    places = _places(checkpoints, cell)
    for event, told in (("unchecked", cell.unchecked), ("warning", cell.warnings)):
        for what in told:
            watch({"event": event, "node": cell.master.name, "message": what})
    place = Path(bag) if bag is not None else None
    if place is not None:
        from lathe_rc.bag.writing.writer import refuse_existing

        refuse_existing(place)
    samples = cell.samples if mode == "offline" else cell.expected_samples
    watch({"event": "checked", "node": cell.master.name, "samples": samples, "step": scenario.shared.step})
    for left in compile_ahead(cell.stages.values()):
        watch({"event": "compiling", "node": left[0], "nodes": left})
    if mode == "offline":
        result = _offline(scenario, cell, place, watch, places)
    else:
        from lathe_rc.harness.hosted import run_hosted

        result = run_hosted(scenario, cell, mode, groups, place, watch, domain, checked_namespace(namespace), start)
    result = replace(
        result,
        unchecked=cell.unchecked,
        warnings=cell.warnings,
        margins=cell.margins,
        drive_margins=cell.drive_margins,
    )
    if result.bag is not None:
        from lathe_rc.bag.check import write_digests

        write_digests(result.bag, result.digest)
    return result


def _places(checkpoints: Mapping[str, str | os.PathLike[str]], cell: Cell) -> dict[int, Path]:
    """Return the files of checkpoints by sample."""
    if not checkpoints:
        return {}
    from lathe_rc.cell.checkpoint import sample_of

    return {sample_of(when, cell.master): Path(path) for when, path in checkpoints.items()}


class _Watcher:
    """Sink that converts an offline run into the events of a cell of nodes."""

    def __init__(self, watch: Callable[[Event], None]) -> None:
        self._watch = watch

    def chunk(
        self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, Sequence[Sparse]]
    ) -> None:
        """Report the progress of a chunk of samples (implements `lathe_rc.cell.engine.Sink`)."""
        for topic, found in sparse.items():
            for message in found:
                if message.type == messages.LEARNING:
                    self._watch({"event": "cycle", "node": topic, "sample": message.index, **message.values})
        self._watch({"event": "progress", "node": "", "samples": first + samples})


def _offline(
    scenario: Scenario,
    cell: Cell,
    bag: Path | None,
    watch: Callable[[Event], None],
    checkpoints: Mapping[int, Path],
) -> Result:
    engine = Engine(cell)
    if early := [path for sample, path in checkpoints.items() if sample <= engine.first]:
        raise InputError(f"{early[0]}: a checkpoint before the run goes on, at sample {engine.first}; allowed: later")
    first, samples = engine.first, engine.samples - engine.first
    collector = Collector(cell, samples, first=first)
    sinks: list[Sink] = [collector, _Watcher(watch)]
    recorder = snapshots = None
    if bag is not None:
        from lathe_rc.bag.writing.record import OfflineRecorder, begin, begin_snapshots

        snapshots = begin_snapshots(bag, scenario, cell)
        recorder = OfflineRecorder(cell, engine.samples, begin(bag, scenario, snapshots), snapshots, first)
        sinks.append(recorder)
    start = time.monotonic()
    try:
        watch({"event": "block0", "node": cell.master.name})
        engine.run(sinks, {sample: partial(_keep, scenario, engine, path) for sample, path in checkpoints.items()})
    finally:
        if recorder:
            recorder.close()
    wall = time.monotonic() - start
    kept = bags.of_whole(scenario, bag)
    found = tuple(bags.snapshots_in(snapshots.folder)) if snapshots else ()
    waiting = {name: stage.waiting for name, stage in cell.stages.items() if stage.waiting}
    for name, events in waiting.items():
        watch({"event": "not_reached", "node": name, "events": events})
    recording = collector.recording()
    return Result(scenario, "offline", samples, wall, kept, found, recording, not_reached=waiting)


def _keep(scenario: Scenario, engine: Engine, path: Path) -> None:
    from lathe_rc.cell import checkpoint

    checkpoint.save(path, checkpoint.take(scenario, engine.stages, engine.reached, engine.past))
