# SPDX-License-Identifier: Apache-2.0
"""Errors that a user can do something about; each is one line, whatever it quotes, and has an exit code."""

from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import ClassVar


class LatheError(Exception):
    """A run failed; the message is one line that names the thing, its value and what to do."""

    exit_code: ClassVar[int] = 1


class InputError(LatheError):
    """The user's input cannot be used: a parameter, a file, a path, an unstable setting."""

    exit_code: ClassVar[int] = 2


class UnpublishedError(InputError):
    """A topic is read that no node of the scenario publishes."""


class DivergedError(LatheError):
    """A run grew beyond what it may: beyond all numbers, or beyond a law's ``stop_ratio``."""


class LossyRunError(LatheError):
    """A free-running cell lost blocks; the message counts and names them."""

    exit_code: ClassVar[int] = 3


def shown(text: object, longest: int = 200) -> str:
    """The message of a library or a file: the beginning of its first line, in characters that print."""
    first = (str(text).strip().splitlines() or [type(text).__name__])[0]
    return "".join(letter if letter.isprintable() else "\ufffd" for letter in first[:longest])


def at_most(value: float, digits: int = 6) -> str:
    """The text of an upper limit, rounded down where it is rounded: what a refusal names is allowed itself."""
    text = f"{value:.{digits}g}"
    rounded = Context(digits, ROUND_FLOOR).create_decimal(Decimal(value))
    return text if float(text) <= value else f"{float(rounded):.{digits}g}"


def at_least(value: float, digits: int = 6) -> str:
    """The text of a lower limit, rounded up where it is rounded, see `at_most`."""
    text = f"{value:.{digits}g}"
    rounded = Context(digits, ROUND_CEILING).create_decimal(Decimal(value))
    return text if float(text) >= value else f"{float(rounded):.{digits}g}"
