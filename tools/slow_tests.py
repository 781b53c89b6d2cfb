# SPDX-License-Identifier: Apache-2.0
"""./lathe test --table: docs/tests.md, the promise and the cost of each slow test; --promises: the promises of all.

Times and processes are those of the last ./lathe test, the promises those that stand at the tests: a docstring's first
line, or else the test's name.
"""

import ast
import json
import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

from workplace import HOME, ROOT, RefusalError, say

REPORT = HOME / "test-report.xml"  #: of the last ./lathe test, as JUnit has it
COVERAGE = HOME / "coverage"  #: of the last ./lathe test --coverage
FIGURES = "figures.json"  #: in that folder
PAGE = ROOT / "docs" / "tests.md"
TESTS = ROOT / "tests"
SLOWEST = 60  #: tests in the table

_FILE = re.compile(r"^\| \*\*(test_\w+)\*\* \| ([\d.]+) % \|", re.MULTILINE)
_ROW = re.compile(r"^\| (?:(\w+)\.)?`(test_\w+)` \| [\d.]+ % \| \d+ \| [\w, ]*\| (.*) \|$", re.MULTILINE)
_COVERAGE = (
    "Coverage: {:.1f} % of {} statements and {} branches of lathe_rc, child processes counted, compiled kernels not."
)
_ONE = {"processes": "process", "programs": "program"}
_UNKNOWN = "Coverage: not measured; `./lathe test --coverage` does it."
_HEAD = """\
# The slow tests

Which promise each of the {slowest} slowest tests of `./lathe test` holds, and its share of the time of all {tests}
tests ({seconds:.0f} s, one after the other). `./lathe test && ./lathe test --table` writes this page anew. Machines
differ, so it is the share that counts. The cases of a test are added up; what several tests share counts for the first
of them. A promise is the first line of the test's docstring, or else its name: change it there.
tests/repository/test_slow_tests.py checks that the page says what the tests say. `./lathe test` starts with the files
that take longest. The table has the number of processes of cells and of programs that a test starts: {functions} tests,
in {cases} cases, start processes of cells, and {programs} others programs.

{coverage}

| test | share | cases | starts | promise |
| --- | --- | --- | --- | --- |
"""


class Name(NamedTuple):
    """A test without its parameters.

    Attributes:
        file: stem of its file.
        owner: its class, or nothing.
        test: its function.
    """

    file: str
    owner: str
    test: str


class Cost(NamedTuple):
    """The cost of a test: seconds, cases, cases with a cell, and the processes of cells and programs of all cases."""

    seconds: float = 0.0
    cases: int = 0
    with_cell: int = 0
    processes: int = 0
    programs: int = 0

    @property
    def starts(self) -> str:
        """The processes and programs that a test starts, in words."""
        counted = {"processes": self.processes, "programs": self.programs}
        return ", ".join(f"{number} {kind if number > 1 else _ONE[kind]}" for kind, number in counted.items() if number)


Function = ast.FunctionDef | ast.AsyncFunctionDef


# ---- what the tests say


def in_words(name: Name) -> str:
    """Return a test's name as a sentence."""
    said = name.test.removeprefix("test_").replace("_s_", "'s_").replace("_", " ")
    owner = re.sub(r"(?<!^)(?=[A-Z])", " ", name.owner.removeprefix("Test")).lower()
    return f"{owner}: {said}" if owner else said


def _defined(tree: ast.Module) -> Iterator[tuple[str, Function]]:
    """Yield class or nothing, and function, of all tests of a module and its classes."""
    for outer in tree.body:
        owner, body = (outer.name, outer.body) if isinstance(outer, ast.ClassDef) else ("", [outer])
        for node in body:
            if isinstance(node, Function) and node.name.startswith("test_"):
                yield owner, node


def _promise(name: Name, test: Function) -> str:
    """Return the first line of a test's docstring, or else its name as a sentence."""
    return (ast.get_docstring(test) or in_words(name)).splitlines()[0]


def _promises(path: Path) -> dict[Name, str]:
    """Return the promises of the tests of a file."""
    found = {}
    for owner, node in _defined(ast.parse(path.read_text(encoding="utf-8"))):
        name = Name(path.stem, owner, node.name)
        found[name] = _promise(name, node)
    return found


def told() -> dict[Name, str]:
    """Return the promises of all tests, those of tests/system apart."""
    return {name: promise for path in _files() for name, promise in _promises(path).items()}


def _files() -> list[Path]:
    return [path for path in sorted(TESTS.rglob("test_*.py")) if path.parent.name != "system"]


