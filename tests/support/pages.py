# SPDX-License-Identifier: Apache-2.0
"""Blocks of the pages, and a reader that runs them in order and compares their output with the page.

    ```python                   the examples of a page are one program, in the order of the page
    ```text                     right behind one of them: what it prints
    ```console                  commands behind "$ ", each followed by what it shows, if the page shows that
    ```text                     behind a console block: what its last command prints, if the block does not show that
    ```console title="…"        one command for a terminal of its own: it goes on beside the next commands
    ```python title="FILE"      a file that the reader saves; so is any other language with a title

All other blocks are read, not run. Figures of the machine, such as times, are never compared, and numbers with a
fraction may differ by one in their last digit (`different`).
"""

import contextlib
import io
import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
from click.testing import CliRunner

from lathe_rc.cli import main

ROOT = Path(__file__).parents[2]
TIMEOUT = 120  #: [s] for what should have ended

_FENCE = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: lines that come or not, depending on the load of the machine
_NOW_AND_THEN = re.compile(
    r"^(revolution \d+: error |compiling |\[\w+\] \[[\d.]+\] \[\w+\]: wait|.* silent |.* refuses: )"
)
#: figures of the machine
_MACHINE = re.compile(
    r"in [\d.]+ s: [\d.]+x real time|(?<=^\[INFO\] )\[[\d.]+\]|(?<=Dask's dashboard: ).*|[0-9a-f]{64}|\d+ messages(?=,)"
)
_NUMBER = re.compile(r"(\d+(?:\.\d+)?(?:e[-+]?\d+)?)")
_NODES = {"node", "container", "replay", "record"}  # commands that are processes of a cell
_SHELL = re.compile(r"[|&;<>*$`]|^\w+=")  # needs a shell, outside of quotes
_QUOTED = re.compile(r"'[^']*'|\"[^\"$`]*\"")


class Block(NamedTuple):
    """A block of a page: its language, title, text and number of its first line."""

    language: str
    title: str
    text: str
    line: int


class Command(NamedTuple):
    """A command line, and the lines that the page shows of it."""

    text: str
    shown: list[str]


def blocks(page: Path) -> list[Block]:
    """All blocks of a page that have a language."""
    return blocks_of(page.read_text(encoding="utf-8"))


def blocks_of(text: str) -> list[Block]:
    """Those of a part of a page."""
    return [
        Block(found[1], found[2] or "", found[3], text.count("\n", 0, found.start()) + 2)
        for found in _FENCE.finditer(text)
    ]


def commands(text: str) -> list[Command]:
    """The command lines of a console block: a line that ends with \\ goes on in the next one."""
    found: list[Command] = []
    goes_on = False
    for line in text.splitlines():
        if goes_on:
            found[-1] = Command(f"{found[-1].text[:-1]}{line.strip()}", [])
        elif line.startswith("$ "):
            found.append(Command(line[2:], []))
        else:
            found[-1].shown.append(line)
        goes_on = not found[-1].shown and found[-1].text.endswith("\\")
    return found


def different(shown: Iterable[str], came: Iterable[str]) -> str:
    """The first line that is shown and did not come, or that came and is not shown; nothing if all is as shown.

    A shown line ``...`` stands for any lines, and comments behind a # are not part of what is shown.
    """
    left = [line.rstrip() for line in came if not _NOW_AND_THEN.match(line)]
    anything = False
    for line in shown:
        if line.strip() == "...":
            anything = True
            continue
        while anything and left and not _same(line, left[0]):
            left.pop(0)
        if not left or not _same(line, left[0]):
            return f"shown: {line}\ncame:  {left[0] if left else 'nothing more'}"
        left.pop(0)
        anything = False
    return "" if anything or not any(left) else f"not shown: {next(line for line in left if line)}"


def _same(shown: str, came: str) -> bool:
    parts = [_NUMBER.split(_MACHINE.sub("~", line.rstrip())) for line in (shown, came)]
    return len(parts[0]) == len(parts[1]) and all(
        a == b or (place % 2 == 1 and _near(a, b)) for place, (a, b) in enumerate(zip(*parts, strict=True))
    )


def _near(shown: str, came: str) -> bool:
    """Whether two numbers differ by no more than one in the last digit; whole numbers may not differ."""
    mantissa, _, exponent = shown.partition("e")
    if "." not in mantissa and not exponent:
        return False
    digits = len(mantissa.partition(".")[2])
    return abs(float(shown) - float(came)) < 1.01 * 10.0 ** (int(exponent or 0) - digits)


def run_python(page: Path, folder: Path) -> None:
    """Run the examples of a page as one program in a file, and compare what they print with what is shown of them.

    Raises:
        AssertionError: what comes is not what is shown.
    """
    programs = [block for block in blocks(page) if block.language == "python" and not block.title]
    beside = {
        first.line: second.text
        for first, second in pairwise(blocks(page))
        if second.language == "text" and second.line == first.line + first.text.count("\n") + 3
    }
    end = "\0\n"
    program = folder / "page.py"
    program.write_text(f"\nprint({end!r}, end='')\n".join(block.text for block in programs), encoding="utf-8")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        runpy.run_path(str(program))
    for block, came in zip(programs, printed.getvalue().split(end), strict=True):
        if block.line in beside:
            wrong = different(beside[block.line].splitlines(), came.splitlines())
            assert not wrong, f"{page.name}:{block.line}:\n{wrong}"


