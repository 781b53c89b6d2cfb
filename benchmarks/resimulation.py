# SPDX-License-Identifier: Apache-2.0
"""``lathe resim BAG`` takes the spindle from the bag and computes everything after it again, with nothing changed.

The factor includes digests and their comparison with the recorded ones, but not opening the bag and wiring the cell.
Every run must be bit-identical.
"""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import sides
from lathe_bagtools.resimulation.resim import resimulate
from lathe_rc import harness, resources
from lathe_rc.cell import scenario
from lathe_rc.errors import LatheError

_TARGETS = {"piston": 50.0, "two_channel": 50.0, "full_cell": 20.0}  # times real time


def again(bag: Path) -> float:
    """Simulated time over wall time of one re-simulation.

    Raises:
        LatheError: it differs from the bag.
    """
    found = resimulate(bag)
    if found.different or not found.recorded:
        raise LatheError(f"{bag}: its re-simulation differs in {', '.join(found.different) or 'everything'}")
    return found.simulated_s / found.wall_s


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """See the module."""
    with tempfile.TemporaryDirectory(prefix="lathe-bench-") as folder:
        bags = {name: Path(folder) / name for name in _TARGETS}
        for name, bag in bags.items():
            say(f"  a bag of {name}")
            sets = [f"spindle_encoder.revolutions={30.0 if quick else 300.0}"]
            harness.run(scenario.load(resources.find(Path(f"{name}.yaml")), sets), bag=bag)
            again(bag)  # compiles
        say("  re-simulations")
        found = sides.alternate({name: partial(again, bag) for name, bag in bags.items()}, 3 if quick else 15)
    return {
        name: {"real_time_factor": sides.spread(factors), "target_real_time_factor": _TARGETS[name]}
        for name, factors in found.items()
    }
