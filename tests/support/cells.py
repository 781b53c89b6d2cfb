# SPDX-License-Identifier: Apache-2.0
"""Cells for the tests: scenarios without files, arrays cut into blocks, and processes."""

import contextlib
import itertools
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from lathe_bagtools.resimulation.resim import resimulate
from lathe_rc import harness, messages
from lathe_rc.blocks.wire import Encoder
from lathe_rc.cell.parameters import NodeParameters, remapped
from lathe_rc.cell.scenario import TABLES, Scenario, load
from lathe_rc.cell.wiring import Cell, Unknown

Values = Mapping[str, Any]

SCENARIOS = sorted((Path(__file__).parents[2] / "config").glob("*.yaml"))  #: that come with lathe_rc
#: those that together have every kind of node and of signal that the others have
EVERY_KIND = ("gauged", "loaded_cutting", "periodic", "piston", "series", "supervised_full_cell", "vibration")
STEP = 15_625  #: [ns] of the smallest whole cell
NODES = ("spindle_encoder", "learning_controller", "electrodynamic_actuator", "tool")
PATIENCE = 120.0  #: [s] with which a test waits, also on a busy machine whose kernels are not compiled yet


def every_scenario() -> list[Any]:
    """Parameters of a test of all scenarios; those that add no kind of node or of signal are marked `system`."""
    more = pytest.mark.system
    return [pytest.param(path, id=path.stem, marks=() if path.stem in EVERY_KIND else more) for path in SCENARIOS]


def scenario(shared: Values | None = None, **nodes: Values) -> Scenario:
    """The smallest whole cell; ``nodes`` holds values by node, those of further nodes too."""
    common = {"run_id": "test", **(shared or {})}
    values = {name: {**common, **nodes.get(name, {})} for name in dict.fromkeys([*NODES, *nodes])}
    values["spindle_encoder"].setdefault("revolutions", 3.0)
    tables = {name: TABLES[part.get("stage", name)].read(name, part) for name, part in values.items()}
    return Scenario("test", tables)


def all_but(cell: Scenario, *alone: str) -> list[list[str]]:
    """Processes of a cell: one for each of some nodes, and one for all others, since each takes time to start."""
    return cell.processes([[name for name in cell.nodes if name not in alone]])


def in_two(cell: Scenario) -> list[list[str]]:
    """Two processes of a cell, with neighbours of its file in different ones."""
    names = list(cell.nodes)
    return [names[::2], names[1::2]]


def listening(group: int) -> list[str]:
    """Local addresses at which a group of processes listens, as /proc/net has them."""
    sockets = set()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or the file is closed by now
            if os.getpgid(int(process.name)) == group:
                for file in process.glob("fd/*"):
                    with contextlib.suppress(OSError):
                        sockets.add(str(file.readlink()))
    rows = [line.split() for name in ("tcp", "tcp6") for line in Path("/proc/net", name).read_text().splitlines()[1:]]
    return [row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in sockets]


def announced(cell: Scenario, *names: str) -> Cell:
    """The cell as its nodes know it where nobody has the parameters of some: they have announced their topics."""
    whole = Cell(cell.nodes)
    unknown = {}
    for name in names:
        stage = whole.stages[name]
        dense = {remapped(stage.shared, port.topic): port.type for port in stage.outputs}
        sparse = {remapped(stage.shared, topic): kind for topic, kind in stage.sparse_topics.items()}
        reads = frozenset(remapped(stage.shared, port.topic) for port in stage.inputs)
        unknown[name] = Unknown(dense, sparse, reads)
    return Cell({name: table for name, table in cell.nodes.items() if name not in names}, unknown)


def run(shared: Values | None = None, **nodes: Values) -> harness.Result:
    """Run that cell offline."""
    return harness.run(scenario(shared, **nodes))


def config(name: str, *overrides: str) -> Scenario:
    """A scenario that comes with lathe_rc, with changes as ``--set`` takes them."""
    return load(SCENARIOS[0].with_stem(name), list(overrides))


def of_nodes(name: str, nodes: Mapping[str, NodeParameters]) -> Scenario:
    """A cell of other nodes than its time master names."""
    (master,) = Scenario(name, nodes).masters
    table = nodes[master].model_copy(update={"members": list(nodes)})
    return Scenario(name, {**nodes, master: table})


def assert_resimulated(bag: Path) -> None:
    """A re-simulation of a bag gives all of its signals to the bit."""
    found = resimulate(bag)
    assert (found.changed, found.different, found.missing) == (False, [], [])


