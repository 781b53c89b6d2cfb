# SPDX-License-Identifier: Apache-2.0
"""./lathe test: the linters, then the tests, all of them, whatever the others find.

--lint: the linters alone; --system: the tests that need packages or privileges of the machine, or more time than
others; --coverage: also which branches of lathe_rc the tests take; --table: no tests, but docs/tests.md from the report
of the last; --promises [WORD ...]: no tests, but what they promise, of all files or those with a word in their name.
"""

import contextlib
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version

import pytest
from coverage import Coverage

import slow_tests
import system
from workplace import REQUIREMENTS, ROOT

LINTERS = {
    "ruff check": ["ruff", "check", "--quiet"],
    "ruff format": ["ruff", "format", "--check", "--quiet"],
    "mypy": ["mypy", "--no-error-summary"],
    "spelling": ["codespell"],  # setup.cfg has its settings
    "prose": [sys.executable, str(ROOT / "tools" / "prose.py")],
    "imports": ["lint-imports", "--no-logo", "--no-cache"],
}
SITE = [sys.executable, str(ROOT / "tools" / "docs.py"), "--check"]
# What would be compiled in the middle of the tests, by several of them at once; the linters leave cores for it.
KERNELS = [sys.executable, str(ROOT / "tools" / "kernels.py")]
# Tests wait for processes now and then, so three files run at once on two cores; what a file's tests share is made
# once. Which files come first says tests/conftest.py.
BY_FILE = ["--dist=loadfile", "--no-loadscope-reorder"]
AT_ONCE = ["--numprocesses=3", *BY_FILE]
REPORTED = [f"--junitxml={slow_tests.REPORT}"]
LOCKED_NUMPY = re.compile(r"^numpy==(\S+) ; python_full_version >=", re.MULTILINE)


class Verdicts:
    """Repeats what failed before the tests, where it is seen: just above the summary of pytest.

    Args:
        lines: what to say there.
    """

    def __init__(self, lines: Sequence[str]) -> None:
        self._lines = lines

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Called by pytest when it has run the tests."""
        for line in self._lines:
            terminalreporter.write_line(line)


def lint(name: str, command: Sequence[str]) -> bool:
    """Run one linter, say how it went and what it found, and return whether that was nothing."""
    start = time.monotonic()
    ran = subprocess.run(command, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    passed = ran.returncode == 0
    print(f"{name:<12} {'passed' if passed else 'FAILED'} ({time.monotonic() - start:.1f} s)", flush=True)
    if not passed:
        print(ran.stdout, flush=True)
    return passed


@contextlib.contextmanager
def covered() -> Iterator[None]:
    """Measure which branches of lathe_rc all processes take meanwhile, and keep the figure for docs/tests.md."""
    shutil.rmtree(slow_tests.COVERAGE, ignore_errors=True)
    slow_tests.COVERAGE.mkdir()
    measure = Coverage(str(slow_tests.COVERAGE / "data"), config_file=str(ROOT / "pyproject.toml"))
    measure.start()
    try:
        yield
    finally:
        measure.stop()
        measure.save()
        measure.combine()
        measure.json_report(outfile=str(slow_tests.COVERAGE / slow_tests.FIGURES))
        print(slow_tests.coverage(), flush=True)


def locked_numpy() -> str:
    """Return the version of NumPy in the lock file, which is one from Python 3.11 on."""
    found = LOCKED_NUMPY.search((REQUIREMENTS / "python.lock").read_text(encoding="utf-8"))
    if found is None:
        raise LookupError("requirements/python.lock has no NumPy for Python 3.11 and later")
    return found[1]


def main(arguments: list[str]) -> int:
    """Run everything on the whole checkout, or what an option names, and return the exit code."""
    os.chdir(ROOT)
    if "--system" in arguments:
        arguments.remove("--system")
        if against := system.provide():
            print(f"lathe: {against}", file=sys.stderr)
            return 1
        return int(pytest.main(["-m", "system", "--numprocesses=2", *BY_FILE, "tests", *arguments]))
    if "--table" in arguments:
        return slow_tests.main()
    if "--promises" in arguments:
        return slow_tests.promises([word for word in arguments if word != "--promises"])
    if measure := "--coverage" in arguments:
        arguments.remove("--coverage")
    linters, verdicts = dict(LINTERS), list[str]()
    if (here := version("numpy")) != (locked := locked_numpy()):
        del linters["mypy"]
        verdicts.append(f"not run: mypy, because its verdict is for the types of NumPy {locked}, not {here}")
    with ThreadPoolExecutor(2) as pool:
        beside = {"docs": pool.submit(lint, "docs", SITE)}
        if not arguments:
            beside["kernels"] = pool.submit(lint, "kernels", KERNELS)
        failed = [name for name, command in linters.items() if not lint(name, command)]
    failed += [name for name, passed in beside.items() if not passed.result()]
    if "--lint" in arguments:
        print(*verdicts, sep="\n", end="\n" if verdicts else "")
        return int(bool(failed))
    verdicts += [f"{name} FAILED: see above" for name in failed]
    verdicts.append(
        "not run: the tests that need packages or privileges of the machine, or more time (./lathe test --system)"
    )
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # rewriting the tests takes each worker 3 s: pytest keeps them
    with covered() if measure else contextlib.nullcontext():
        code = pytest.main(["-m", "not system", *AT_ONCE, *REPORTED, *arguments], plugins=[Verdicts(verdicts)])
    return int(code) or int(bool(failed))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
