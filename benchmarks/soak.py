# SPDX-License-Identifier: Apache-2.0
"""What a cell of processes withstands: python benchmarks/soak.py [PART ...] [--long] [--seed N] [--json FILE].

Parts, short by default, and with ``--long``:

- blocks: 20 000 (10⁶) blocks of 8 samples without a lost sample; memory of each process, early and at the end;
- kill: SIGKILL of a random node at 6 (100) random moments: a controller with a restart_file goes on, and the digest is
  that of an undisturbed run; without any other node the cell goes to its safe state, and the bag is readable;
- stop: SIGSTOP and SIGCONT of random nodes at 6 (100) random moments of one run, which keeps its digest; of the 100
  stops, 5 are longer than DDS by default remembers a participant;
- cells: two cells at once in one domain, 1 (20) times, each with its own digest.

A full disk and a link that loses and delays are in tests/system (./lathe test --system). Exit code 1: something failed.
"""

import argparse
import json
import os
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from random import Random
from statistics import median
from typing import Any

from lathe_rc import harness
from lathe_rc.bag.check import check
from lathe_rc.cell.scenario import Scenario, load
from lathe_rc.errors import LatheError

CONFIG = Path(__file__).parents[1] / "config"
OWN = "learning_controller"
_PAGE = os.sysconf("SC_PAGESIZE")
_GROWTH = 32 * 2**20  # [B] that a process may grow after the first tenth of a run
_STOPPED = 0.3  # [s] at most that a node is stopped
_SOON = 0.1  # [s] within which a death or a stall should be noticed
_AWAY = 25.0  # [s] the long stops; DDS drops a participant that is silent for 10 s


