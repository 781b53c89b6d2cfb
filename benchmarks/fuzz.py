# SPDX-License-Identifier: Apache-2.0
"""Fuzzing of every reader of files from outside, for long: python benchmarks/fuzz.py [READER ...] [--seconds 3600].

The readers and the damage done to valid files are those of tests/support/fuzz_targets.py. With Atheris
(requirements/bench.in) coverage leads the search, without it damage is random. Each reader runs in a process of its
own, which may take 1 GiB more than it begins with and 10 s of CPU time for an input. Inputs that lead to new code, and
finds, stay in .lathe/fuzz/READER: ``python benchmarks/fuzz.py --input FILE READER`` reads one of them and shows what
comes of it.
"""

import argparse
import importlib
import os
import resource
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from random import Random
from types import ModuleType
from typing import Any

ROOT = Path(__file__).parents[1]
HOME = ROOT / ".lathe" / "fuzz"
MEMORY = 2**30  # [B] beyond what the process begins with
LONGEST = 10.0  # [s] of CPU time for an input
_LOOK = 0.5  # [s] between looks at what the process reads
_WAITING = 600.0  # [s] without a new input, after which the process is ended
_FOLLOWED = ("lathe_rc", "mcap", "rosbags", "ruamel", "yaml")


def _compiled() -> list[str]:
    """Modules with kernels, in which Numba would find the calls that count coverage."""
    found = [path for path in (ROOT / "lathe_rc").rglob("*.py") if "lathe_rc.jit" in path.read_text(encoding="utf-8")]
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in found]


def _atheris() -> ModuleType | None:
    """Atheris, of this environment or of the one beside it."""
    sys.path += map(str, (ROOT / ".lathe" / "peers").glob("lib/python*/site-packages"))
    try:
        return importlib.import_module("atheris")
    except ImportError:
        return None


def _targets(atheris: ModuleType | None) -> Any:
    sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT)]
    if atheris is None:
        return importlib.import_module("fuzz_targets")
    with atheris.instrument_imports(include=_FOLLOWED, exclude=_compiled()):
        return importlib.import_module("fuzz_targets")


def _bound_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5])
    most = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))


class Watched:
    """A reader whose finds are kept, each kind once.

    Args:
        name: of the reader.
        read: takes an input.
        folder: where finds go.
    """

    def __init__(self, name: str, read: Callable[[bytes], None], folder: Path) -> None:
        self._name, self._read, self._folder = name, read, folder
        self._last = folder / "last"
        self._told: set[str] = set()
        self._count = 0

    def __call__(self, data: bytes) -> None:
        """Read an input."""
        self._last.write_bytes(data)
        self._count += 1
        start = time.process_time()  # other work on the machine does not count
        try:
            self._read(data)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is a find
            places = traceback.extract_tb(error.__traceback__)
            own = [place for place in places if "/lathe_rc/" in place.filename or "rosbags" in place.filename] or places
            self._keep(data, f"{type(error).__name__}-{Path(own[-1].filename).stem}-{own[-1].lineno}", repr(error))
        seconds = time.process_time() - start
        if seconds > LONGEST:
            self._keep(data, "slow", f"{seconds:.1f} s")
        (self._folder / "count").write_text(str(self._count), encoding="ascii")

    def _keep(self, data: bytes, kind: str, what: str) -> None:
        if kind not in self._told:
            self._told.add(kind)
            say_find(self._name, self._folder, kind, what, data)


def say_find(name: str, folder: Path, kind: str, what: str, data: bytes) -> None:
    """Keep an input that led to a find, and say how to see it again."""
    path = folder / f"find-{kind}-{sha256(data).hexdigest()[:8]}"
    path.write_bytes(data)
    print(f"FOUND {name}: {kind}: {what[:200]}\n  python benchmarks/fuzz.py --input {path} {name}", flush=True)


