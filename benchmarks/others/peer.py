# SPDX-License-Identifier: Apache-2.0
"""Programs of others in processes of their own: settings on the first line of stdin, then a line of JSON a request.

They run in the environment that LATHE_PEERS names, else in ``.lathe/peers`` if there is one (requirements/bench.in says
how to make it), so that what they need never touches the environment that is measured; otherwise where lathe_rc runs.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[2]


def python() -> str:
    """The interpreter that peers run in."""
    own = Path(os.environ.get("LATHE_PEERS", _ROOT / ".lathe" / "peers")) / "bin" / "python"
    return str(own) if own.exists() else sys.executable


def missing(module: str) -> str:
    """Why a module of a peer cannot be used; empty if it can."""
    found = subprocess.run([python(), "-c", f"import {module}"], capture_output=True, text=True, check=False)
    if not found.returncode:
        return ""
    line = (found.stderr.strip().splitlines() or [f"exit code {found.returncode}"])[-1]
    return f"not installed ({line}); see requirements/bench.in"


class Peer:
    """A program of others; a context manager that leaves no process behind.

    Args:
        program: file beside this one.
        settings: its first line.
    """

    def __init__(self, program: str, settings: Mapping[str, Any]) -> None:
        path = Path(__file__).with_name(program)
        self._process = subprocess.Popen(
            [python(), str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=_ROOT
        )
        self._say(json.dumps(settings))

    def _say(self, line: str) -> None:
        assert self._process.stdin is not None, "it is a pipe"
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()

    def ask(self) -> dict[str, Any]:
        """One run.

        Raises:
            RuntimeError: the program ended instead.
        """
        assert self._process.stdout is not None, "it is a pipe"
        self._say("")
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError(f"{self._process.args!r} ended with exit code {self._process.wait()}")
        return dict(json.loads(answer))

    def __enter__(self) -> "Peer":
        """Itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """End it."""
        self._process.communicate()
