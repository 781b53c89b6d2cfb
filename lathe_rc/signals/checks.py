# SPDX-License-Identifier: Apache-2.0
"""Checks of arrays from a scenario or a third-party class."""

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError


def stacked(what: str, **arrays: Array) -> Array:
    """Stack arrays of equal length, shape (m, n).

    Args:
        what: subject of the error message.
        **arrays: arrays of shape (n,), by their names in the message.

    Raises:
        InputError: the arrays differ in length.
    """
    if len({array.size for array in arrays.values()}) > 1:
        *sizes, last = (f"{array.size} {name}" for name, array in arrays.items())
        raise InputError(f"{what}: {', '.join(sizes)} and {last}; give as many of each")
    return np.stack(tuple(arrays.values()))


def real_numbers(call: str, result: object, argument: str, like: Array) -> Array:
    """Check that a formula in plain Python returned a real number for each argument, and return these numbers.

    Args:
        call: call of the formula, for the error message.
        result: return value of the formula, shape (n,).
        argument: plural name of the argument, for the error message.
        like: the arguments, shape (n,).

    Raises:
        InputError: the result has a different shape or type. Numbers that are not finite are accepted.
    """
    numbers = np.asarray(result)
    if numbers.shape != like.shape or numbers.dtype.kind not in "fiu":
        raise InputError(
            f"{call} gives {numbers.dtype} of shape {numbers.shape} for {argument} of shape {like.shape}; "
            "allowed: a real number for each"
        )
    return numbers
