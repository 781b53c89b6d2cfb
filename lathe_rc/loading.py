# SPDX-License-Identifier: Apache-2.0
"""Importing what a command or an executable needs."""

import importlib
import signal
import threading
from types import ModuleType


def load(name: str) -> ModuleType:
    """Import a module. Ctrl-C meanwhile ends the process at once, as any program that has not begun.

    Half an import has nothing to put in order; an exception in the middle of it would be shown with all that was being
    imported, or turned by a library into another error.
    """
    if threading.current_thread() is not threading.main_thread():
        return importlib.import_module(name)
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        return importlib.import_module(name)
    finally:
        signal.signal(signal.SIGINT, before)
