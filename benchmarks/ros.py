# SPDX-License-Identifier: Apache-2.0
"""The cell runs over ROS, with everything recorded.

Cells of 5, 8 and 13 nodes (recorder included) run at full speed: one process per node, grouped in two processes (the
recorder in one, all others in the other), and composed in one, with blocks of 64, 256 and 1024 samples. The loops of
the 13 close within 64 samples, which excludes longer blocks. The figures are:

- ``real_time_factor`` is simulated over wall time from block 0 to the last block in the bag, with the target beside it.
- ``cpu_us_per_message`` is the processor time of all processes together in that span over all blocks of all topics (by
  process in the stored result).
- ``latency_per_hop_us`` is, with one block in flight, the wall time of a block over its hops: spindle, controller,
  drive, tool, recorder, spindle again. It includes the nodes' computing.

References are the same cell with one message per sample (``benchmarks.naive.piston``), paced by a timer, which loses
samples, or in lockstep; lathe_rc with the executors of rclpy (``benchmarks.naive.container``); and bare transport
(``benchmarks.transport``): the processes of the piston or the full cell, one per node, pass the bytes of the same
messages along the same topics and compute nothing. ``bare_transport_ratio`` is the pace of the cell over that of bare
transport, the limit of the middleware.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks import sides
from benchmarks.transport import Transport
from lathe_rc import harness, resources
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell

ROOT = Path(__file__).resolve().parents[1]
PISTON = ("spindle_encoder", "learning_controller", "electrodynamic_actuator", "tool", "recorder")
#: Simulated revolutions by scenario and block size, with one process a node.
REVOLUTIONS = {
    "piston": {64: 60, 256: 150, 1024: 300},
    "vibration": {64: 30, 256: 75, 1024: 150},
    "full_cell": {64: 20},
}
_LONGER = {"processes": 1, "grouped": 5, "composed": 10}  # by arrangement: the quicker, the more revolutions
TARGETS = {"processes": {64: 3, 256: 10, 1024: 25}, "composed": {64: 6, 256: 20, 1024: 60}}
Say = Callable[[str], None]
_HOPS = 5
_RATE = 64000  # [Hz]
_ROUNDS, _BARE_ROUNDS, _QUICK_SHARE = 3, 7, 0.3
_NAIVE = {"timer": (6000, 2000), "lockstep": (3000, 500)}  # samples by pace: in full, quick
_PATIENCE = 60.0  # [s]
#: Simulated revolutions beside bare transport, by scenario and block size.
_BARE = {"piston": {64: 240, 256: 600, 1024: 900}, "full_cell": {64: 20}}
_OF_RCLPY = ("EventsExecutor", "SingleThreadedExecutor")


@dataclass(frozen=True)
class Run:
    """What a run of a cell took.

    Attributes:
        wall_s: from block 0 to the last block in the bag.
        samples: simulated, each of ``step`` seconds.
        blocks: of a topic.
        topics: that carry blocks.
        cpu_s: in the same span, until the bag was closed, by process.
    """

    wall_s: float
    samples: int
    step: float
    blocks: int
    topics: int
    cpu_s: Mapping[str, float]

    @property
    def real_time_factor(self) -> float:
        """Simulated over wall time."""
        return self.samples * self.step / self.wall_s


def load(name: str, **values: object) -> Scenario:
    """A scenario with changes; ``node__parameter`` or a shared parameter."""
    changes = [f"{key.replace('__', '.')}={value}" for key, value in values.items()]
    return scenarios.load(resources.find(Path(f"{name}.yaml")), changes)


def split(scenario: Scenario, arrangement: str) -> list[list[str]]:
    """Names of the nodes in each process."""
    if arrangement == "composed":
        return [list(scenario.nodes)]
    if arrangement == "processes":
        return [[node] for node in scenario.nodes]
    return [[node for node in scenario.nodes if node != "recorder"], ["recorder"]]


def cpu_s(pid: int) -> float:
    """Processor time that a process has used so far [s]; Linux makes the clock's number from the process's."""
    return time.clock_gettime(~pid << 3 | 2)


@contextlib.contextmanager
def container(**environment: str) -> Iterator[None]:
    """Processes of cells that are started here run `benchmarks.naive.container`."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]

    def command(_cell: harness.Processes, _first: str, arguments: Sequence[str]) -> list[str]:
        return [sys.executable, "-m", "benchmarks.naive.container", *arguments]

    with (
        mock.patch.object(harness.Processes, "_command", command),
        mock.patch.dict(os.environ, {**environment, "PYTHONPATH": os.pathsep.join(paths)}),
    ):
        yield


