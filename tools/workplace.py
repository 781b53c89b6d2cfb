# SPDX-License-Identifier: Apache-2.0
"""Where the set-up keeps things, and what it says when it can't go on."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HOME = ROOT / ".lathe"
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
