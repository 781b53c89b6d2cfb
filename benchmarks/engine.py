# SPDX-License-Identifier: Apache-2.0
"""The offline engine against plain C: the two-channel cell, one core.

The same arithmetic stands in benchmarks/c/cell.c, one sample after the other, compiled with -O3 -march=native; with
-ffp-contract=off it gives the same bits, which is checked here. Sides take turns on the same run: the engine, C, C with
contraction, and 32 cells in lanes. A ratio is the speed of the engine over that of C, so 1 is as fast as C. The engine
also makes its joint states, learning status and stability margins, which C does not.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.plain_c import PlainC, compiled
from benchmarks.sides import alternate, ratio, seconds, spread
from lathe_rc import resources
from lathe_rc.cell import scenario
from lathe_rc.cell.collect import Collector
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.lanes import Lanes
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError

LANES = 32
_CHUNK = 3200
#: beside config/two_channel.yaml: what the C has too, and what it leaves out
OVERRIDES = (
    "learning_controller.identify=false",
    "fine_controller.identify=false",
    "piezo_actuator.amplifier_lag=40e-6",
)


def cell(revolutions: float, *overrides: str) -> Cell:
    """The two-channel cell that is measured."""
    path = resources.find(Path("two_channel.yaml"))
    loaded = scenario.load(path, [f"spindle_encoder.revolutions={revolutions}", *OVERRIDES, *overrides])
    return Cell(loaded.nodes)


def variation(lane: int, revolutions: float) -> Cell:
    """The same with numbers of its own in every stage but the spindle."""
    return cell(
        revolutions,
        f"learning_controller.lead_time={1.425e-3 * (1 + 0.002 * (lane % 5))}",
        f"learning_controller.q_time={66.9e-6 * (1 + 0.01 * (lane % 3))}",
        f"electrodynamic_actuator.delay={0.36e-3 * (1 + 0.001 * lane)}",
        f"fine_controller.learning_gain={1 - 0.005 * lane}",
        f"piezo_actuator.identified_scale={1 - 0.005 * lane}",
    )


def difference(revolutions: float = 40.0) -> str:
    """The first signal in which C without contraction differs from the engine; empty if all bits are equal."""
    engine = Engine(cell(revolutions))
    collector = Collector(cell(revolutions), engine.samples)
    engine.run([collector])
    dense = collector.recording().dense
    plain = PlainC(compiled("cell", "-ffp-contract=off"), cell(revolutions), _CHUNK)
    for first in range(0, engine.samples, _CHUNK):
        samples = min(_CHUNK, engine.samples - first)
        plain.step(first, samples)
        for (topic, name), array in plain.signals.items():
            if array[:samples].tobytes() != dense[f"/{topic}"][name][first : first + samples].tobytes():
                place = int(np.argmax(array[:samples] != dense[f"/{topic}"][name][first : first + samples]))
                return f"/{topic}.{name} at sample {first + place}"
    return ""


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """See the module."""
    if differs := difference():
        raise LatheError(f"plain C and the engine differ first in {differs}")
    revolutions, rounds = (150.0, 5) if quick else (600.0, 15)
    samples = Engine(cell(revolutions)).samples
    libraries = {"c": compiled("cell", "-ffp-contract=off"), "c_contracted": compiled("cell")}

    def engine() -> float:
        made = Engine(cell(revolutions))
        return seconds(lambda: made.run([])) / samples

    def plain(name: str) -> Callable[[], float]:
        def side() -> float:
            made = PlainC(libraries[name], cell(revolutions), _CHUNK)
            return seconds(lambda: made.run(samples)) / samples

        return side

    def lanes() -> float:
        made = Lanes([variation(lane, revolutions / 4) for lane in range(LANES)])
        return seconds(made.run) / made.samples / LANES

    sides = {"engine": engine, "c": plain("c"), "c_contracted": plain("c_contracted"), "lanes": lanes}
    for side in sides.values():
        side()
    found = alternate(sides, rounds)
    rate = 1.0 / cell(1.0).master.shared.step
    return {
        "same_bits_as_c": True,
        "c_ratio": ratio(found["c"], found["engine"]),
        "target_c_ratio": 0.9,
        "c_contracted_ratio": ratio(found["c_contracted"], found["engine"]),
        "lanes_c_ratio": ratio(found["c"], found["lanes"]),
        "target_lanes_c_ratio": 3.0,
        "real_time_factor": spread([1.0 / (t * rate) for t in found["engine"]]),
        "target_real_time_factor": 150.0,
        "ns_per_sample": {name: spread([t * 1e9 for t in times]) for name, times in found.items()},
    }
