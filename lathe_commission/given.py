# SPDX-License-Identifier: Apache-2.0
"""Values that a user's program passes, checked; an error names the value and the allowed ones."""

import math
import operator
from typing import Any, TypeVar

import numpy as np

from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError

T = TypeVar("T")


def number(name: str, value: object, low: float, high: float = math.inf, *, above: bool = False) -> float:
    """Return a finite number from ``low`` to ``high``, or ``above`` the former.

    Raises:
        InputError: the value is none.
    """
    found = value if isinstance(value, int | float | np.integer | np.floating) else math.nan
    if not (low < found if above else low <= found) or not found <= high or not math.isfinite(found):
        word = "above" if above else "from"
        most = f" to {high:g}" if high < math.inf else ""
        raise InputError(f"{name} = {value!r:.60}; allowed: a number {word} {low:g}{most}")
    return float(found)


def whole(name: str, value: Any, low: int, high: int) -> int:
    """Return a whole number from ``low`` to ``high``.

    Raises:
        InputError: the value is none.
    """
    try:
        found = operator.index(value)
    except TypeError:
        found = low - 1
    if not low <= found <= high:
        raise InputError(f"{name} = {value!r:.60}; allowed: a whole number from {low} to {high}")
    return found


def complex_array(name: str, value: Any, *, size: int | None = None) -> Complex:
    """Return finite numbers as an array of shape (n,), n of ``size`` if that is given.

    Raises:
        InputError: the value is no such array.
    """
    try:
        found = np.asarray(value, np.complex128)
    except (TypeError, ValueError):
        raise InputError(f"{name} = {value!r:.60}; allowed: an array of numbers") from None
    if found.ndim != 1 or (size is not None and found.size != size):
        wanted = "(n,)" if size is None else f"({size},)"
        raise InputError(f"{name} of shape {found.shape}; allowed: {wanted}")
    if not np.isfinite(found).all():
        raise InputError(f"{name}: {found[~np.isfinite(found)][0]} among the values; allowed: finite numbers")
    return found


def array(name: str, value: Any, *, size: int | None = None) -> Array:
    """Return `complex_array` of real numbers.

    Raises:
        InputError: the value is no such array.
    """
    found = complex_array(name, value, size=size)
    if found.imag.any():
        raise InputError(f"{name}: {found[found.imag != 0.0][0]} among the values; allowed: real numbers")
    return np.asarray(found.real)


def instance(name: str, value: object, kind: type[T], cure: str) -> T:
    """Return a value of a class; ``cure`` says how to get one.

    Raises:
        InputError: it is another one.
    """
    if not isinstance(value, kind):
        raise InputError(f"{name} = {value!r:.60}: {type(value).__name__}; allowed: {kind.__name__} ({cure})")
    return value
