# SPDX-License-Identifier: Apache-2.0
"""Running a scenario: offline, composed in one process, grouped, or each node a process of its own.

    result = run(load(Path("config/piston.yaml")), mode="processes")
    print(result.errors.rms[-1], result.digest)

Nodes report what happens over a socket each (`lathe_rc.nodes.report`), so whoever drives a cell waits for events,
never for time. Every child is ended, whatever happens; this module does not import rclpy.
"""

import contextlib
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, Literal

from lathe_rc import part, starting
from lathe_rc.analysis.budget import Budget
from lathe_rc.analysis.metrology import FormErrors, Lay, Measurement
from lathe_rc.analysis.tolerance import Verdict
from lathe_rc.bag import reader, recover
from lathe_rc.bag.check import write_digests
from lathe_rc.bag.record import OfflineRecorder, begin, begin_snapshots, recorder_of
from lathe_rc.bag.writer import refuse_existing
from lathe_rc.cell import budget as budgets
from lathe_rc.cell import messages
from lathe_rc.cell.ahead import compile_ahead
from lathe_rc.cell.collect import Collector, check_room
from lathe_rc.cell.durations import Lateness
from lathe_rc.cell.engine import Engine, Sink
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.recording import Recording
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.stages.tool import ToolParameters
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError, LossyRunError
from lathe_rc.extensions import search_path
from lathe_rc.happened import Happening, listed
from lathe_rc.namespace import absolute, checked
from lathe_rc.nodes import leftovers
from lathe_rc.nodes.report import THROUGHPUT
from lathe_rc.starting import Child, Start

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from lathe_rc.sweep.space import Space
    from lathe_rc.sweep.sweep import Sweep
    from lathe_rc.sweep.tuned import Tuning

Mode = Literal["offline", "composed", "processes"]
Event = Mapping[str, Any]

_SILENCE_LIMIT = 120.0  # [s] without any event: the first start on a machine compiles kernels
_FAREWELL = 10.0  # [s] without any event once the run is complete and its bag closed
_GRACE = 2.5  # [s] for a process to end after SIGTERM, before SIGKILL
_MOST_RESTARTS = 8  # of a process
_SETTLING = 30.0  # [s] without any event while a cell goes to its safe state
_NO_SIGN_OF_LIFE = {"stall", "stranger", "stopped", "continued", "waits"}  # events that come while nothing goes on
_LOOK = 0.05  # [s] between looks at what a process has written