def until(what: Callable[[], Any], look: Callable[[], object] = lambda: time.sleep(0.01)) -> Any:
    """Wait until ``what()`` is true, and return it; ``look()`` is called in between, as what spins a node."""
    deadline = time.monotonic() + PATIENCE
    while not (found := what()):
        assert time.monotonic() < deadline, f"waited for {PATIENCE:g} s in vain"
        look()
    return found


def told_until_all_have_ended(processes: harness.Processes) -> list[harness.Event]:
    """The events up to the end of the last process, whatever becomes of the run."""
    told, running = [], set(processes.pids)
    for event in processes.events(60.0):
        told.append(event)
        if event["event"] == "exit":
            running -= set(event["node"].split("+"))
        if not running:
            break
    return told


class Seen:
    """The events of a cell from its start on: what a busy machine tells early, or in another order, counts as well."""

    def __init__(self, processes):
        self._processes, self._events = processes, []

    def wait_for(self, kind, **values):
        wanted = {"event": kind, **values}.items()
        self.until(lambda events: any(wanted <= event.items() for event in events))

    def until(self, enough):
        """Until ``enough`` holds of all events so far."""
        if enough(self._events):
            return
        for event in self._processes.events(60.0):
            self._events.append(event)
            if enough(self._events):
                return
            self._processes._raise_failure(event)


@contextlib.contextmanager
def held(cell: Scenario, domain: int) -> Iterator[tuple[harness.Processes, Callable[[], None]]]:
    """The processes of a cell that does not begin, since its recorder is missing, and what starts that.

    To stop a recorder instead costs the 3 s after which DDS tells it again of whom it has not heard meanwhile.
    """
    groups = [[name] for name in cell.nodes if name != "recorder"]
    with harness.Processes(cell, groups, domain=domain) as processes:
        yield processes, lambda: processes._start(["recorder"])


@contextlib.contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """No file may grow beyond ``size`` [B]: for a process that writes one, the disk is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def encoder(result: harness.Result) -> messages.Signals:
    """The encoder's signals of a run."""
    return result.recording.of_type(messages.ENCODER)


def command(result: harness.Result) -> messages.Samples:
    """The drive's set point in a run [m]."""
    return result.recording.of_type(messages.COMMAND)["position"]


def form_error(result: harness.Result) -> messages.Samples:
    """The form error in a run [m]."""
    return result.recording.of_type(messages.TOOL)["error"]


#: lengths of consecutive blocks
cuts = st.lists(st.integers(1, 300), min_size=1, max_size=12)


def spans(lengths: Sequence[int]) -> list[tuple[int, int]]:
    """First and last-plus-one sample of consecutive blocks."""
    return list(itertools.pairwise([0, *itertools.accumulate(lengths)]))


def in_blocks(lengths: Sequence[int], block: Callable[..., object], *arrays: messages.Samples) -> None:
    """Call ``block(first, *parts)`` for each block of ``arrays``."""
    for start, stop in spans(lengths):
        block(start, *(array[start:stop] for array in arrays))


def same(a: messages.Signals, b: messages.Signals) -> bool:
    """Whether two sets of signals are equal to the bit."""
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


@contextlib.contextmanager
def started(*arguments, first=""):
    """A process of this project, killed at the end if it has not ended by itself; ``first``: what it runs before."""
    program = ["-c", f"{first}; from lathe_rc.cli import main; main()"] if first else ["-m", "lathe_rc"]
    command = [sys.executable, *program, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


_ONE_AFTER_THE_OTHER = """
import json, os, sys, tempfile
from lathe_rc.cli import main
told = []
for words in json.loads(sys.argv[1]):
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            main(words)
        except SystemExit as ended:
            code = ended.code
        said.seek(0)
        told.append((code, said.read().decode()))
print(json.dumps(told))
"""


def refusals(*commands: Sequence[object], cwd: Path | None = None) -> list[tuple[int, str]]:
    """Exit code and error stream of commands that end by themselves, one after the other in a process of their own.

    What is left of their ROS nodes would stay in this one, and to start a process for each takes longer than they do.
    """
    words = json.dumps([list(map(str, command)) for command in commands])
    process = [sys.executable, "-c", _ONE_AFTER_THE_OTHER, words]
    done = subprocess.run(process, stdout=subprocess.PIPE, text=True, check=True, cwd=cwd)
    return [(code, said) for code, said in json.loads(done.stdout)]


def block(msgtype, first, source, run_id, *, step=STEP, size=64, fill=0.0):
    """An encoded block, of anybody."""
    signals = messages.allocate(msgtype, size)
    for array in signals.values():
        array[:] = fill if array.dtype == np.float64 else 0
    return Encoder(msgtype, run_id, source, step).encode(first, signals, last=False, companions=0)[1]