def promises(words: Sequence[str]) -> int:
    """Print the promises of the tests in the files with one of some words in their name, or of all.

    Args:
        words: none for all files, tests/system included.
    """
    for path in sorted(TESTS.rglob("test_*.py")):
        if words and not any(word in path.stem for word in words):
            continue
        print(path.relative_to(TESTS).as_posix())
        for name, promise in _promises(path).items():
            print(f"  {name.owner}{'::' * bool(name.owner)}{name.test}: {promise}")
    return 0


# ---- what they took


def took(report: Path) -> dict[Name, Cost]:
    """Return what each test took, all of its cases together.

    Raises:
        RefusalError: no report, or not one of all tests.
    """
    if not report.exists():
        raise RefusalError("no report of a run is here; run ./lathe test first")
    found: dict[Name, Cost] = defaultdict(Cost)
    files = set[str]()
    for case in ET.parse(report).getroot().iter("testcase"):  # noqa: S314 - pytest wrote it here
        place = (case.get("classname") or case.get("name") or "").split(".")
        file, *owners = place[next(k for k, word in enumerate(place) if word.startswith("test_")) :]
        owner = ".".join(owners)
        files.add(file)
        name = Name(file, owner, case.get("name", "").partition("[")[0])
        counts = {each.get("name"): int(each.get("value", 0)) for each in case.iter("property")}
        processes, programs = counts.get("processes", 0), counts.get("programs", 0)
        before = found[name]
        found[name] = Cost(
            before.seconds + float(case.get("time", 0.0)),
            before.cases + 1,
            before.with_cell + int(processes > 0),
            before.processes + processes,
            before.programs + programs,
        )
    here = {path.stem for path in _files()}
    if missing := sorted(here - files):
        raise RefusalError(
            f"the last ./lathe test ran {len(here) - len(missing)} of {len(here)} files of tests "
            f"({missing[0]} is missing); run it without arguments first"
        )
    return dict(found)


def shares() -> dict[str, float]:
    """Return the share of the time [%] of each file in the page."""
    page = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    return {file: float(share) for file, share in _FILE.findall(page)}


def coverage() -> str:
    """Return what the last ./lathe test --coverage found, in a sentence; what the page says if there was none here."""
    if (COVERAGE / FIGURES).exists():
        total = json.loads((COVERAGE / FIGURES).read_text(encoding="utf-8"))["totals"]
        return _COVERAGE.format(total["percent_covered"], total["num_statements"], total["num_branches"])
    page = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    return next((line for line in page.splitlines() if line.startswith("Coverage: ")), _UNKNOWN)


# ---- the page


def written(costs: Mapping[Name, Cost], said: Mapping[Name, str]) -> str:
    """Return the page: the slowest tests by file, whatever takes longest first."""
    whole = sum(cost.seconds for cost in costs.values())
    files: dict[str, float] = defaultdict(float)
    for name, cost in costs.items():
        files[name.file] += cost.seconds
    known = sorted((name for name in costs if name in said), key=lambda name: -costs[name].seconds)[:SLOWEST]
    lines = []
    for file in sorted({name.file for name in known}, key=lambda file: -files[file]):
        lines.append(f"| **{file}** | {100 * files[file] / whole:.1f} % | | | |")
        for name in known:
            if name.file == file:
                owner, cost = name.owner and f"{name.owner}.", costs[name]
                share, promise = 100 * cost.seconds / whole, said[name].replace("|", r"\|")
                lines.append(f"| {owner}`{name.test}` | {share:.1f} % | {cost.cases} | {cost.starts} | {promise} |")
    head = _HEAD.format(
        slowest=len(known),
        tests=sum(cost.cases for cost in costs.values()),
        seconds=whole,
        functions=sum(cost.with_cell > 0 for cost in costs.values()),
        cases=sum(cost.with_cell for cost in costs.values()),
        programs=sum(cost.programs > 0 and not cost.with_cell for cost in costs.values()),
        coverage=coverage(),
    )
    return head + "\n".join(lines) + "\n"


def wrong(page: str, said: Mapping[Name, str]) -> list[str]:
    """Return what a page says otherwise than the tests."""
    found, file = [], ""
    for line in page.splitlines():
        if begun := _FILE.match(line):
            file = begun[1]
        if row := _ROW.match(line):
            name, promise = Name(file, row[1] or "", row[2]), row[3].replace(r"\|", "|")
            if name not in said:
                found.append(f"no test {row[2]} in {file}.py")
            elif promise != said[name]:
                found.append(f"{row[2]} says: {said[name]}")
    return found


def main() -> int:
    """Write the page."""
    try:
        page = written(took(REPORT), told())
    except RefusalError as error:
        print(f"lathe: {error}", file=sys.stderr)
        return 2
    PAGE.write_text(page, encoding="utf-8")
    say(f"{PAGE.relative_to(ROOT)} written")
    return 0
