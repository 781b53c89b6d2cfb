# SPDX-License-Identifier: Apache-2.0
"""File with the state of a node, from which a new process resumes (see `lathe_rc.protocol.restart`)."""

import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lathe_rc import data_file
from lathe_rc.errors import LatheError

_KIND = "state"


class StateFile:
    """File with a state (implements `lathe_rc.protocol.restart.Store`); ``name`` is its path."""

    def __init__(self, name: str) -> None:
        self.name = name

    def write(self, state: Any) -> None:
        """Replace the file atomically: a reader sees either state, even if this process is killed.

        Raises:
            LatheError: the file cannot be written.
        """
        path = Path(self.name)
        new = path.with_name(f"{path.name}.new")
        try:
            new.unlink(missing_ok=True)
            with open(new, "xb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
                file.write(data_file.packed(_KIND, state, level=0))
            new.replace(path)
        except OSError as error:
            raise LatheError(f"{path}: the state cannot be kept ({error.strerror})") from None

    def read(self, restore: Callable[[Any], object]) -> None:
        """Pass the state to a function.

        Raises:
            LatheError: the file is no state that the function takes, or another user could have written it.
        """
        path = Path(self.name)
        try:
            about = path.stat()
        except OSError as error:
            raise LatheError(f"{path}: the state cannot be read ({error.strerror})") from None
        if about.st_uid != os.getuid() or about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            raise LatheError(f"{path}: another user owns or may write this state; allowed: your own file, mode 600")
        data_file.read(path, _KIND, restore)
