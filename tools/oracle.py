# SPDX-License-Identifier: Apache-2.0
"""Compare the behaviour of this checkout with that of another commit, command by command.

    ./lathe python tools/oracle.py COMMIT            everything that runs offline: some 5 min on two cores
    ./lathe python tools/oracle.py COMMIT --hosts    also every scenario composed and as processes: some 10 min more
    ./lathe python tools/oracle.py COMMIT --only WORD  cases whose name holds the word

Each case is a command of the command line. Both trees run it in a folder of their own; exit code, output and the files
that it wrote have to be equal, apart from clocks, paths and paces. What differs is printed as a diff, exit code 1: a
redesign shows none, a change of behaviour shows its own and no other. This checkout also reads, checks and simulates
again the bags of the other commit.
"""

import argparse
import difflib
import hashlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from lathe_rc.catalogue import COMMANDS
from workplace import ROOT

SCENARIOS = sorted(path.stem for path in (ROOT / "config").glob("*.yaml"))
#: figures that differ from run to run
_CLOCKS = [
    (re.compile(r'"(wall_s|real_time_factor|lateness_s)": [^,}]*'), r'"\1": T'),
    (re.compile(r"in [\d.]+ s: [\d.]+x real time"), "in T s"),
    (re.compile(r"\b\d{10}\.\d{9}\b|\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d\S*"), "T"),
    (re.compile(r"compiling .*"), ""),
]


class Case(NamedTuple):
    """A command, by a name that also names its folder; cases of one group share the folder and run in their order."""

    group: str
    words: Sequence[str]
    files: Sequence[str] = ()  #: that it writes, and that are compared by their hashes

    @property
    def name(self) -> str:
        """Group and command line."""
        return f"{self.group}: lathe {' '.join(self.words)}"


def cases(*, hosts: bool) -> Iterator[Case]:
    """All cases; a bag that a case reads was recorded by an earlier one of its group."""
    for name in SCENARIOS:
        yield Case(name, ["run", name, "--revolutions", "25", "--bag", "B", "--json"], ["B/digests.json"])
        yield Case(name, ["bag", "check", "B"])
        yield Case(name, ["bag", "info", "B"])
        if hosts:
            for mode in ("composed", "processes"):
                yield Case(
                    name,
                    ["run", name, "--mode", mode, "--revolutions", "4", "--bag", mode, "--json"],
                    [f"{mode}/digests.json"],
                )
    for name in ("piston", "two_channel", "full_cell", "robust_cutting", "supervised_turning"):
        yield Case(name, ["resim", "B", "--json", "-o", "R"], ["R/digests.json"])
        yield Case(name, ["measure", "B", "--json", "--profile", "p.csv"], ["p.csv"])
        yield Case(name, ["report", "B", "-o", "report.html"])
    yield Case("piston", ["resim", "B", "--set", "learning_controller.q_time=200e-6"])
    yield Case("piston", ["resim", "B", "--identify"])
    yield Case("piston", ["export", "B", "--csv"], ["B-csv/tool.csv"])
    yield Case("piston", ["export", "B", "--parquet", "--topics", "/tool"])
    yield Case("piston", ["bag", "tachogram", "B", "--json"], ["B-tachogram.csv"])
    yield Case("piston", ["bag", "recover", "B", "whole"])
    yield Case("piston", ["policy", "piston"])
    yield Case("budget", ["budget", "piston", "--revolutions", "12", "--json"])
    yield Case("sweep", ["sweep", "piston", "--vary", "learning_controller.q_time=60e-6:200e-6:6", "--out", "S"])
    yield Case("sweep", ["sweep", "show", "S", "--json"])
    tuning = ["--free", "learning_controller.lead_time=1e-3:2e-3", "--goal", "tool.max_error", "--trials", "6"]
    yield Case("tune", ["tune", "piston", *tuning, "--out", "T"], ["T/best.yaml"])
    for name in ("invariance", "angle-domain", "drive-models", "sampled-servo", "decoupling", "coupling", "piston"):
        yield Case("study", ["study", name, "--json"])
    for kind in ("law", "plant", "stage", "study"):
        yield Case(f"new {kind}", ["new", kind, "mine"])
    for words in (["--help"], ["reference"], ["node", "--list"], *([command, "--help"] for command in COMMANDS)):
        yield Case("help", words)
    for change in REFUSED:
        yield Case("refusals", ["run", "piston", *(word for pair in change for word in ("--set", pair))])
    for words in ([name] for name in ("run", "bag check", "resim", "report", "measure", "export --csv", "view")):
        yield Case("refusals", [*words[0].split(), "missing"])


