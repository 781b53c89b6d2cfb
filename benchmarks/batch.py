# SPDX-License-Identifier: Apache-2.0
"""Batches run variations of a cell on all cores; plain C runs on one.

1000 two-channel cells of 20 revolutions differ in five parameters, 200 full cells in three; each keeps the form error
by revolution. A ratio is the speed per core over that of C: 1 is as fast as C on every core. ``prepared_c_ratio``
covers only the computing of prepared cells in threads, ``c_ratio`` all from the scenario's values to the errors. For
``all_cores``, C also computes on every core at once. Preparing a cell takes Python's lock, which the threads share;
computing does not. ``memory_mb`` is the memory growth of the process from a tenth of the batch to the whole.
"""

import os
import resource
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from benchmarks.engine import OVERRIDES, loaded, plain
from benchmarks.sides import alternate, ratio, seconds, spread
from lathe_rc.cell import batch
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell

_REVOLUTIONS = 20.0
_CELLS = {"two_channel": 1000, "full_cell": 200}
READY = 40  # cells that stand ready at a time: they take memory
_TARGETS = {"target_prepared_c_ratio": 0.9, "target_c_ratio": 0.7}
_CORES = os.cpu_count() or 1


def variations(name: str, count: int) -> Iterator[Scenario]:
    """Scenarios of a batch."""
    base = loaded(name, _REVOLUTIONS, *OVERRIDES[name]).named()  # as a sweep has it: cells need no run id of their own
    for k in range(count):
        values = {
            "learning_controller.lead_time": 1.425e-3 * (1.0 + 0.01 * k / count),
            "learning_controller.q_time": 66.9e-6 * (1.0 + 0.02 * (k % 7) / 7),
            "fine_controller.learning_gain": 1.0 - 0.1 * (k % 11) / 11,
        }
        if name == "two_channel":
            values["electrodynamic_actuator.delay"] = 0.36e-3 * (1.0 + 0.01 * (k % 13) / 13)
            values["piezo_actuator.identified_scale"] = 1.0 - 0.01 * (k % 17) / 17
        yield base.varied(values)


def _whole(name: str, count: int) -> float:
    """Time of a batch, by sample and core [s]."""
    failed, samples = 0, Cell(next(variations(name, 1)).nodes).samples

    def go() -> None:
        nonlocal failed
        failed = sum(outcome.error is not None for outcome in batch.run_many(variations(name, count), batch.Errors))

    time = seconds(go)
    assert not failed, "all of them work"
    return time * _CORES / count / samples


def prepared(name: str, count: int) -> float:
    """The same of the computing alone."""
    total, samples = 0.0, 0
    with ThreadPoolExecutor(_CORES) as pool:
        for _ in range(0, count, READY):
            cells = [Cell(each.nodes) for each in variations(name, READY)]
            engines = [Engine(cell, batch.Errors(cell, 0).heard) for cell in cells]
            samples += sum(engine.samples for engine in engines)
            total += seconds(partial(_run, pool, engines))
    return total * _CORES / samples


def _run(pool: ThreadPoolExecutor, engines: Iterable[Engine]) -> None:
    for _ in pool.map(lambda engine: engine.run([]), engines):
        pass


def _taken() -> float:
    """Largest memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """See the module."""
    found: dict[str, Any] = {}
    for name, cells in _CELLS.items():
        say(f"batch {name}")
        count, rounds = (cells // 5, 2) if quick else (cells, 5)
        c = plain(name, _REVOLUTIONS * 5, "-ffp-contract=off")
        c_on_all = plain(name, _REVOLUTIONS * 5, "-ffp-contract=off", at_once=_CORES)
        c()
        _whole(name, count // 10)
        before = _taken()
        _whole(name, count)
        grown = _taken() - before
        turns = {
            "batch": partial(_whole, name, count),
            "prepared": partial(prepared, name, count),
            "c": c,
            "c_on_all": c_on_all,
        }
        times = alternate(turns, rounds)
        found[name] = {
            "cells": count,
            "c_ratio": ratio(times["c"], times["batch"]),
            "prepared_c_ratio": ratio(times["c"], times["prepared"]),
            "all_cores_c_ratio": ratio(times["c_on_all"], times["batch"]),
            "all_cores_prepared_c_ratio": ratio(times["c_on_all"], times["prepared"]),
            **_TARGETS,
            "cells_per_s": spread([_CORES / (time * 64_000 * 1.2) for time in times["batch"]]),
            "memory_mb": grown,
        }
    return found