@dataclass(frozen=True, repr=False)
class Result:
    """What a run gave.

    Attributes:
        scenario: what ran.
        mode: the host.
        samples: length of the run.
        wall_s: from block 0 to the last block computed and recorded by every member [s].
        bag: where it is recorded; None if it was not to be kept, or in snapshots alone.
        snapshots: bags of parts of the run, see `lathe_rc.bag.snapshots`.
        recording: all signals.
        refused: messages of strangers that the nodes refused, by sender.
        not_reached: events that the run was too short for, by node.
        unchecked: what the check before the start could not see, since laws or drives of others do not tell it.
        lateness: of the blocks; None if there was no pace to keep, as offline or with a ``speed_factor`` of 0.

    Example:
        >>> from pathlib import Path
        >>> from lathe_rc import harness, resources
        >>> from lathe_rc.cell import scenario
        >>> piston = scenario.load(resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=20"])
        >>> result = harness.run(piston)
        >>> result
        <Result of piston: offline, 20 revolutions, form error 150.8 to 0.5639 µm RMS, no bag>
        >>> print(f"at most {result.errors.largest[-1] * 1e6:.3f} µm in the last revolution")
        at most 0.992 µm in the last revolution
        >>> result.digest["/tool"] == result.recording.digests()["/tool"]
        True
        >>> error = result.frame("/tool")["error"]  # [m], of each sample
        >>> result.plot().savefig("piston.png")
    """

    scenario: Scenario
    mode: str
    samples: int
    wall_s: float
    bag: Path | None
    snapshots: tuple[Path, ...]
    recording: Recording
    refused: Mapping[str, int] = field(default_factory=dict)
    not_reached: Mapping[str, Sequence[str]] = field(default_factory=dict)
    unchecked: Sequence[str] = ()
    lateness: Lateness | None = None

    def __repr__(self) -> str:
        """What ran and what came of it, in a line."""
        bag = f"bag {self.bag}" if self.bag else "no bag"
        return f"<Result of {self.scenario.name}: {', '.join([self.mode, *self.errors.told(), bag])}>"

    def _repr_html_(self) -> str:
        """The same as a table with the form error by revolution, for notebooks."""
        from lathe_rc.view import notebook

        return notebook.result(self)

    def frame(self, topic: str) -> Any:
        """A topic as a table: a row a sample, or a message; see `lathe_rc.frames.frame`."""
        return self.recording.frame(topic)

    def plot(self, title: str | None = None) -> "Figure":
        """Desired form, form error over angle, form error by revolution; see `lathe_rc.view.figure.draw`.

        Args:
            title: of the figure; None: the scenario's name.
        """
        return self.recording.plot(self.scenario.name if title is None else title)

    @property
    def blocks(self) -> int:
        """Blocks that the spindle sent."""
        return -(-self.samples // self.scenario.shared.block_size)

    @property
    def dropped(self) -> int:
        """Blocks that some member lost: none, since a run that loses any ends in a LossyRunError."""
        return 0

    @property
    def simulated_s(self) -> float:
        """Simulated time [s]."""
        return self.samples * self.scenario.shared.step

    @property
    def real_time_factor(self) -> float:
        """Simulated over wall time."""
        return self.simulated_s / self.wall_s

    @property
    def errors(self) -> FormErrors:
        """Form error by revolution; of no revolution if the scenario has no tool."""
        return self.recording.errors

    @cached_property
    def part(self) -> Measurement:
        """The part as the workshop measures it; see `lathe_rc.part`."""
        return part.measured(self.recording)

    @property
    def verdict(self) -> Verdict | None:
        """Whether the part is in tolerance; None if the scenario's tool has no ``tolerance``."""
        return part.verdict(self.scenario, self.recording)

    @cached_property
    def surface(self) -> Lay | str | None:
        """The surface along the part, or why there is none; None: the scenario has no tool with a `nose_radius`."""
        tools = [table for table in self.scenario.nodes.values() if isinstance(table, ToolParameters)]
        radius = next((table.nose_radius for table in tools if table.nose_radius), 0.0)
        if not radius or not self.errors.rms.size:
            return None
        try:
            return part.surface(self.recording, self.part, radius)
        except InputError as error:
            return str(error)

    @cached_property
    def digest(self) -> dict[str, str]:
        """Digest of each signal topic."""
        return self.recording.digests()

    @cached_property
    def happened(self) -> list[Happening]:
        """Events, alarms and reactions, in order."""
        return listed(self.recording)

    def summary(self) -> dict[str, object]:
        """What ``lathe run --json`` prints."""
        errors, step, verdict = self.errors, self.scenario.shared.step, self.verdict

        def of(revolution: int) -> dict[str, Any] | None:
            return part.numbers(self.part, revolution) if errors.rms.size else None

        return {
            "scenario": self.scenario.name,
            "mode": self.mode,
            "simulated_s": self.simulated_s,
            "wall_s": self.wall_s,
            "real_time_factor": self.real_time_factor,
            "revolutions": int(errors.rms.size),
            "blocks": self.blocks,
            "dropped": self.dropped,
            "lateness_s": asdict(self.lateness) if self.lateness else None,
            "refused": dict(self.refused),
            "events": [
                {"sample": found.sample, "time": found.sample * step, "topic": found.topic, "text": found.text}
                for found in self.happened
            ],
            "not_reached": {node: list(events) for node, events in self.not_reached.items()},
            "unchecked": list(self.unchecked),
            "error_um": {
                "first": of(0),
                "last": of(-1),
                "per_revolution_rms": (errors.rms * 1e6).tolist(),
                "per_revolution_peak_to_valley": (errors.peak_to_valley * 1e6).tolist(),
                "per_revolution_ront": (self.part.roundness.peak_to_valley * 1e6).tolist() if errors.rms.size else [],
            },
            "tolerance_um": verdict.summary() if verdict else None,
            "along_um": part.along(self.surface) if isinstance(self.surface, Lay) else self.surface,
            "bag": str(self.bag) if self.bag else None,
            "snapshots": [str(path) for path in self.snapshots],
            "digest": self.digest,
        }


def how_it_ended(event: Event) -> str:
    """What is said of a process that did not end by itself and in order, from its ``exit``."""
    code = event["code"]
    return f"{event['node']} " + (
        f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    )


def _ignore(event: Event) -> None:
    """Watch nothing."""


def run(
    scenario: Scenario,
    *,
    mode: Mode = "offline",
    groups: Sequence[Sequence[str]] | None = None,
    bag: Path | None = None,
    watch: Callable[[Event], None] = _ignore,
    domain: int | None = None,
    namespace: str = "/",
    start: Start = "fork",
) -> Result:
    """Run a scenario to its end.

    Args:
        scenario: what to run; its spindle must have a number of revolutions.
        mode: ``offline``: a loop in this process; ``composed``: all nodes in one process; ``processes``: each node
            a process.
        groups: nodes that share a process, for ``processes``, the others have their own; None: as the scenario says.
        bag: folder to record to; None: nothing is kept. Where the recorder's ``mode`` is ``snapshot``, their folder
            is named after it, and the whole run is kept until its end alone.
        watch: called with every event, from the thread that called `run`. The first is ``checked``, with the
            run's samples and step [s]: from then on nothing is refused.
        domain: ROS domain; None: a free one.
        namespace: ROS namespace of the cell: two cells with one each can share a domain.
        start: ``fork``: processes are copies of one that has imported what they need; ``spawn``: interpreters of
            their own.

    Raises:
        InputError: the scenario cannot work, the run does not fit into memory, or the bag's folder exists or has no
            folder to be made in.
        LatheError: a node failed or was killed; the bag, if one was asked for, is readable.
        LossyRunError: a free-running cell lost blocks.

    Example:
        >>> from pathlib import Path
        >>> from lathe_rc import harness, resources
        >>> from lathe_rc.cell import scenario
        >>> piston = scenario.load(resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=3"])
        >>> harness.run(piston, bag=Path("piston_bag"))
        <Result of piston: offline, 3 revolutions, form error 150.8 to 1.166 µm RMS, bag piston_bag>
        >>> harness.run(piston, bag=Path("piston_bag"))
        Traceback (most recent call last):
        lathe_rc.errors.InputError: piston_bag exists; a bag is never overwritten...
    """
    if mode != "offline" and start == "fork":
        starting.server()  # it imports while the cell is checked
    cell = Cell(scenario.nodes)
    cell.check()
    check_room(cell)
    for what in cell.unchecked:
        watch({"event": "unchecked", "node": cell.master.name, "message": what})
    if bag is not None:
        refuse_existing(bag)
    result = _run(scenario, cell, mode, groups, bag, watch, domain, checked(namespace), start)
    result = replace(result, unchecked=cell.unchecked)
    if result.bag is not None:
        write_digests(result.bag, result.digest)
    return result


def sweep(scenario: Scenario, space: "Space", folder: Path, **options: Any) -> "Sweep":
    """Compute variations of a cell into a table; the arguments are those of `lathe_rc.sweep.sweep.run`."""
    from lathe_rc.sweep import sweep

    return sweep.run(scenario, space, folder, **options)


def budget(
    scenario: Scenario, *, threads: int | None = None, watch: Callable[[int, int], None] | None = None
) -> Budget:
    """What the form error of a scenario is made of, in its last ten revolutions; see `lathe_rc.analysis.budget`.

    It runs offline, as a batch, with one cause after the other switched off: some ten runs, or some thirty if causes
    act together.

    Args:
        scenario: of the whole; its spindle must have a number of revolutions.
        threads: that compute; None: one for each core.
        watch: called after each run with how many there have been and how many there will be, as far as is known.

    Raises:
        InputError: the scenario cannot work, has no tool, or turns no complete revolution.
        LatheError: a run failed.

    Example:
        >>> from pathlib import Path
        >>> from lathe_rc import harness, resources
        >>> from lathe_rc.cell import scenario
        >>> piston = scenario.load(resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=60"])
        >>> for found in harness.budget(piston).causes:
        ...     print(f"{found.name}: {found.percent()} %")
        Q floor: -0.3 %
        speed: 83.5 %
        lead: 0.0 %
        feed: 16.9 %
    """
    return budgets.budget(scenario, threads=threads, watch=watch)


def tune(scenario: Scenario, free: Mapping[str, Any], goals: Sequence[str], folder: Path, **options: Any) -> "Tuning":
    """Search parameters of a cell; the arguments are those of `lathe_rc.sweep.tune.run`."""
    from lathe_rc.sweep import tune

    return tune.run(scenario, free, goals, folder, **options)


def _run(
    scenario: Scenario,
    cell: Cell,
    mode: Mode,
    groups: Sequence[Sequence[str]] | None,
    bag: Path | None,
    watch: Callable[[Event], None],
    domain: int | None,
    namespace: str,
    start: Start,
) -> Result:
    samples = cell.samples if mode == "offline" else cell.expected_samples
    watch({"event": "checked", "node": cell.master.name, "samples": samples, "step": scenario.shared.step})
    for left in compile_ahead(cell.stages.values()):
        watch({"event": "compiling", "node": left[0], "nodes": left})
    if mode == "offline":
        return _offline(scenario, cell, bag, watch)
    if start == "fork":
        nodes = {name: (scenario.kind(name), table.model_dump()) for name, table in scenario.nodes.items()}
        starting.server().preload(nodes)
    with contextlib.ExitStack() as stack:
        table = recorder_of(scenario)[1]
        folder = table.snapshots_of(bag) if bag is not None and table.mode != "continuous" else None
        place = kept = _whole(scenario, bag)
        if place is None:
            place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lathe-"))) / "bag"
        complete = with_recorder(scenario, place, keep=bag is not None, snapshots=folder)
        split = [list(complete.nodes)] if mode == "composed" else complete.processes(groups)
        processes = stack.enter_context(Processes(complete, split, domain=domain, namespace=namespace, start=start))
        try:
            events = processes.wait_for_end(watch)
        except BaseException:
            processes.stop()
            for path in ([kept] if kept else []) + _bags_in(folder):
                recover.mend(path)
            raise
        recording = reader.read(place)
        return Result(
            scenario=scenario,
            mode="grouped" if mode == "processes" and len(split) < len(complete.nodes) else mode,
            samples=cell.master.samples or recording.of_type(messages.ENCODER)["angle"].size,
            wall_s=(events["complete"]["monotonic_ns"] - events["block0"]["monotonic_ns"]) * 1e-9,
            bag=kept,
            snapshots=tuple(_bags_in(folder)),
            recording=recording,
            refused=processes.refused,
            not_reached=processes.not_reached,
            lateness=_lateness(events),
        )


def _lateness(events: Mapping[str, Event]) -> Lateness | None:
    """What the time master has told of its pace."""
    if "pace" not in events:
        return None
    told = events["pace"]
    within = {int(percent): seconds for percent, seconds in told["within"].items()}  # JSON has no other keys than texts
    return Lateness(told["blocks"], told["late"], told["worst"], within, told["slipped"])


def _whole(scenario: Scenario, bag: Path | None) -> Path | None:
    """The bag that keeps the whole run, if one does."""
    return None if recorder_of(scenario)[1].mode == "snapshot" else bag


def _bags_in(folder: Path | None) -> list[Path]:
    """The snapshots in a folder, in the order of their triggers."""
    return sorted(folder.iterdir()) if folder is not None and folder.is_dir() else []


class _Watcher:
    """A sink that turns an offline run into the events of a cell of nodes."""

    def __init__(self, watch: Callable[[Event], None]) -> None:
        self._watch = watch

    def chunk(
        self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, Sequence[Sparse]]
    ) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        for topic, found in sparse.items():
            for message in found:
                if message.type == messages.LEARNING:
                    self._watch({"event": "cycle", "node": topic, "sample": message.index, **message.values})
        self._watch({"event": "progress", "node": "", "samples": first + samples})