REFUSED = (
    ["learning_controller.lead_time=2.2e-3"],
    ["learning_controller.q_time=0.0"],
    ["learning_controller.q_tim=0.0"],
    ["learning_controler.q_time=0.0"],
    ["nominal_rpm=3000.0"],
    ["nominal_rpm=-1"],
    ["block_size=4096"],
    ["block_size=x"],
    ["electrodynamic_actuator.stroke=100e-6"],
    ["tool.profile=none"],
    ["tool.profile=csv"],
    ["tool.profile=csv", "tool.profile_file=missing.csv"],
    ["tool.stage=none"],
    ["tool.stage=nowhere:Tool"],
    ["spindle_encoder.counts_per_revolution=1"],
    ["spindle_encoder.deviation_amplitude=[0.1]"],
    ["learning_controller.lead_law=none"],
    ["learning_controller.memory_file=missing"],
    ["recorder.topics=[/none]"],
    ["=3"],
)


def run(tree: Path, case: Case, folder: Path) -> list[str]:
    """Run a case with the code of a tree: the lines that have to be equal."""
    folder.mkdir(parents=True, exist_ok=True)
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])}
    environ |= {"COLUMNS": "100", "PYTHONDONTWRITEBYTECODE": "1"}
    program = [sys.executable, "-m", "lathe_rc", *case.words]
    done = subprocess.run(program, cwd=folder, env=environ, capture_output=True, text=True, timeout=600, check=False)
    hashes = [
        f"{name} {hashlib.sha256(place.read_bytes()).hexdigest() if (place := folder / name).exists() else 'missing'}"
        for name in case.files
    ]
    text = f"exit {done.returncode}\n{done.stdout}{done.stderr}".replace(str(folder), "~").replace(str(tree), "TREE")
    for pattern, shown in _CLOCKS:
        text = pattern.sub(shown, text)
    return [*text.splitlines(), *hashes]


def differences(base: Path, work: Path, asked: Sequence[Case]) -> Iterator[tuple[Case, list[str]]]:
    """Run each group of cases with both trees, two at a time: the cases that differ, with a diff."""
    groups: dict[str, list[Case]] = {}
    for case in asked:
        groups.setdefault(case.group, []).append(case)

    def compare(group: str) -> list[tuple[Case, list[str]]]:
        found = []
        for case in groups[group]:
            before = run(base, case, work / "before" / group)
            here = run(ROOT, case, work / "here" / group)
            found.append((case, list(difflib.unified_diff(before, here, "before", "here", lineterm="", n=1))))
        if (bag := work / "before" / group / "B").exists():
            for words in (["bag", "check", str(bag)], ["resim", str(bag)]):
                case = Case(f"{group}, the bag of the other commit", words)
                here = run(ROOT, case, work / "here" / group)
                found.append((case, [] if here[0] == "exit 0" else here))
        return found

    with ThreadPoolExecutor(2) as pool:
        for found in pool.map(compare, groups):
            yield from found


def main() -> int:
    """Compare, and print what differs."""
    assert __doc__
    asked = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    asked.add_argument("commit")
    asked.add_argument("--hosts", action="store_true", help="also every scenario composed and as processes")
    asked.add_argument("--only", default="", help="cases whose group holds this word")
    options = asked.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        base = Path(temporary) / "tree"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", base, options.commit], cwd=ROOT, check=True)
        try:
            chosen = [case for case in cases(hosts=options.hosts) if options.only in case.group]
            count = wrong = 0
            for case, diff in differences(base, Path(temporary) / "work", chosen):
                count += 1
                wrong += bool(diff)
                if diff:
                    print(f"{case.name}\n  " + "\n  ".join(diff[:40]), flush=True)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", base], cwd=ROOT, check=True)
    print(f"{count} cases, {wrong} differ")
    return wrong > 0


if __name__ == "__main__":
    sys.exit(main())
