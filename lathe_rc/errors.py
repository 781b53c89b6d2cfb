# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can do something about; each is one line and has an exit code."""

from typing import ClassVar


class LatheError(Exception):
    """A run failed; the message is one line that names the thing, its value and what to do."""

    exit_code: ClassVar[int] = 1


class InputError(LatheError):
    """What the user gave cannot be used: a parameter, a file, a path, an unstable setting."""

    exit_code: ClassVar[int] = 2


class LossyRunError(LatheError):
    """A free-running cell lost blocks; the message counts and names them."""

    exit_code: ClassVar[int] = 3
