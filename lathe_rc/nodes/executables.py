# SPDX-License-Identifier: Apache-2.0
"""The executables of ``ros2 run lathe_rc NAME``: one for each kind of node of a cell, and those that are nodes alone.

``python -m lathe_rc.nodes.executables NAME ...`` is the same without an installation.
"""

import importlib.util
import sys
from collections.abc import Callable
from functools import partial

from lathe_rc import extras
from lathe_rc.cell.scenario import TABLES
from lathe_rc.loading import load


def __getattr__(name: str) -> Callable[[], None]:
    """The entry point of an executable.

    Raises:
        AttributeError: there is no such executable.
    """
    if name not in TABLES.own and importlib.util.find_spec(f"lathe_rc.nodes.{name}") is None:
        raise AttributeError(f"no node {name!r}")
    return partial(_main, name)


def _main(name: str) -> None:
    try:
        if name in TABLES.own:
            load("lathe_rc.nodes.process").main(name)
        else:
            load(f"lathe_rc.nodes.{name}").main()
    except ModuleNotFoundError as error:
        if not (missing := extras.refusal(error.name)):
            raise
        print(f"lathe: {missing}", file=sys.stderr)
        sys.exit(missing.exit_code)


if __name__ == "__main__":
    _main(sys.argv.pop(1))
