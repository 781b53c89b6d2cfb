# SPDX-License-Identifier: Apache-2.0
"""The time from ``lathe run`` to the first block is split into parts.

``lathe run piston`` is started anew each time, in each mode. All figures are wall time from the start of the command:

- ``to_checked_s``: its modules are imported and the scenario is accepted;
- ``to_active_s``, ``to_ready_s``: the last node is active, and is matched with its peers (not offline);
- ``to_first_block_s``: every member has computed the first block;
- ``to_end_s``: the command has ended after one revolution.

``import_..._s`` is the time of a Python process that only imports. Starts with an empty NUMBA_CACHE_DIR and once more
show the compiling: ``compiled_on_second_start``, the new or changed files of the cache, must be 0.

python -m benchmarks.start ARGUMENTS runs ``lathe ARGUMENTS`` and reports these moments.
"""

import importlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

from benchmarks import sides

ROOT = Path(__file__).resolve().parents[1]
_MODES, _QUICK_MODES = ("offline", "composed", "processes"), ("offline", "composed")
_MOMENTS = {"checked": "to_checked_s", "active": "to_active_s", "ready": "to_ready_s", "progress": "to_first_block_s"}
_IMPORTS = {"import_nothing_s": "pass", "import_cli_s": "lathe_rc.cli", "import_nodes_s": "lathe_rc.nodes.container"}
_ROUNDS = 3
_MARK = "moment"


def _environment(**values: str) -> dict[str, str]:
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), **values}


def moments(mode: str, **environment: str) -> dict[str, float]:
    """Start the command; wall time to each moment [s]."""
    command = [sys.executable, "-m", "benchmarks.start", "run", "piston", "--revolutions", "1", "--mode", mode]
    start = time.monotonic()
    told = subprocess.run(command, env=_environment(**environment), capture_output=True, text=True, check=True).stderr
    found = {"to_end_s": time.monotonic() - start}
    for line in told.splitlines():
        if line.startswith(f"{_MARK} "):
            _, kind, moment = line.split()
            name = _MOMENTS[kind]
            if kind != "progress" or name not in found:
                found[name] = float(moment) - start
    return found


def imports(module: str) -> float:
    """Wall time of a Python that imports a module [s]."""
    code = module if module == "pass" else f"import {module}"
    return sides.seconds(lambda: subprocess.run([sys.executable, "-c", code], env=_environment(), check=True))


def _files(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def compiled() -> dict[str, float]:
    """Two starts with a cache that is empty before the first."""
    with tempfile.TemporaryDirectory(prefix="lathe-bench-") as folder:
        cold = moments("composed", NUMBA_CACHE_DIR=folder)
        first = _files(Path(folder))
        warm = moments("composed", NUMBA_CACHE_DIR=folder)
        second = _files(Path(folder))
    return {
        "empty_cache_to_first_block_s": cold["to_first_block_s"],
        "warm_cache_to_first_block_s": warm["to_first_block_s"],
        "files_in_cache": len(first),
        "compiled_on_second_start": len(dict(second.items() - first.items())),
    }


def measure(*, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """All of it, two minutes; quick: offline and composed once, nothing compiled."""
    rounds, modes = (1, _QUICK_MODES) if quick else (_ROUNDS, _MODES)
    found: dict[str, Any] = {}
    starts: dict[str, list[dict[str, float]]] = {mode: [] for mode in modes}
    for _ in range(rounds):
        for mode in modes:
            starts[mode].append(moments(mode))
            say(f"  {mode}: first block after {starts[mode][-1]['to_first_block_s']:.2f} s")
    for mode, runs in starts.items():
        found[mode] = {name: sides.spread([run[name] for run in runs]) for name in runs[0]}
    if not quick:
        taken = sides.alternate({name: partial(imports, module) for name, module in _IMPORTS.items()}, rounds)
        found["imports"] = {name: sides.spread(seconds) for name, seconds in taken.items()}
        say("  with an empty cache of compiled code")
        found["cache"] = compiled()
    return found


def _told(harness: ModuleType) -> None:
    """Have the runs of `lathe_rc.harness` tell of the moments."""
    ordinary = harness.run

    def run(*arguments: Any, watch: Callable[[Mapping[str, Any]], None], **rest: Any) -> object:
        def told(event: Mapping[str, Any]) -> None:
            if event["event"] in _MOMENTS:
                moment = event.get("monotonic_ns", time.monotonic_ns()) * 1e-9
                print(_MARK, event["event"], f"{moment:.6f}", file=sys.stderr, flush=True)
            watch(event)

        return ordinary(*arguments, watch=told, **rest)

    setattr(harness, "run", run)  # noqa: B010 - mypy would not have it assigned


def main() -> None:
    """The command line, telling of what its runs go through; it imports what ``lathe`` does, and when it does."""
    from lathe_rc import cli, process_launcher

    ordinary = process_launcher.ForkServer.preload

    def preload(server: process_launcher.ForkServer, nodes: Mapping[str, Any]) -> None:
        ordinary(server, nodes)
        if not nodes:
            _told(importlib.import_module("lathe_rc.harness"))

    if "offline" in sys.argv:
        _told(importlib.import_module("lathe_rc.harness"))
    setattr(process_launcher.ForkServer, "preload", preload)  # noqa: B010 - mypy would not have it assigned
    cli.main()


if __name__ == "__main__":
    main()
