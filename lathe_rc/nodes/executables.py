# SPDX-License-Identifier: Apache-2.0
"""Executables of ``ros2 run lathe_rc NAME``: one for each kind of cell node and for each standalone node.

``python -m lathe_rc.nodes.executables NAME ...`` does the same without an installation.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import NoReturn

from lathe_rc import extras
from lathe_rc.catalogue import STANDALONE
from lathe_rc.cell.scenario import TABLES
from lathe_rc.extras import load
from lathe_rc.nodes.arguments import exit_with


def __getattr__(name: str) -> Callable[[], None]:
    """Return the entry point of an executable.

    Raises:
        AttributeError: no executable has this name.
    """
    if name not in TABLES.own and name not in STANDALONE:
        raise AttributeError(f"no node {name!r}")
    return partial(_main, name)


def _main(name: str) -> NoReturn:
    module, words = ("lathe_rc.nodes.process", [name]) if name in TABLES.own else (STANDALONE[name], [])

    def work() -> NoReturn:
        with extras.named():
            load(module).main(*words)
        raise AssertionError("an executable exits by itself")

    exit_with(work)


if __name__ == "__main__":
    _main(sys.argv.pop(1))
