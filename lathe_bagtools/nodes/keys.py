# SPDX-License-Identifier: Apache-2.0
"""Keys that are pressed in the terminal of a node."""

import contextlib
import os
import select
import termios
import tty
from collections.abc import Callable, Iterator

_NAMES = {b" ": "space", b"\x1b[A": "up", b"\x1b[B": "down", b"\x1b[C": "right"}


def _is_ours(descriptor: int) -> bool:
    """Return True for a terminal whose foreground process this is; the system stops others that change it."""
    try:
        return os.isatty(descriptor) and os.tcgetpgrp(descriptor) == os.getpgrp()
    except OSError:
        return False


@contextlib.contextmanager
def listening(descriptor: int = 0) -> Iterator[Callable[[], list[str]]]:
    """Provide a function that returns the keys pressed since its last call: ``space``, ``up``, ``down``, ``right``.

    Without a terminal, or in the background, it returns none. The settings of the terminal are restored at the end.
    """
    if not _is_ours(descriptor):
        yield list
        return
    before = termios.tcgetattr(descriptor)

    def pressed() -> list[str]:
        text = b""
        while select.select([descriptor], [], [], 0)[0] and (read := os.read(descriptor, 64)):
            text += read
        found = []
        while text:
            name = next((each for each in _NAMES if text.startswith(each)), text[:1])
            found += [_NAMES[name]] if name in _NAMES else []
            text = text[len(name) :]
        return found

    try:
        tty.setcbreak(descriptor, termios.TCSANOW)
        yield pressed
    finally:
        termios.tcsetattr(descriptor, termios.TCSANOW, before)
