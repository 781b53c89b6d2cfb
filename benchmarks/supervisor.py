# SPDX-License-Identifier: Apache-2.0
"""What a supervisor costs: the piston with every monitor on and a controller that obeys, against the same without.

The scenarios are `supervised`, with nothing allowed to break, and `piston`; the signals that both have are the same to
the bit. A ratio is the real-time factor with the supervisor over that without.

- `engine`: the offline engine alone, from the revolution on at which nothing is forgiven any more (12); before, the
  controllers take some 15 ms for their stability margins. Processor time.
- `recorded`: `harness.run` offline, all signals kept, the start left out. Wall time.
- `composed`: all nodes in one process over ROS, recorded. There the supervisor is one more node with four readers, a
  topic of its own that is recorded, and a reader more in the controller, and all of that is in the ratio.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.sides import alternate, ratio, spread
from lathe_rc import harness, resources
from lathe_rc.cell import scenario
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError

_SIDES = {"without": ("piston",), "with": ("supervised", "allow_faults=false")}
_FROM = 12 * 3840  # [sample], about the revolution from which on the engine is measured
_TARGET = 0.95


def loaded(side: str, revolutions: float) -> Scenario:
    """The scenario of a side."""
    name, *overrides = _SIDES[side]
    path = resources.find(Path(f"{name}.yaml"))
    return scenario.load(path, [f"spindle_encoder.revolutions={revolutions}", *overrides])


class Clock:
    """A sink that takes the processor's time."""

    def __init__(self) -> None:
        self.begin = self.end = 0.0
        self.samples = 0

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        self.end = time.process_time()
        if first < _FROM:
            self.begin = self.end
        else:
            self.samples += samples


def engine(side: str, revolutions: float) -> float:
    """Processor time a sample [s]."""
    clock = Clock()
    Engine(Cell(loaded(side, revolutions).nodes)).run([clock])
    return (clock.end - clock.begin) / clock.samples


def hosted(side: str, revolutions: float, mode: harness.Mode) -> float:
    """Wall time a sample [s]."""
    run = harness.run(loaded(side, revolutions), mode=mode)
    return run.wall_s / run.samples


def check(revolutions: float = 40.0) -> None:
    """See that the supervisor changes nothing.

    Raises:
        LatheError: it does.
    """
    without, watched = (harness.run(loaded(side, revolutions)).digest for side in _SIDES)
    changed = [topic for topic in without if watched[topic] != without[topic]]
    if changed:
        raise LatheError(f"the supervisor changes {', '.join(changed)}")


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """See the module."""
    check()
    jobs: dict[str, tuple[Callable[[str], float], int]] = {
        "engine": (lambda side: engine(side, 120.0), 15 if quick else 60),
        "recorded": (lambda side: hosted(side, 200.0, "offline"), 5 if quick else 15),
    }
    if not quick:
        jobs["composed"] = (lambda side: hosted(side, 100.0, "composed"), 3)
    result: dict[str, Any] = {}
    for name, (job, rounds) in jobs.items():
        say(f"supervisor {name}")
        found = alternate({side: lambda side=side: job(side) for side in _SIDES}, rounds)  # type: ignore[misc] # noqa: B023
        result[name] = {
            "ratio": ratio(found["without"], found["with"]),
            **({} if name == "composed" else {"target_ratio": _TARGET}),
            **{f"{side}_ns_per_sample": spread([t * 1e9 for t in times]) for side, times in found.items()},
        }
    return {"same_bits": True, **result}
