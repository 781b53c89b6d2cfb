# SPDX-License-Identifier: Apache-2.0
"""Executables of ``ros2 run lathe_rc NAME``: one for each kind of cell node and for each standalone node.

``python -m lathe_rc.nodes.executables NAME ...`` does the same without an installation.
"""

import importlib.util
import sys
from collections.abc import Callable
from functools import partial
from typing import NoReturn

from lathe_rc import extras
from lathe_rc.cell.scenario import TABLES
from lathe_rc.extras import load
from lathe_rc.nodes.arguments import exit_with


def __getattr__(name: str) -> Callable[[], None]:
    """Return the entry point of an executable.

    Raises:
        AttributeError: no executable has this name.
    """
    if name not in TABLES.own and importlib.util.find_spec(f"lathe_rc.nodes.{name}") is None:
        raise AttributeError(f"no node {name!r}")
    return partial(_main, name)


def _main(name: str) -> NoReturn:
    module, words = ("process", [name]) if name in TABLES.own else (name, [])

    def work() -> NoReturn:
        with extras.named():
            load(f"lathe_rc.nodes.{module}").main(*words)
        raise AssertionError("an executable exits by itself")

    exit_with(work)


if __name__ == "__main__":
    _main(sys.argv.pop(1))
