# SPDX-License-Identifier: Apache-2.0
"""Errors that the user can correct: each has a one-line message and an exit code."""

import errno
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import ClassVar


class LatheError(Exception):
    """Failure of a run; the one-line message names the object, its value and a remedy."""

    exit_code: ClassVar[int] = 1


class InputError(LatheError):
    """Unusable user input: a parameter, a file, a path or an unstable setting."""

    exit_code: ClassVar[int] = 2


class UnpublishedError(InputError):
    """Read access to a topic that no node of the scenario publishes."""


class DivergedError(LatheError):
    """Divergence of a run: non-finite numbers, or growth beyond a law's ``stop_ratio``."""


class LossyRunError(LatheError):
    """Loss of blocks in a free-running cell; the message lists and counts the lost blocks."""

    exit_code: ClassVar[int] = 3


class PaceError(LatheError):
    """Failure of a cell with a strict pace to hold it; the message names what lags, and a remedy."""

    exit_code: ClassVar[int] = 4


def shown(text: object, longest: int = 200) -> str:
    """Return the beginning of the first line of an external message, in printable characters."""
    first = (str(text).strip().splitlines() or [type(text).__name__])[0]
    return "".join(letter if letter.isprintable() else "\ufffd" for letter in first[:longest])


def correctable(error: LatheError | OSError) -> LatheError:
    """Return an error that the user can correct, which a name that is too long for the file system is too.

    Raises:
        OSError: the error is another one.
    """
    if isinstance(error, LatheError):
        return error
    if error.errno != errno.ENAMETOOLONG:
        raise error
    return InputError(f"{shown(error.filename, 60)}…: the name is too long; allowed: a name that the file system takes")


def at_most(value: float, digits: int = 6) -> str:
    """Format an upper limit, rounded down if necessary, so that the value in an error message is itself allowed."""
    text = f"{value:.{digits}g}"
    rounded = Context(digits, ROUND_FLOOR).create_decimal(Decimal(value))
    return text if float(text) <= value else f"{float(rounded):.{digits}g}"


def at_least(value: float, digits: int = 6) -> str:
    """Format a lower limit, rounded up if necessary, so that the value in an error message is itself allowed."""
    text = f"{value:.{digits}g}"
    rounded = Context(digits, ROUND_CEILING).create_decimal(Decimal(value))
    return text if float(text) >= value else f"{float(rounded):.{digits}g}"
