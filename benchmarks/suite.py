# SPDX-License-Identifier: Apache-2.0
"""Running the parts, storing what they found, comparing two commits."""

import importlib
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

PARTS = (
    "engine",
    "batch",
    "sweep",
    "ros",
    "real_time",
    "supervisor",
    "recorder",
    "viewer",
    "resimulation",
    "start",
    "growth",
    "peers",
)
QUICK = tuple(part for part in PARTS if part != "real_time")  #: which takes minutes by its nature
ROOT = Path(__file__).resolve().parents[1]
STORE = ROOT / ".lathe" / "bench"

Say = Callable[[str], None]


def _git(*arguments: str) -> str:
    found = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    return found.stdout.strip()


def commit() -> str:
    """The commit that is measured; with -changed if the files are not those of the commit."""
    name = _git("rev-parse", "--short=12", "HEAD") or "unknown"
    return name + ("-changed" if _git("status", "--porcelain", "--untracked-files=no") else "")


def machine() -> dict[str, Any]:
    """What the figures belong to."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines() if Path("/proc/cpuinfo").exists() else []
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def run(parts: Iterable[str], *, quick: bool, say: Say) -> dict[str, Any]:
    """Measure some parts, one after the other."""
    result: dict[str, Any] = {"commit": commit(), "quick": quick, "machine": machine()}
    for part in parts:
        say(part)
        start = time.monotonic()
        result[part] = importlib.import_module(f"benchmarks.{part}").measure(quick=quick, say=say)
        result[part]["took_s"] = round(time.monotonic() - start, 1)
    return result


def store(result: Mapping[str, Any]) -> Path:
    """Keep a result under its commit; parts measured before at the same commit stay.

    A ``note`` that is written into the file by hand stays too, and stands on the page.
    """
    path = STORE / f"{result['commit']}{'-quick' if result['quick'] else ''}.json"
    before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    STORE.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**before, **result}, indent=1) + "\n", encoding="utf-8")
    return path


def figures(result: Mapping[str, Any], name: str = "") -> dict[str, float]:
    """All numbers of a result by their dotted names; of a spread its median."""
    found: dict[str, float] = {}
    for key, value in result.items():
        path = f"{name}.{key}" if name else key
        if isinstance(value, Mapping):
            if "median" in value:
                found[path] = float(value["median"])
            else:
                found.update(figures(value, path))
        elif isinstance(value, int | float) and not isinstance(value, bool) and key != "took_s":
            found[path] = float(value)
    return found
