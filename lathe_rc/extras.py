# SPDX-License-Identifier: Apache-2.0
"""Import of command modules, executables and optional packages (extras)."""

import importlib.util
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import TYPE_CHECKING, cast

from lathe_rc import catalogue
from lathe_rc.errors import LatheError

if TYPE_CHECKING:  # a checkout imports this module before any package is installed
    import click

_MODULES = {
    "fmu": ("fmpy",),
    "formats": ("asammdf", "nptdms", "x3pio"),
    "panel": ("starlette", "uvicorn"),
    "ros": (
        *("diagnostic_msgs", "domain_coordinator", "lathe_rc_msgs", "lifecycle_msgs", "rclpy", "rosgraph_msgs"),
        *("sensor_msgs", "std_msgs", "std_srvs"),
    ),
    "sweep": (
        *("altair", "bokeh", "cmaes", "dask", "distributed", "filelock", "optuna", "simpleeval", "vl_convert"),
        "xxhash",
    ),
    "view": ("rerun", "rerun_bindings"),
}
_EXTRAS = {module: extra for extra, modules in _MODULES.items() for module in modules}
_FROM_3_11 = ("rerun", "rerun_bindings", "x3pio")  # older Pythons lack them, see requirements/
_CHECKOUT = {
    "fmu": "./lathe setup fmu in a checkout",
    "formats": "./lathe setup formats in a checkout",
    "panel": "./lathe setup panel in a checkout",
    "ros": "run it by ./lathe of a checkout, source a ROS 2 installation",
    "sweep": "./lathe setup sweep in a checkout",
    "view": "./lathe setup view in a checkout",
}


def refusal(module: str | None) -> LatheError | None:
    """Return the error for a module that cannot be imported; None if the module belongs to no extra."""
    name = (module or "").partition(".")[0]
    if (extra := _EXTRAS.get(name)) is None:
        return None
    if name in _FROM_3_11 and sys.version_info < (3, 11):
        return LatheError(f"no module {module} for Python 3.10; allowed: 3.11 to 3.14")
    return LatheError(f"no module {module} here: {_CHECKOUT[extra]}, or pip install 'lathe_rc[{extra}]'")


@contextmanager
def named() -> Iterator[None]:
    """Convert the import error for a missing extra into one line that says how to install the extra.

    Raises:
        LatheError: a module of an extra is missing.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if missing := refusal(error.name):
            raise missing from None
        raise


def require(module: str) -> None:
    """Check that a module of an extra is installed, without importing it.

    Raises:
        LatheError: the module is missing; the message says how to install it.
    """
    if importlib.util.find_spec(module) is None:
        missing = refusal(module)
        assert missing is not None, "it belongs to an extra"
        raise missing


def load(name: str) -> ModuleType:
    """Import a module; Ctrl-C during the import ends the process at once.

    An interrupted import needs no cleanup, whereas a KeyboardInterrupt during an import would print the whole import
    chain or be converted into another error by a library.
    """
    if threading.current_thread() is not threading.main_thread():
        return importlib.import_module(name)
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        return importlib.import_module(name)
    finally:
        signal.signal(signal.SIGINT, before)


def command(name: str) -> "click.Command":
    """Return a command of the command line after importing its module."""
    return cast("click.Command", getattr(load(catalogue.module_of(name)), name))