def work(name: str, seconds: float, seed: int) -> None:
    """What the process of a reader does."""
    atheris = _atheris()
    target = _targets(atheris).TARGETS[name]
    folder = HOME / name
    (folder / "corpus").mkdir(parents=True, exist_ok=True)
    for data in target.seeds():  # compiled and imported ahead of the bounds
        target.read(data)
        (folder / "corpus" / sha256(data).hexdigest()[:16]).write_bytes(data)
    _bound_memory()
    watched = Watched(name, target.read, folder)
    if atheris is not None:
        module = sys.modules["fuzz_mutate"]

        def mutator(data: bytes, longest: int, number: int) -> bytes:
            random = Random(number)  # noqa: S311
            if random.randrange(8) == 0:
                return bytes(atheris.Mutate(data, longest))
            return bytes(module.damaged(data, random, target.ways, 3)[:longest])

        options = [f"-max_total_time={int(seconds)}", "-timeout=1000000", "-rss_limit_mb=0", "-max_len=1000000"]
        options += [f"-seed={seed}", "-verbosity=0", f"-artifact_prefix={folder}/", "-len_control=0"]
        atheris.Setup(["fuzz", *options, str(folder / "corpus")], watched, custom_mutator=mutator)
        atheris.Fuzz()
        return
    random, end = Random(seed), time.monotonic() + seconds  # noqa: S311
    while time.monotonic() < end:
        watched(target.damaged(random))


def run(name: str, seconds: float, seed: int) -> tuple[int, int]:
    """Fuzz a reader; returns executions and finds. A process that dies or hangs is a find, and another one goes on."""
    folder = HOME / name
    folder.mkdir(parents=True, exist_ok=True)
    scratch = folder / "scratch"
    scratch.mkdir(exist_ok=True)
    executions, end = 0, time.monotonic() + seconds
    before = {path.name for path in folder.glob("find-*")}
    while (left := end - time.monotonic()) > 1.0:
        (folder / "count").write_text("0", encoding="ascii")
        (folder / "last").unlink(missing_ok=True)
        command = [sys.executable, __file__, "--work", name, "--seconds", str(left), "--seed", str(seed + executions)]
        environment = {**os.environ, "TMPDIR": str(scratch), "OMP_NUM_THREADS": "1"}
        with (folder / "log").open("ab") as log, subprocess.Popen(command, stderr=log, env=environment) as process:
            stuck = _watch(process, folder)
        executions += int((folder / "count").read_text(encoding="ascii") or 0)
        if stuck or process.returncode:
            kind = "stuck" if stuck else f"died-{process.returncode}"
            last = folder / "last"
            say_find(name, folder, kind, f"see {folder}/log", last.read_bytes() if last.exists() else b"")
            if time.monotonic() - end + left < LONGEST:
                break  # it does not even begin
    return executions, len({path.name for path in folder.glob("find-*")} - before)


def _used(process: subprocess.Popen[bytes]) -> float:
    """CPU time that a process has had [s]."""
    fields = Path(f"/proc/{process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _watch(process: subprocess.Popen[bytes], folder: Path) -> bool:
    """Wait for a reader's process; whether it had to be ended, since it works on an input, or waits, for too long."""
    last, newest, since, used = folder / "last", 0.0, time.monotonic(), 0.0
    while process.poll() is None:
        changed = last.stat().st_mtime if last.exists() else 0.0
        if changed != newest:
            newest, since, used = changed, time.monotonic(), _used(process)
        if newest and (_used(process) - used > 3.0 * LONGEST or time.monotonic() - since > _WAITING):
            process.kill()
            return True
        time.sleep(_LOOK)
    return False


def main() -> None:
    """Fuzz some readers one after the other, or read one input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*", metavar="READER", help="default: all, one after the other")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--input", type=Path, help="read this file, and nothing else")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        work(given.work, given.seconds, given.seed)
        return
    targets = _targets(None).TARGETS
    unknown = [name for name in given.readers if name not in targets]
    if unknown or (given.input and len(given.readers) != 1):
        parser.error(f"{', '.join(unknown) or '--input'}; allowed: {', '.join(targets)}, with --input one of them")
    if given.input:
        targets[given.readers[0]].read(given.input.read_bytes())
        print("read, or refused in a line")
        return
    found = 0
    for name in given.readers or targets:
        start = time.monotonic()
        executions, finds = run(name, given.seconds, given.seed)
        found += finds
        print(f"{name:12} {executions:8d} executions {time.monotonic() - start:6.0f} s {finds:3d} finds", flush=True)
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