@dataclass
class _Beside:
    """A command in another terminal."""

    command: Command
    process: subprocess.Popen[str]
    came: str = ""

    def wait_for_a_line(self) -> None:
        """Wait for its first line if the page shows it, as a reader does: the next command may need it."""
        if self.command.shown and self.command.shown[0] != "..." and not self.came:
            assert self.process.stdout is not None, "it is a pipe"
            line = b""  # byte by byte: what is left in a buffer of the pipe would be lost to `communicate`
            while not line.endswith(b"\n") and (byte := os.read(self.process.stdout.fileno(), 1)):
                line += byte
            self.came = line.decode()

    def end(self) -> tuple[int, str]:
        """Wait for its end: exit code, and all that came."""
        rest, _ = self.process.communicate(timeout=TIMEOUT)
        return self.process.returncode, self.came + rest


class Reader:
    """Does what the console blocks of a page say, in a folder, with ``lathe`` in the path.

    Commands of lathe and Python programs run in this process, since Python and Numba take two seconds to start;
    nodes, what imports rclpy, all that needs a shell, and all in the folder of a package of one's own do not: this
    process may know another package of that name.
    """

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder, self._patch = folder, patch
        self._last: tuple[Command, str] | None = None  # whose output the page has not shown yet
        self._beside: list[_Beside] = []
        tools = folder / ".tools"
        tools.mkdir()
        lathe = tools / "lathe"
        lathe.write_text(
            f'#!/bin/sh\n[ "$1" = python ] && shift || set -- -m lathe_rc "$@"\nexec {sys.executable} "$@"\n'
        )
        lathe.chmod(0o755)
        patch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
        patch.setenv("LATHE", str(ROOT))
        patch.setenv("COLUMNS", "120")  # as wide as a page
        patch.chdir(folder)

    def follow(self, page: Path) -> None:
        """Do all that a page says.

        Raises:
            AssertionError: a command fails that the page does not show as refused, or shows something else.
        """
        for block in blocks(page):
            if block.language == "console" and block.title:
                (command,) = commands(block.text)
                self._beside.append(_Beside(command, self._start(command.text)))
            elif block.language == "console":
                for other in self._beside:
                    other.wait_for_a_line()
                for command in commands(block.text):
                    code, came = self._run(command.text)
                    self._compare(page, command, code, came)
                    self._last = None if command.shown else (command, came)
                self._wait(page)
            elif block.language == "text" and self._last:
                command, came = self._last
                self._compare(page, Command(command.text, block.text.splitlines()), 0, came)
                self._last = None
            elif block.title:
                Path(block.title).write_text(block.text, encoding="utf-8")

    def _compare(self, page: Path, command: Command, code: int, came: str) -> None:
        refused = any(line.startswith("lathe: ") for line in command.shown)
        assert (code != 0) == refused, f"{page.name}: {command.text}\nends with {code}:\n{came}"
        wrong = different(command.shown, came.splitlines()) if command.shown else ""
        assert not wrong, f"{page.name}: {command.text}\n{wrong}\nall that came:\n{came}"

    def _run(self, text: str) -> tuple[int, str]:
        words = shlex.split(text, comments=True)
        if words[0] == "cd":
            self._patch.chdir(os.path.expandvars(words[1]))
            return 0, ""
        own_package = any(Path().glob("*/__init__.py"))
        if words[0] != "lathe" or words[1] in _NODES or own_package or _SHELL.search(_QUOTED.sub("", text)):
            process = self._start(text)
            came, _ = process.communicate(timeout=TIMEOUT)
            return process.returncode, came
        if words[1] == "python":
            return self._program(words[2:])
        done = CliRunner().invoke(main, words[1:])
        if done.exception and not isinstance(done.exception, SystemExit):
            raise done.exception
        return done.exit_code, done.output

    def _program(self, words: list[str]) -> tuple[int, str]:
        if "rclpy" in Path(words[0]).read_text(encoding="utf-8"):
            process = self._start(f"lathe python {shlex.join(words)}")
            came, _ = process.communicate(timeout=TIMEOUT)
            return process.returncode, came
        printed = io.StringIO()
        with self._patch.context() as patch, contextlib.redirect_stdout(printed):
            patch.setattr(sys, "argv", words)
            runpy.run_path(words[0], run_name="__main__")
        return 0, printed.getvalue()

    def _start(self, text: str) -> subprocess.Popen[str]:
        return subprocess.Popen(["bash", "-c", text], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def _wait(self, page: Path) -> None:
        """Wait for the commands in other terminals: they end with the one of the first."""
        while self._beside:
            other = self._beside.pop(0)
            self._compare(page, other.command, *other.end())

    def leave(self) -> None:
        """End what still runs."""
        for other in self._beside:
            other.process.kill()


@contextlib.contextmanager
def reader(folder: Path, patch: pytest.MonkeyPatch) -> Iterator[Reader]:
    """A reader in an empty folder, who leaves nothing running."""
    who = Reader(folder, patch)
    try:
        yield who
    finally:
        who.leave()
