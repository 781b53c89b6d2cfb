# SPDX-License-Identifier: Apache-2.0
"""The executables of ``ros2 run lathe_rc KIND``: one for each kind of node of a cell, under its name.

``python -m lathe_rc.nodes.executables KIND ...`` is the same without an installation.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import NoReturn

from lathe_rc.cell.scenario import TABLES
from lathe_rc.nodes import process


def __getattr__(kind: str) -> Callable[[], NoReturn]:
    """The entry point of a kind of node.

    Raises:
        AttributeError: there is no such kind.
    """
    if kind not in TABLES.own:
        raise AttributeError(f"no node {kind!r}")
    return partial(process.main, kind)


if __name__ == "__main__":
    process.main(sys.argv.pop(1))