def _offline(scenario: Scenario, cell: Cell, bag: Path | None, watch: Callable[[Event], None]) -> Result:
    engine = Engine(cell)
    collector = Collector(cell, engine.samples)
    sinks: list[Sink] = [collector, _Watcher(watch)]
    recorder = snapshots = None
    if bag is not None:
        snapshots = begin_snapshots(bag, scenario, cell)
        recorder = OfflineRecorder(cell, engine.samples, begin(bag, scenario, snapshots), snapshots)
        sinks.append(recorder)
    start = time.monotonic()
    try:
        watch({"event": "block0", "node": cell.master.name})
        engine.run(sinks)
    finally:
        if recorder:
            recorder.close()
    wall = time.monotonic() - start
    kept = _whole(scenario, bag)
    found = tuple(_bags_in(snapshots.folder)) if snapshots else ()
    waiting = {name: stage.waiting for name, stage in cell.stages.items() if stage.waiting}
    for name, events in waiting.items():
        watch({"event": "not_reached", "node": name, "events": events})
    recording = collector.recording()
    return Result(scenario, "offline", engine.samples, wall, kept, found, recording, not_reached=waiting)


def with_recorder(scenario: Scenario, bag: Path, *, keep: bool, snapshots: Path | None = None) -> Scenario:
    """The scenario as its processes run it: with a recorder on ``bag``, and a spindle that waits for all members.

    With ``snapshots`` it makes those too, in that folder; what is not to be kept has none.
    """
    nodes = dict(scenario.nodes)
    name, table = recorder_of(scenario)
    changes: dict[str, object] = {"bag": str(bag.resolve())}
    if not keep:
        changes |= {"compression": "none", "mode": "continuous"}
    elif snapshots is not None:
        changes |= {"mode": "both", "snapshots": str(snapshots.resolve())}
    nodes[name] = table.model_copy(update=changes)
    for master in scenario.masters:
        others = [node for node in nodes if node != master]
        nodes[master] = nodes[master].model_copy(update={"members": others})
    return Scenario(scenario.name, nodes)