def memory(pid: int) -> int:
    """Resident memory of a process [B]; 0 if it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]) * _PAGE
    except (FileNotFoundError, ProcessLookupError):
        return 0


class Memories:
    """Watches a run: memory of each process after a tenth of it, and the largest after that [B]."""

    def __init__(self) -> None:
        self.pids: dict[str, int] = {}
        self.early: dict[str, int] = {}
        self.largest: Counter[str] = Counter()
        self._tenth = 0

    def __call__(self, event: harness.Event) -> None:
        """Take an event."""
        if event["event"] == "checked":
            self._tenth = event["samples"] // 10
        elif event["event"] == "active":
            self.pids[event["node"]] = event["pid"]
        elif event["event"] == "progress" and event["samples"] >= self._tenth:
            now = {node: memory(pid) for node, pid in self.pids.items()}
            self.early = self.early or now
            self.largest |= Counter(now)


def blocks(scale: int, _random: Random) -> Mapping[str, Any]:
    """See the module."""
    count = 20_000 if scale == 1 else 1_000_000
    # 1000 rpm and 64 kHz: 480 blocks of 8 samples in a revolution.
    sets = [f"spindle_encoder.revolutions={count / 480.0}", "block_size=8", "window=512"]
    watch = Memories()
    with tempfile.TemporaryDirectory(prefix="lathe-soak-") as folder:
        scenario, bag = load(CONFIG / "piston.yaml", sets), Path(folder) / "bag"
        result = harness.run(scenario, mode="processes", bag=bag, watch=watch)
        found = check(bag)
    assert watch.early, "there was progress"
    growth = {node: watch.largest[node] - early for node, early in watch.early.items()}
    return {
        "blocks": result.blocks,
        "samples": result.samples,
        "wall_s": result.wall_s,
        "blocks_per_s": result.blocks / result.wall_s,
        "wrong_or_lost": found.wrong + found.lost,
        "memory_MB": {node: round(size / 1e6) for node, size in watch.largest.items()},
        "growth_MB": {node: round(size / 1e6, 1) for node, size in growth.items()},
        "failed": int(bool(found.wrong or found.lost) or any(size > _GROWTH for size in growth.values())),
    }


class At:
    """Does something to a node once a run has come to a sample.

    Args:
        moments: sample and node, in order.
        act: gets the process of the node.

    Attributes:
        seen: events of each kind.
        noticed: times from an act until the time master named somebody dead or silent [s].
        witnessed: times from an act until the harness saw a process end [s].
    """

    def __init__(self, moments: Sequence[tuple[int, str]], act: Callable[[int], None]) -> None:
        self._moments, self._act = list(moments), act
        self._pids: dict[str, int] = {}
        self._acted = self._hit = 0
        self.noticed: list[float] = []
        self.witnessed: list[float] = []
        self.seen: Counter[str] = Counter()

    def __call__(self, event: harness.Event) -> None:
        """Take an event."""
        self.seen[event["event"]] += 1
        if event["event"] == "active":
            self._pids[event["node"]] = event["pid"]
        if event["event"] in ("progress", "block0"):
            while self._moments and event.get("samples", 0) >= self._moments[0][0]:
                self._act(self._pids[self._moments.pop(0)[1]])
                self._acted = self._hit = time.monotonic_ns()
        if self._hit and event["event"] == "exit":
            self.witnessed.append((event["monotonic_ns"] - self._hit) * 1e-9)
            self._hit = 0
        if self._acted and event["event"] in ("dead", "stall"):
            self.noticed.append((event["monotonic_ns"] - self._acted) * 1e-9)
            self._acted = 0


def kill(scale: int, random: Random) -> Mapping[str, Any]:
    """See the module."""
    told: Counter[str] = Counter()
    failures: list[str] = []
    noticed: list[float] = []
    witnessed: list[float] = []
    with tempfile.TemporaryDirectory(prefix="lathe-soak-") as name:
        folder = Path(name)
        sets = ["spindle_encoder.revolutions=40.0", f"{OWN}.restart_file={folder}/state", "recorder.chunk_size=65536"]
        scenario = load(CONFIG / "supervised.yaml", sets)
        plain = harness.run(scenario)
        nodes = sorted({*scenario.nodes, "recorder"})
        for number in range(6 if scale == 1 else 100):
            node, sample = random.choice(nodes), random.randrange(plain.samples * 9 // 10)
            bag, watch = folder / f"bag{number}", At([(sample, node)], lambda pid: os.kill(pid, signal.SIGKILL))
            outcome = _killed(scenario, node, bag, watch, plain.digest)
            told[f"{node}: {outcome}"] += 1
            noticed += watch.noticed
            witnessed += watch.witnessed
            if outcome != {OWN: _SAME, "spindle_encoder": _ENDED}.get(node, _SAFE):
                failures.append(f"{node} at sample {sample}: {outcome}")
            after = "".join(f", noticed after {seconds * 1e3:.0f} ms" for seconds in watch.noticed)
            print(f"kill {number + 1}: {node} at sample {sample}: {outcome}{after}", flush=True)
    return {
        "outcomes": dict(sorted(told.items())),
        "noticed_after_ms": _times(noticed),
        "seen_by_the_harness_after_ms": _times(witnessed),
        "failures": failures,
        "failed": len(failures),
    }


def _times(seconds: Sequence[float]) -> dict[str, float]:
    found = {name: round(of(seconds) * 1e3, 1) for name, of in (("median", median), ("largest", max)) if seconds}
    return {**found, "later_than_they_should": sum(time > _SOON for time in seconds), "of": len(seconds)}


_SAFE, _SAME, _ENDED = "safe state, bag readable", "goes on, same digest", "ended, bag readable"


def _killed(scenario: Scenario, node: str, bag: Path, watch: At, digest: Mapping[str, str]) -> str:
    try:
        result = harness.run(scenario, mode="processes", bag=bag, watch=watch)
    except LatheError as error:
        if not str(error).startswith(f"{node} was killed by SIGKILL"):
            return f"not named: {error}"
    else:
        return _SAME if result.digest == digest else "goes on, other digest"
    try:
        found = check(bag)
    except LatheError as error:
        return f"bag not readable: {error}"
    if found.wrong:
        return f"bag wrong: {found.wrong[0]}"
    return _SAFE if watch.seen["safe"] else _ENDED


def stop(scale: int, random: Random) -> Mapping[str, Any]:
    """See the module."""
    count = 6 if scale == 1 else 100
    scenario = load(CONFIG / "supervised.yaml", [f"spindle_encoder.revolutions={10.0 * count}"])
    plain = harness.run(scenario)
    nodes = sorted({*scenario.nodes, "recorder"})
    moments = sorted((random.randrange(plain.samples), random.choice(nodes)) for _ in range(count))

    long = iter([(number + 1) % 20 == 0 for number in range(count)])

    def go_on(pid: int) -> None:
        # Stopped twice, it went on at the first of two signals, and may have ended.
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)

    def pause(pid: int) -> None:
        os.kill(pid, signal.SIGSTOP)
        threading.Timer(_AWAY if next(long) else random.random() * _STOPPED, go_on, (pid,)).start()

    watch = At(moments, pause)
    result = harness.run(scenario, mode="processes", watch=watch)
    return {
        "stops": count,
        "stalls_named": watch.seen["stall"],
        "samples": result.samples,
        "same_digest": result.digest == plain.digest,
        "failed": int(result.digest != plain.digest),
    }


def cells(scale: int, _random: Random) -> Mapping[str, Any]:
    """See the module."""
    scenarios = {
        "/left": load(CONFIG / "piston.yaml", ["spindle_encoder.revolutions=30.0"]),
        "/right": load(CONFIG / "supervised.yaml", ["spindle_encoder.revolutions=40.0", "seed=5"]),
    }
    plain = {name: harness.run(scenario).digest for name, scenario in scenarios.items()}
    count, failures = 1 if scale == 1 else 20, 0
    for _ in range(count):
        found: dict[str, dict[str, str]] = {}

        def run(name: str, found: dict[str, dict[str, str]], domain: int) -> None:
            result = harness.run(scenarios[name], mode="processes", domain=domain, namespace=name)
            found[name] = {topic.removeprefix(name): digest for topic, digest in result.digest.items()}

        with harness.free_domain() as domain:
            threads = [threading.Thread(target=run, args=(name, found, domain)) for name in scenarios]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        failures += found != plain
    return {"times": count, "failed": failures}


PARTS: Mapping[str, Callable[[int, Random], Mapping[str, Any]]] = {
    "blocks": blocks,
    "kill": kill,
    "stop": stop,
    "cells": cells,
}


def main() -> None:
    """Run some parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"default: {', '.join(PARTS)}")
    parser.add_argument("--long", action="store_true", help="10⁶ blocks, 100 kills, 100 stops; takes an hour or two")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the figures here")
    given = parser.parse_args()
    unknown = [name for name in given.parts if name not in PARTS]
    if unknown:
        parser.error(f"{', '.join(unknown)}; allowed: {', '.join(PARTS)}")
    told: dict[str, Mapping[str, Any]] = {}
    for name in given.parts or PARTS:
        start = time.monotonic()
        told[name] = PARTS[name](100 if given.long else 1, Random(given.seed))  # noqa: S311
        print(f"{name}: {json.dumps(told[name])}, {time.monotonic() - start:.0f} s", flush=True)
    if given.json:
        given.json.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    sys.exit(any(found["failed"] for found in told.values()))


if __name__ == "__main__":
    main()
