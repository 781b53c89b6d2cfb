# SPDX-License-Identifier: Apache-2.0
"""Where the set-up keeps things, and what it says when it can't go on."""

import hashlib
import os
import re
import sys
from pathlib import Path

# Paths that CMake and the first lines of scripts can carry; CMake drops letters beyond ASCII from texts that it reads.
_PLAIN = re.compile(r"[\w/.@=,~+-]+", re.ASCII)
_CHECKOUTS = "lathe_rc-checkouts"  # folder in the cache


def is_plain(path: Path) -> bool:
    """Tell whether the programs of the set-up can handle a path."""
    return bool(_PLAIN.fullmatch(str(path)))


def linked_home(root: Path) -> Path | None:
    """Return the folder in a cache to which the .lathe of a checkout is a link; None if it is none."""
    link = root / ".lathe"
    there = link.readlink() if link.is_symlink() else Path()
    return there if there.parent.parent.name == _CHECKOUTS else None


def home_of(root: Path) -> Path:
    """Return the folder of the set-up of a checkout: its .lathe, or a folder in the user's cache for a strange path."""
    if is_plain(root):
        return root / ".lathe"
    name = hashlib.sha256(os.fsencode(root)).hexdigest()[:16]
    if (linked := linked_home(root)) and linked.parent.name == name:
        return linked  # whatever XDG_CACHE_HOME says today
    cache = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    return Path(cache, _CHECKOUTS, name, ".lathe")


ROOT = Path(__file__).resolve().parent.parent
HOME = home_of(ROOT)
VENV = HOME / "venv"
PYTHON = VENV / "bin" / "python"
NODE = VENV / "npm"
BUILD = HOME / "build"
INSTALL = HOME / "install"
LOG = HOME / "log"
REQUIREMENTS = ROOT / "requirements"
PACKAGES = sorted(path.parent for path in ROOT.glob("lathe_*/__init__.py"))  #: folders of the Python packages

# The interpreter itself, even if a virtual environment (perhaps the very one to be made anew) started us.
BASE_PYTHON: str = getattr(sys, "_base_executable", sys.executable)


class RefusalError(Exception):
    """Something is missing or unsuitable; nothing was made. The message is one line and says what to do."""


class StepError(Exception):
    """A step of the set-up failed. The message holds the end of its log and says what to do."""


def say(line: str) -> None:
    """Print a line for the person at the terminal; stdout belongs to the command that follows."""
    print(f"lathe: {line}", file=sys.stderr, flush=True)