@contextlib.contextmanager
def free_domain(number: int | None = None) -> Iterator[int]:
    """A ROS domain that nobody else on this machine uses; ``number`` if one is given."""
    if number is not None:
        yield number
        return
    from domain_coordinator import domain_id

    with domain_id() as free:
        yield int(free)


class Processes:
    """The processes of a cell, from start to end; a context manager that leaves none behind.

    Args:
        scenario: with a recorder, as `with_recorder` makes it.
        groups: names of the nodes in each process.
        domain: ROS domain; None: a free one.
        namespace: ROS namespace of all nodes.
        start: see `run`.
        prefix: words that run a command somewhere else, as those of ``ip netns exec``, by the first node of a process,
            which is then an interpreter of its own.

    Attributes:
        pids: process of each node.
        domain: the ROS domain in use.
        refused: messages of strangers that the nodes refused, by sender; known when they have ended.
        not_reached: events that the run was too short for, by node; the same.
    """

    def __init__(
        self,
        scenario: Scenario,
        groups: Sequence[Sequence[str]],
        *,
        domain: int | None = None,
        namespace: str = "/",
        start: Start = "fork",
        prefix: Mapping[str, Sequence[str]] = MappingProxyType({}),
    ) -> None:
        self._scenario, self._groups, self._wanted_domain = scenario, groups, domain
        self._namespace, self._fresh, self._prefix = namespace, start == "spawn", prefix
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._stack = contextlib.ExitStack()
        self._children: dict[str, Child] = {}
        self._threads: list[threading.Thread] = []
        self._abandoned: set[str] = set()
        self._ended: set[str] = set()
        self._newest: dict[str, Event] = {}
        self._lost: list[tuple[str, str]] = []  # nodes that the cell goes to its safe state without, and why
        self._restarts: Counter[str] = Counter()
        self.pids: dict[str, int] = {}
        self.refused: Counter[str] = Counter()
        self.not_reached: dict[str, list[str]] = {}
        self.domain = -1

    def __enter__(self) -> "Processes":
        """Start them."""
        try:
            self.domain = self._stack.enter_context(free_domain(self._wanted_domain))
            self._folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="lathe-log-")))
            self._file = self._folder / "scenario.yaml"
            self._file.write_text(self._scenario.to_yaml(), encoding="utf-8")
            leftovers.sweep()
            for group in self._groups:
                self._start(group)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End them."""
        self.stop()

    def _start(self, group: Sequence[str]) -> None:
        environment = os.environ | {"ROS_DOMAIN_ID": str(self.domain), "ROS_LOG_DIR": str(self._folder)}
        environment["PYTHONPATH"] = search_path()
        if all(getattr(table, "speed_factor", 0.0) == 0.0 for table in self._scenario.nodes.values()):
            environment[THROUGHPUT] = "1"
        name = "+".join(group)
        arguments = [
            *(f"{node}:{self._scenario.kind(node)}" for node in group),
            *("--ros-args", "--params-file", str(self._file), "-r", f"__ns:={self._namespace}"),
            *("--enclave", absolute(self._namespace, group[0])),
        ]
        ours, theirs = socket.socketpair()
        with theirs, (self._folder / f"{group[0]}.log").open("ab") as log:
            child = starting.server().start(
                arguments,
                environment=environment,
                report=theirs,
                log=log.fileno(),
                changed=partial(self._changed, name),
                command=self._command(group[0], arguments),
            )
        self._children[name] = child
        for node in group:
            self.pids[node] = child.pid
        listener = threading.Thread(target=self._listen, args=(name, ours, child), daemon=True)
        listener.start()
        self._threads.append(listener)

    def _command(self, first: str, arguments: Sequence[str]) -> list[str]:
        """What starts a process as an interpreter of its own; nothing where it is to be forked."""
        prefix = self._prefix.get(first, ())
        words = [*prefix, sys.executable, "-m", "lathe_rc.nodes.container", *arguments]
        return words if prefix or self._fresh else []

    def _listen(self, name: str, line: socket.socket, child: Child) -> None:
        """Turn a process's reports, and its end, into events."""
        with line, line.makefile("r", encoding="utf-8") as reports:
            with contextlib.suppress(OSError):
                for report in reports:
                    self._events.put(json.loads(report))
            code = child.wait()
        self._say("exit", name, code=code)

    def _say(self, event: str, name: str, **values: object) -> None:
        """An event of the harness's own, as nodes report theirs."""
        self._events.put({"event": event, "node": name, "monotonic_ns": time.monotonic_ns(), **values})

    def _changed(self, name: str, state: str, number: int) -> None:
        """Turn into an event that a process has been stopped by a signal, or continued.

        A process that is stopped with a lock of DDS in its hands holds up all who send to it, the time master among
        them: then nobody else can say so.
        """
        self._say(state, name, signal=number, waits=self._waits)

    def events(self, silence: float) -> Iterator[Event]:
        """Events as they come.

        Raises:
            LatheError: nothing was heard for ``silence`` seconds.
        """
        heard = time.monotonic()
        while True:
            wait = _FAREWELL if self._complete else min(silence, self._settling) if self._lost else silence
            try:
                event = self._events.get(timeout=max(heard + wait - time.monotonic(), 0.0))
            except queue.Empty:
                if self._complete and self._running:
                    self._end_the_silent()
                    continue
                running = ", ".join(f"{name}{self._place(name)}" for name in self._running)
                raise LatheError(
                    self._with_the_lost(
                        f"no node has reported anything for {wait:.0f} s; still running: {running}{self._tails()}"
                    )
                ) from None
            self._newest[event["event"]] = event
            if event["event"] not in _NO_SIGN_OF_LIFE:
                heard = time.monotonic()
            if event["event"] == "refused":
                self.refused.update(event["senders"])
            if event["event"] == "not_reached":
                self.not_reached[event["node"]] = event["events"]
            if event["event"] == "exit" and not self._restarted(event):
                self._ended.add(event["node"])
            yield event

    @property
    def _settling(self) -> float:
        """How long a cell may take to its safe state without an event [s]."""
        return _SETTLING + max(getattr(table, "restart_time", 0.0) for table in self._scenario.nodes.values())

    def _restarted(self, event: Event) -> bool:
        """Start a process that was killed once more, if others can take the place of all its nodes."""
        name = event["node"]
        group = name.split("+")
        kept = all(getattr(self._scenario.nodes.get(node), "restart_file", "") for node in group)
        if event["code"] >= 0 or not kept or not self._goes_on(name):
            return False
        self._restarts[name] += 1
        if self._restarts[name] > _MOST_RESTARTS:
            return False
        self._start(group)
        self._say("restarted", name, pid=self._children[name].pid)
        return True

    def _goes_on(self, name: str) -> bool:
        """Whether the cell does something about the end of a node or process: it waits, and goes to its safe state."""
        masters = set(self._scenario.masters)
        waits = all(self._scenario.nodes[master].window for master in masters)
        return waits and "block0" in self._newest and not self._complete and not masters & set(name.split("+"))

    @property
    def _waits(self) -> bool:
        """Whether the cell waits for who stands still, however long."""
        masters = (self._scenario.nodes[name] for name in self._scenario.masters)
        return all(getattr(master, "stall_reaction", "") == "wait" for master in masters)

    @property
    def _running(self) -> list[str]:
        return [name for name in self._children if name not in self._ended]

    @property
    def _complete(self) -> bool:
        """Whether all samples are in a bag that is closed: nothing can be lost any more."""
        return bool(self._newest.get("closed", {}).get("complete"))

    def _end_the_silent(self) -> None:
        """End processes that the run does not need any more, and that do not end by themselves; names them.

        DDS may hold one up: a neighbour that left took a lock of the shared memory with it.
        """
        for name in self._running:
            self._abandoned.add(name)
            self._say("stuck", name, place=self._place(name))
            self._children[name].kill()

    def wait_for(self, kind: str, node: str | None = None, **values: object) -> Event:
        """Wait for an event of a kind, from a node, with certain values.

        Raises:
            LatheError: a process ended with a failure first.
        """
        for event in self.events(_SILENCE_LIMIT):
            wanted = {"event": kind, **values} | ({"node": node} if node else {})
            if wanted.items() <= event.items():
                return event
            self._raise_failure(event)
        raise AssertionError

    def wait_for_end(self, watch: Callable[[Event], None] = _ignore) -> dict[str, Event]:
        """Wait until every process has ended.

        Returns:
            The last event of each kind.

        Raises:
            LatheError: a node failed or was killed; says which.
        """
        for event in self.events(_SILENCE_LIMIT):
            watch(event)
            self._raise_failure(event)
            if self._ended == set(self._children):
                break
        if "safe" in self._newest or (self._lost and not self._complete):
            raise LatheError(self._with_the_lost(f"the run did not come to its end{self._tails()}"))
        if not {"block0", "complete", "closed"} <= set(self._newest):
            raise LatheError(f"the nodes ended before the run did{self._tails()}")
        return self._newest

    def _raise_failure(self, event: Event) -> None:
        """Raise what went wrong first; nodes that gave up because of another ("abandoned") are no cause."""
        node = event["node"]
        if event["event"] == "abandoned":
            self._is_no_cause(node)
        if event["event"] == "masterless":
            raise LatheError(self._with_the_lost(event["message"]))
        if event["event"] == "error":
            kinds = {InputError.exit_code: InputError, LossyRunError.exit_code: LossyRunError}
            self._lose(node, event["message"], kinds.get(event["exit_code"], LatheError))
            self._is_no_cause(node)
        if event["event"] == "exit" and event["code"] < 0 and self._complete:
            return  # a library crashed while it left; whoever watches has been told
        if event["event"] == "exit" and event["code"] > 0 and "safe" in self._newest:
            return  # all say so whose cell went there
        if event["event"] == "exit" and event["code"] and node in self._ended - self._abandoned:
            self._lose(node, f"{how_it_ended(event)}{self._crash(node) if event['code'] < 0 else self._tail(node)}")

    def _is_no_cause(self, node: str) -> None:
        """The end of the process of a node needs no other explanation."""
        self._abandoned.update(name for name in self._children if node in name.split("+"))

    def _lose(self, name: str, why: str, error: type[LatheError] = LatheError) -> None:
        """Raise why a node or process has ended, or keep it until the time master says how the cell went on."""
        if not self._goes_on(name):
            raise error(self._with_the_lost(why))
        self._lost.append((name, why))

    def _with_the_lost(self, message: str) -> str:
        """A message after what became of nodes, as far as it does not say that itself."""
        further = [why for name, why in self._lost if why.removeprefix(f"{name}: ") not in message]
        return "; ".join([*further, message])

    def _log(self, name: str) -> list[str]:
        """The lines that a process has written."""
        log = self._folder / f"{name.split('+', maxsplit=1)[0]}.log"
        return log.read_text(encoding="utf-8", errors="replace").strip().splitlines() if log.exists() else []

    def _tail(self, name: str) -> str:
        """The last line of a process's log."""
        lines = self._log(name)
        return f": {lines[-1].strip()}" if lines else ""

    def _crash(self, name: str) -> str:
        """Where a library has crashed, if one has: the innermost call that `faulthandler` has written."""
        lines = self._log(name)
        start = next((place for place, line in enumerate(lines) if line.startswith("Current thread")), len(lines))
        return f" in {lines[start + 1].strip()}" if start + 1 < len(lines) else ""

    def _place(self, name: str) -> str:
        """Where a process is that says nothing, by its innermost call."""
        child, before = self._children[name], len(self._log(name))
        with contextlib.suppress(ProcessLookupError):
            child.send_signal(signal.SIGUSR1)
        deadline = time.monotonic() + _GRACE
        while time.monotonic() < deadline and child.poll() is None:
            said = [line.strip() for line in self._log(name)[before:]]
            if place := next((line for line in said if line.startswith("File ")), ""):
                return f" in {place}"
            time.sleep(_LOOK)
        return ""

    def _tails(self) -> str:
        return "".join(f"; {name}{self._tail(name)}" for name in self._children)

    def stop(self) -> None:
        """End every process: in order if it listens, by SIGKILL if it does not."""
        for number in (signal.SIGCONT, signal.SIGTERM):
            for child in self._children.values():
                if child.poll() is None:
                    with contextlib.suppress(ProcessLookupError):
                        child.send_signal(number)
        deadline = time.monotonic() + _GRACE
        for child in self._children.values():
            try:
                child.wait(timeout=max(deadline - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
        for thread in self._threads:
            thread.join()
        self._stack.close()
