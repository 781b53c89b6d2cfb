# SPDX-License-Identifier: Apache-2.0
"""./lathe: make the environment if it is not there or out of date, then run the command in it."""

import ast
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType

import preconditions
from environment import Changes, run_environment
from recipe import GROUPS, PACKAGES_STAMP, Recipe
from ros import SourcedRos, sourced_ros
from steps import exclusive
from workplace import PYTHON, ROOT, VENV, RefusalError, StepError, say

COMPLETES = "_LATHE_COMPLETE"  #: in the environment: a shell asks what may follow
OWN = {
    "docs": "Serve the documentation as a site, or write it.",
    "setup": f"Set up; also for commands that need more: ./lathe setup {' '.join(f'[{name}]' for name in GROUPS)}.",
    "test": "Run linters and tests.",
    "python": "Run Python in the environment of the checkout.",
}  #: commands of ./lathe alone


def main(arguments: Sequence[str]) -> int:
    """Set up, then become the command; return an exit code on failure or if there is no command to run."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, interrupt)
    try:
        ros = sourced_ros(os.environ)
        if python := ros.python() if ros else settled(os.environ):
            change_to(python)
        if COMPLETES in os.environ:
            return complete(Recipe(ros).ready([]))
        if is_help(arguments):
            return show_help(Recipe(ros).ready([]), arguments)
        if ros is None:
            preconditions.check_libraries(os.environ)
            if PYTHON.exists():
                preconditions.check_python_path(os.environ)
        wanted = set_up(ros, needed(arguments))
        if ros is None and arguments[:1] != ["setup"]:
            preconditions.check_python_path(os.environ)  # again: now the packages are there
    except RefusalError as refusal:
        say(str(refusal))
        return 2
    except (StepError, OSError) as failure:
        say(str(failure))
        return 1
    except KeyboardInterrupt:
        say("interrupted; the next call takes the set-up up again")
        return 130
    if arguments[:1] != ["setup"]:
        os.execve(PYTHON, [str(PYTHON), *command(arguments)], run_environment(wanted, os.environ))
    return 0


def complete(ready: Changes | None) -> int:
    """Become the command line that completes for a shell; where nothing is set up, say nothing."""
    if ready:
        environ = run_environment(ready, os.environ) | {"_LATHE_ALSO": " ".join(OWN)}
        os.execve(PYTHON, [str(PYTHON), *command([])], environ)
    return 0


def is_help(arguments: Sequence[str]) -> bool:
    """Tell whether a help text is asked for; words after ``python`` are those of a script."""
    return arguments[:1] != ["python"] and any(word in ("-h", "--help") for word in arguments or ["--help"])


def show_help(ready: Changes | None, arguments: Sequence[str]) -> int:
    """Print a help text without setting anything up: that of a command of lathe_rc only where it is set up."""
    name = next(iter(arguments), "")
    if name == "docs":
        os.execv(sys.executable, [sys.executable, *command(arguments)])
    if name == "test":
        print(ast.get_docstring(ast.parse((ROOT / "tools" / "check.py").read_text(encoding="utf-8"))))
    elif name in OWN:
        print(f"./lathe {name}: {OWN[name]}")
    elif ready:
        os.execve(PYTHON, [str(PYTHON), *command(arguments)], run_environment(ready, os.environ))
    else:
        sys.path.append(str(ROOT))
        from lathe_rc.catalogue import COMMANDS

        print("Usage: ./lathe COMMAND [OPTIONS]. Nothing is set up yet: ./lathe setup, or the first command, does it;")
        print("after that each COMMAND has its own --help.\n")
        print(*(f"  {name:<12}{summary}" for name, summary in sorted((COMMANDS | OWN).items())), sep="\n")
    return 0


def needed(arguments: Sequence[str]) -> Sequence[str]:
    """Return the groups of packages that a command needs beside those of all.

    Raises:
        RefusalError: ``setup`` of a group that there is not.
    """
    if arguments[:1] == ["setup"]:
        for name in arguments[1:]:
            if name not in GROUPS:
                raise RefusalError(f"setup {name}; allowed: {', '.join(GROUPS)}, or nothing more")
        return arguments[1:]
    sweeps = {name: ["sweep"] for name in ("bench", "sweep", "tune")}
    test = ["docs", "fmu", "formats", "panel", "sweep", "test", "view"]
    wanted = {**sweeps, "docs": ["docs"], "panel": ["panel"], "test": test, "view": ["view"]}
    return wanted.get(next(iter(arguments), ""), [])


def set_up(ros: SourcedRos | None, groups: Sequence[str]) -> Changes:
    """Make whatever is missing or out of date and return what lathe_rc needs in its environment."""
    recipe = Recipe(ros)
    ready = recipe.ready(groups)
    if ready:
        return ready
    preconditions.check(ros)
    with exclusive() as lock:
        return recipe.ready(groups) or recipe.make(lock, groups)


def command(arguments: Sequence[str]) -> list[str]:
    """Return what the Python of the environment is to run."""
    for name, script in {"docs": "docs.py", "test": "check.py"}.items():
        if arguments[:1] == [name]:
            return [str(ROOT / "tools" / script), *arguments[1:]]
    if arguments[:1] == ["bench"]:
        return ["-m", "benchmarks", *arguments]
    if arguments[:1] == ["python"]:
        return list(arguments[1:])
    return [str(ROOT / "lathe_rc" / "__main__.py"), *arguments]  # not -m: the current folder is no place for code


def change_to(python: Path) -> None:
    """Start over in another interpreter, unless it is the one that runs this."""
    if python.resolve() != Path(sys.executable).resolve():
        os.execv(python, [str(python), "-E", *sys.argv])


def settled(environ: Mapping[str, str]) -> Path | None:
    """Return the interpreter that is set up already: another python3 in the PATH is no wish to make all anew."""
    python = PYTHON.resolve()
    there = PACKAGES_STAMP.exists() and python.exists() and VENV not in python.parents
    return python if there and "LATHE_PYTHON" not in environ else None


def interrupt(_number: int, _frame: FrameType | None) -> None:
    """End on a signal the way Ctrl-C does, so that no command of a step is left running."""
    raise KeyboardInterrupt
