# SPDX-License-Identifier: Apache-2.0
"""Sweeps run thousands of cells by Dask on all cores.

10 000 two-channel cells of 20 revolutions differ in five parameters, 2000 full cells in three (a fifth of them with
--quick). ``computing_share`` is the time of the computing alone (prepared cells, one thread per core) over that of the
whole sweep, from the first task to the last row on the disk. The workers are already running.

``growth`` sweeps cells of one revolution of the piston, which are nearly all preparation. It gives the time per cell,
the share of the cores' time not spent on cells (``overhead_percent``), and the memory of this process at the end.
"""

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import distributed
import psutil

from benchmarks import batch
from benchmarks.engine import OVERRIDES, loaded
from benchmarks.sides import alternate, ratio, spread
from lathe_explore.sweep import row, workers
from lathe_explore.sweep.space import Space
from lathe_explore.sweep.sweep import run_sweep
from lathe_rc.cell.scenario import Scenario

_CORES = os.cpu_count() or 1
_CELLS = {"two_channel": 10_000, "full_cell": 2000}
_QUICKER = 5
_REVOLUTIONS = 20.0
_RANGES = {
    "learning_controller.lead_time": "1.425e-3:1.44e-3",
    "learning_controller.q_time": "66.9e-6:68e-6",
    "fine_controller.learning_gain": "0.9:1.0",
}
_MORE = {"electrodynamic_actuator.delay": "0.36e-3:0.364e-3", "piezo_actuator.identified_scale": "0.99:1.0"}
_GROWTH = (100, 1000, 10_000, 100_000)
_TARGET = 1.0 / 1.3


def _sweep(client: distributed.Client, scenario: Scenario, space: Space) -> tuple[float, float]:
    """Time of a sweep, and what the workers spend on its cells [s]."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        found = run_sweep(scenario, space, Path(folder) / "rows", client=client)
        took = time.perf_counter() - start
        assert set(found.statuses()) == {row.DONE}, "all of them work"
        return took, sum(found.folder.table(["seconds"]).column("seconds").to_pylist())


def _against(client: distributed.Client, name: str, count: int, rounds: int) -> dict[str, Any]:
    scenario = loaded(name, _REVOLUTIONS, *OVERRIDES[name])
    ranges = _RANGES | (_MORE if name == "two_channel" else {})
    space = Space(sampled=ranges, sample=f"random:{count}")
    samples = scenario.nodes["spindle_encoder"].revolutions * 60.0 / scenario.shared.nominal_rpm
    samples *= scenario.shared.sample_rate
    sides: dict[str, Callable[[], float]] = {
        "sweep": lambda: _sweep(client, scenario, space)[0] / count,
        "computing": lambda: batch.prepared(name, batch.READY * 5) * samples / _CORES,
    }
    _sweep(client, scenario, Space(sampled=ranges, sample=f"random:{_CORES * 4}"))  # compiles
    times = alternate(sides, rounds)
    return {
        "cells": count,
        "computing_share": ratio(times["computing"], times["sweep"]),
        "target_computing_share": _TARGET,
        "cells_per_s": spread([1.0 / each for each in times["sweep"]]),
        "computing_cells_per_s": spread([1.0 / each for each in times["computing"]]),
    }


def _growth(client: distributed.Client, count: int) -> dict[str, float]:
    scenario = loaded("piston", 1.0)
    space = Space(sampled={"learning_controller.lead_time": "1.4e-3:1.45e-3"}, sample=f"random:{count}")
    took, spent = _sweep(client, scenario, space)
    return {
        "ms_per_cell": took / count * 1e3,
        "overhead_percent": 100.0 * (1.0 - spent / (took * _CORES)),
        "memory_mb": psutil.Process().memory_info().rss * 1e-6,
    }


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """See the module."""
    found: dict[str, Any] = {}
    with workers.client_of(None, None) as client:
        for name, cells in _CELLS.items():
            say(f"sweep {name}")
            count, rounds = (cells // _QUICKER, 1) if quick else (cells, 2)
            found[name] = _against(client, name, count, rounds)
        _growth(client, _CORES)
        found["growth"] = {}
        for count in _GROWTH[:-1] if quick else _GROWTH:
            say(f"sweep growth {count}")
            found["growth"][str(count)] = _growth(client, count)
    return found
