# SPDX-License-Identifier: Apache-2.0
"""Which lathe_rc this is: its version and, in a checkout, the commit."""

import contextlib
import subprocess
from functools import cache
from pathlib import Path

from lathe_rc import __version__


@cache
def revision() -> str:
    """Such as ``0.1.0`` or ``0.1.0+93c5a79``; ``-dirty`` follows where files differ from the commit."""
    folder = Path(__file__).parents[2]
    if not (folder / ".git").exists():
        return __version__
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        asked = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--exclude=*"]
        told = subprocess.run(asked, capture_output=True, check=True, text=True).stdout.strip()
        return f"{__version__}+{told}"
    return __version__