def run(
    scenario: Scenario,
    groups: Callable[[Scenario], list[list[str]]],
    setting: Callable[[Mapping[str, int]], None] | None = None,
) -> Run:
    """Run a cell, recorded to a bag that is thrown away; ``setting`` is done to its processes, by node, at block 0."""
    before: dict[int, float] = {}
    after: dict[int, float] = {}
    cell = Cell(scenario.nodes)
    with tempfile.TemporaryDirectory(prefix="lathe-bench-") as folder:
        complete = harness.with_recorder(scenario, Path(folder) / "bag", keep=True)
        split = groups(complete)
        with harness.Processes(complete, split) as processes:

            def watch(event: harness.Event) -> None:
                if event["event"] == "block0":
                    if setting:
                        setting(processes.pids)
                    before.update({pid: cpu_s(pid) for pid in set(processes.pids.values())})
                elif event["event"] == "done":
                    after[processes.pids[event["node"]]] = event["cpu_s"]

            events = processes.wait_for_end(watch)
            names = {processes.pids[group[0]]: "+".join(group) for group in split}
    assert cell.master.samples is not None, "a run that is measured has an end"
    return Run(
        wall_s=(events["complete"]["monotonic_ns"] - events["block0"]["monotonic_ns"]) * 1e-9,
        samples=cell.master.samples,
        step=scenario.shared.step,
        blocks=-(-cell.master.samples // scenario.shared.block_size),
        topics=len(cell.dense),
        cpu_s={name if len(names) > 1 else "all": after[pid] - before[pid] for pid, name in names.items()},
    )


def figures(runs: Sequence[Run]) -> dict[str, Any]:
    """Speed and cost of some runs of one cell."""
    return {
        "real_time_factor": sides.spread([run.real_time_factor for run in runs]),
        "cpu_us_per_block": {
            name: sides.spread([run.cpu_s[name] / run.blocks * 1e6 for run in runs]) for name in runs[0].cpu_s
        },
        "cpu_us_per_message": sides.spread([sum(run.cpu_s.values()) / run.blocks / run.topics * 1e6 for run in runs]),
    }


def _cells(
    name: str, sizes: Iterable[int], arrangements: Sequence[str], rounds: int, say: Say, share: float = 1.0
) -> dict[str, Any]:
    """A scenario for some block sizes, arranged in some ways, in turn."""
    found: dict[str, Any] = {}
    for size in sizes:
        runs: dict[str, list[Run]] = {arrangement: [] for arrangement in arrangements}
        for arrangement in [*arrangements] * rounds:
            turns = share * REVOLUTIONS[name][size] * _LONGER[arrangement]
            scenario = load(name, block_size=size, spindle_encoder__revolutions=turns)
            done = run(scenario, partial(split, arrangement=arrangement))
            runs[arrangement].append(done)
            say(f"  {name}, blocks of {size}, {arrangement}: {done.real_time_factor:.2f} x real time")
        found[f"block_{size}"] = {each: figures(runs[each]) for each in arrangements}
        if name == "piston":
            for each in set(arrangements) & set(TARGETS):
                found[f"block_{size}"][each]["target_real_time_factor"] = TARGETS[each][size]
    return found


def _alone(scenario: Scenario) -> float:
    """Real-time factor with one process a node."""
    return run(scenario, partial(split, arrangement="processes")).real_time_factor


def _pace(transport: Transport) -> float:
    return transport.run().real_time_factor


def _bare_transport(name: str, sizes: Iterable[int], rounds: int, say: Say, share: float = 1.0) -> dict[str, Any]:
    """A scenario, one process a node, beside its messages alone, by turns."""
    found: dict[str, Any] = {}
    for size in sizes:
        scenario = load(name, block_size=size, spindle_encoder__revolutions=share * _BARE[name][size])
        with tempfile.TemporaryDirectory(prefix="lathe-bench-") as folder:
            transport = Transport(harness.with_recorder(scenario, Path(folder) / "bag", keep=True), Path(folder))
            turns = {"cell": partial(_alone, scenario), "bare": partial(_pace, transport)}
            paces = sides.alternate(turns, rounds)
        ratio = sides.ratio(paces["cell"], paces["bare"])
        say(f"  {name}, blocks of {size}: {ratio['median']:.2f} of the pace of bare transport")
        found[f"{name}_block_{size}"] = {
            "cell_real_time_factor": sides.spread(paces["cell"]),
            "bare_real_time_factor": sides.spread(paces["bare"]),
            "bare_transport_ratio": ratio,
        }
    return found


def _latency(rounds: int) -> dict[str, Any]:
    """One block of the piston in flight."""
    scenario = load("piston", window=1, spindle_encoder__revolutions=20)

    def side(arrangement: str) -> float:
        alone = run(scenario, partial(split, arrangement=arrangement))
        return alone.wall_s / alone.blocks / _HOPS * 1e6

    found = sides.alternate({each: partial(side, each) for each in ("processes", "composed")}, rounds)
    return {each: sides.spread(figures) for each, figures in found.items()}


def _executors(rounds: int) -> dict[str, Any]:
    """The piston with our executor and those of rclpy."""
    scenario = load("piston", spindle_encoder__revolutions=REVOLUTIONS["piston"][64])

    def side(executor: str) -> float:
        with container(LATHE_BENCH_EXECUTOR=executor):
            return _alone(scenario)

    found = sides.alternate({each or "own": partial(side, each) for each in ("", *_OF_RCLPY)}, rounds)
    return {
        each: {"real_time_factor": sides.spread(paces), "own_ratio": sides.ratio(found["own"], paces)}
        for each, paces in found.items()
    }


def naive(pace: str, samples: int) -> dict[str, float]:
    """A run of the cell with a message a sample: what the recorder says."""
    nodes = ("recorder", "tool", "drive", "controller", "spindle")
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="lathe-bench-"))
        paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = os.environ | {
            "PYTHONPATH": paths,
            "ROS_DOMAIN_ID": str(stack.enter_context(harness.free_domain())),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        children = {}
        for name in nodes:
            command = [sys.executable, "-m", "benchmarks.naive.piston", name, str(samples), pace, folder]
            children[name] = stack.enter_context(
                subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            )
            stack.callback(children[name].kill)
        for child in children.values():
            assert child.stdout, "it was opened"
            assert child.stdout.readline() == "ready\n", "a naive node did not start"
        spindle = children["spindle"].stdin
        assert spindle, "it was opened"
        spindle.write("go\n")
        spindle.flush()
        told = children["recorder"].communicate(timeout=_PATIENCE)[0]
    return dict(json.loads(told))


def _naive(ours: Callable[[], float], *, quick: bool) -> dict[str, Any]:
    """The piston with a message a sample, beside one process a node of ours (``ours``: its real-time factor)."""
    lost: dict[str, list[float]] = {}

    def side(pace: str) -> float:
        samples = _NAIVE[pace][quick]
        told = naive(pace, samples)
        lost.setdefault(pace, []).append(100 * (1 - told["tool"] / samples))
        return told["tool"] / told["wall_s"]

    paces = ["timer"] if quick else list(_NAIVE)
    found = sides.alternate({"ours": ours} | {each: partial(side, each) for each in paces}, 1 if quick else _ROUNDS)
    return {
        pace: {
            "samples_per_s": sides.spread(found[pace]),
            "real_time_factor": sides.spread([rate / _RATE for rate in found[pace]]),
            "samples_lost_percent": sides.spread(lost[pace]),
            "lathe_rc_over_naive_ratio": sides.ratio(found["ours"], [rate / _RATE for rate in found[pace]]),
        }
        for pace in paces
    }


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """All of it, 14 minutes; quick: the piston once with short blocks, as processes and composed."""
    found: dict[str, Any] = {}
    if quick:
        # Not the longer blocks: most of the time goes into starting the processes.
        found["piston_5_nodes"] = _cells("piston", [64], ["processes", "composed"], 1, say, _QUICK_SHARE)
        ours = found["piston_5_nodes"]["block_64"]["processes"]["real_time_factor"]["median"]
        say("  bare transport")
        found["bare_transport"] = _bare_transport("piston", [64], 1, say, _QUICK_SHARE)
        say("  a message a sample")
        return {**found, "naive": _naive(lambda: float(ours), quick=True)}
    arrangements = ["processes", "grouped", "composed"]
    for name, sizes in REVOLUTIONS.items():
        count = len(harness.with_recorder(load(name), Path("bag"), keep=True).nodes)
        found[f"{name}_{count}_nodes"] = _cells(name, sizes, arrangements, _ROUNDS, say)
    say("  bare transport")
    found["bare_transport"] = {}
    for name, sizes in _BARE.items():
        found["bare_transport"] |= _bare_transport(name, sizes, _BARE_ROUNDS, say)
    say("  one block in flight")
    found["latency_per_hop_us"] = _latency(_ROUNDS)
    say("  executors")
    found["executor"] = _executors(_ROUNDS)
    say("  a message a sample")
    scenario = load("piston", spindle_encoder__revolutions=REVOLUTIONS["piston"][64])
    return {**found, "naive": _naive(partial(_alone, scenario), quick=False)}
