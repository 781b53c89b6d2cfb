# SPDX-License-Identifier: Apache-2.0
"""The piston with all monitors on is compared with variants without them.

The scenarios are ``supervised`` without faults (``watched``), with every monitor off (``idle``), also without the
margin published for them (``unwatched``), and ``piston``, which has neither a supervisor nor a node that obeys one
(``alone``). Common signals are bit-identical. A ratio is the real-time factor with every monitor on over that of
another side: ``same_topics`` refers to ``idle``, ``monitors`` to ``unwatched``, ``supervisor`` to ``alone``.

- ``engine`` is the processor time of chunks in the offline engine; the engines take turns after each. It counts from
  revolution 12 on, after all exceptions of the monitors: before, a controller takes 15 ms for its stability margins.
- ``recorded`` is the wall time of ``lathe_rc.run`` offline without the start, with all signals kept.
- ``composed`` has all nodes in one process over ROS, recorded. There the supervisor adds a node with five readers, a
  recorded topic, and a reader in the controller, all in the ratio to ``alone``. Three of these readers, and the topic
  with the margin, serve the monitors.
"""

import gc
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.sides import alternate, ratio, spread
from lathe_rc import harness, resources
from lathe_rc.cell import scenario
from lathe_rc.cell.engine import Engine
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError

_NO_LIMIT = [f"supervisor.{name}_limit=0" for name in ("speed", "acceleration", "index", "error", "growth")]
_NO_LIMITS = [f"supervisor.{name}_limit=[]" for name in ("following", "stroke", "effort", "margin")]
_SUPERVISED = ("supervised", "allow_faults=false")
_SIDES = {
    "alone": ("piston",),
    "unwatched": (*_SUPERVISED, *_NO_LIMIT, *_NO_LIMITS, "learning_controller.publish_margin=false"),
    "idle": (*_SUPERVISED, *_NO_LIMIT, *_NO_LIMITS),
    "watched": _SUPERVISED,
}
_RATIOS = {"same_topics": "idle", "monitors": "unwatched", "supervisor": "alone"}
_FROM = 12 * 3840  # [sample], about the revolution from which on the engine is measured
_CHUNK = 3200  # [sample], of every side
_TARGET = 0.95


def loaded(side: str, revolutions: float) -> Scenario:
    """The scenario of a side."""
    name, *overrides = _SIDES[side]
    path = resources.find(Path(f"{name}.yaml"))
    return scenario.load(path, [f"spindle_encoder.revolutions={revolutions}", *overrides])


def engines(revolutions: float) -> dict[str, float]:
    """Processor time a sample of every side [s]; the engines take turns after every chunk."""
    running = {side: Engine(Cell(loaded(side, revolutions).nodes)).steps([]) for side in _SIDES}
    spent: dict[str, list[float]] = {side: [] for side in _SIDES}
    gc.collect()
    gc.freeze()  # as `Engine.run` does
    reached: int | None = 0
    while reached is not None:
        for side, steps in running.items():
            start = time.thread_time()
            reached = next(steps, None)
            if reached is not None and reached > _FROM:
                spent[side].append(time.thread_time() - start)
    gc.unfreeze()
    # All chunks but the last are whole.
    return {side: sum(chunks[:-1]) / (len(chunks) - 1) / _CHUNK for side, chunks in spent.items()}


def hosted(side: str, revolutions: float, mode: harness.Mode) -> float:
    """Wall time a sample [s]."""
    run = harness.run(loaded(side, revolutions), mode=mode)
    return run.wall_s / run.samples


def check(revolutions: float = 40.0) -> None:
    """See that neither the supervisor nor its monitors change anything.

    Raises:
        LatheError: they do.
    """
    digests = {side: harness.run(loaded(side, revolutions)).digest for side in _SIDES}
    watched = digests["watched"]
    for side, found in digests.items():
        changed = [topic for topic in found if watched[topic] != found[topic]]
        if changed:
            raise LatheError(f"{', '.join(changed)} are not what they are {side}")


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """See the module."""
    check()
    say("supervisor engine")
    rounds = [engines(120.0) for _ in range(15 if quick else 60)]
    times = {"engine": {side: [one[side] for one in rounds] for side in _SIDES}}
    # Revolutions and rounds: of a short offline run the margins of the first ones are a quarter.
    hosts: dict[str, tuple[harness.Mode, float, int]] = {"recorded": ("offline", 400.0, 5 if quick else 15)}
    if not quick:
        hosts["composed"] = ("composed", 1000.0, 9)
    for name, (mode, revolutions, count) in hosts.items():
        say(f"supervisor {name}")
        sides = {side: partial(hosted, side, revolutions, mode) for side in _SIDES}
        times[name] = alternate(sides, count)
    result: dict[str, Any] = {"same_bits": True}
    for name, found in times.items():
        result[name] = {
            **{f"{of}_ratio": ratio(found[side], found["watched"]) for of, side in _RATIOS.items()},
            **{f"target_{of}_ratio": _TARGET for of in _RATIOS},
            **{f"{side}_ns_per_sample": spread([t * 1e9 for t in found[side]]) for side in _SIDES},
        }
    return result
