# SPDX-License-Identifier: Apache-2.0
"""The piston at speed factor 1, everything recorded: does it keep real time, how well, and at what cost?

Blocks of 64 samples, so one is due each millisecond. Composed for ten minutes, one process a node and grouped for one:

- ``lateness_..._us``: from the moment at which a block was due to that at which the spindle let it go; its jitter
  is the standard deviation;
- ``latency_..._us``: from there until every member has completed it, as they tell, which is every few blocks;
- ``missed_deadlines``: blocks that went out later than a block lasts;
- ``real_time_factor``: below 1 by what the schedule has slipped, which it does when half a window is lost;
- ``cpu_percent``: of one core, all processes together; ``idle_...``: while the nodes wait for a member that does not
  come, and when all are ready but blocks are ten seconds apart.

Then one process a node for half a minute with each setting: two cores shared out (spindle, controller and drive on the
first), priority (nice -10; SCHED_FIFO 10), and a SingleThreadedExecutor. What the system does not permit is left out.
"""

import os
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import ros
from lathe_rc import harness

_TEN_MINUTES, _MINUTE, _SETTING, _QUICK = 600.0, 60.0, 30.0, 10.0  # [s]
_IDLE, _SETTLE = 4.0, 1.0  # [s] over which an idle cell is watched, and before
_NICE, _FIFO = -10, 10
Setting = Callable[[Mapping[str, int]], None]  #: done to the processes of the nodes


def _threads(pid: int) -> list[int]:
    return [int(task.name) for task in Path(f"/proc/{pid}/task").iterdir()]


def _affinity(pids: Mapping[str, int]) -> None:
    cores = sorted(os.sched_getaffinity(0))
    for name, pid in pids.items():
        core = cores[0 if name in ros.PISTON[:3] else -1]
        for thread in _threads(pid):
            os.sched_setaffinity(thread, {core})


def _nice(pids: Mapping[str, int]) -> None:
    for pid in set(pids.values()):
        for thread in _threads(pid):
            os.setpriority(os.PRIO_PROCESS, thread, _NICE)


def _fifo(pids: Mapping[str, int]) -> None:
    for pid in set(pids.values()):
        for thread in _threads(pid):
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(_FIFO))


_SETTINGS: dict[str, Setting] = {"affinity": _affinity, "nice": _nice, "sched_fifo": _fifo}


_POINTS = {"median": 50, "p99": 99, "p99_9": 99.9}


def _spread(name: str, seconds: Any) -> dict[str, float]:
    """Of durations [s]."""
    found = {f"{name}_{point}_us": float(np.percentile(seconds, at)) * 1e6 for point, at in _POINTS.items()}
    return found | {f"{name}_worst_us": float(seconds.max()) * 1e6}


def paced(seconds: float, arrangement: str, setting: Setting | None = None, executor: str = "") -> dict[str, Any]:
    """The piston in real time for some seconds."""
    scenario = ros.load(
        "piston", spindle_encoder__revolutions=round(seconds * 1000 / 60, 2), spindle_encoder__speed_factor=1.0
    )
    with tempfile.TemporaryDirectory(prefix="lathe-bench-") as folder:
        file = Path(folder) / "durations.npz"
        with ros.container(LATHE_BENCH_DURATIONS=str(file), LATHE_BENCH_EXECUTOR=executor):
            run = ros.run(scenario, partial(ros.split, arrangement=arrangement), setting)
        with np.load(file) as found:
            lateness, latency = found["lateness"], found["latency"]
    block = scenario.shared.block_size * scenario.shared.step
    missed = int((lateness > block).sum())
    return {
        "seconds": run.wall_s,
        "real_time_factor": run.real_time_factor,
        "missed_deadlines": missed,
        "missed_deadlines_percent": 100 * missed / run.blocks,
        "lateness_jitter_us": float(lateness.std()) * 1e6,
        **_spread("lateness", lateness),
        **_spread("latency", latency),
        "cpu_percent": 100 * sum(run.cpu_s.values()) / run.wall_s,
    }


def idle(arrangement: str) -> dict[str, float]:
    """Processor time of a cell that does nothing, of one core."""
    return {
        "idle_waiting_cpu_percent": _idle(arrangement, "active", missing=["nobody"]),
        "idle_ready_cpu_percent": _idle(arrangement, "ready", missing=[]),
    }


def _idle(arrangement: str, state: str, missing: list[str]) -> float:
    scenario = ros.load("piston", spindle_encoder__speed_factor=1e-4)
    with tempfile.TemporaryDirectory(prefix="lathe-bench-") as folder:
        complete = harness.with_recorder(scenario, Path(folder) / "bag", keep=True)
        spindle = complete.nodes["spindle_encoder"]
        members = [*getattr(spindle, "members"), *missing]  # noqa: B009 - of this kind of node only
        complete.nodes["spindle_encoder"] = spindle.model_copy(update={"members": members})
        with harness.Processes(complete, ros.split(complete, arrangement)) as cell:
            waiting = set(complete.nodes)
            while waiting:
                waiting.discard(cell.wait_for(state)["node"])
            time.sleep(_SETTLE)
            pids = set(cell.pids.values())
            before, start = sum(map(ros.cpu_s, pids)), time.monotonic()
            time.sleep(_IDLE)
            return 100 * (sum(map(ros.cpu_s, pids)) - before) / (time.monotonic() - start)


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """All of it, 15 minutes; quick: ten seconds of each arrangement and nothing of settings."""

    def told(what: str, figures: dict[str, Any]) -> dict[str, Any]:
        say(
            f"  {what}: {figures['real_time_factor']:.3f} x real time, {figures['missed_deadlines']} deadlines missed, "
            f"worst {figures['lateness_worst_us'] * 1e-3:.1f} ms, {figures['cpu_percent']:.0f} % of a core"
        )
        return figures

    found: dict[str, Any] = {}
    for arrangement, seconds in {"composed": _TEN_MINUTES, "grouped": _MINUTE, "processes": _MINUTE}.items():
        found[arrangement] = told(arrangement, paced(_QUICK if quick else seconds, arrangement))
        if not quick:
            found[arrangement].update(idle(arrangement))
    if quick:
        return found
    settings: dict[str, Any] = {"none": told("no setting", paced(_SETTING, "processes"))}
    for name, setting in _SETTINGS.items():
        try:
            settings[name] = told(name, paced(_SETTING, "processes", setting))
        except PermissionError as error:
            say(f"  {name}: not permitted here ({error.strerror})")
            settings[name] = {"permitted": False}
    single = "SingleThreadedExecutor"
    settings["single_threaded"] = told(single, paced(_SETTING, "processes", executor=single))
    found["settings"] = settings
    return found
