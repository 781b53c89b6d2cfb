# SPDX-License-Identifier: Apache-2.0
"""Types of arrays, and array operations as functions for kernels.

For statements on slices, Numba also compiles error messages about shapes, which takes seconds.
"""

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import inlined

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Integers = npt.NDArray[np.int64]


@inlined
def put(into: Array, values: Array) -> None:
    """Copy ``values`` into ``into``: arrays of the same shape (n,) that do not overlap."""
    for k in range(into.size):
        into[k] = values[k]


@inlined
def put_scaled(into: Array, factor: float, values: Array) -> None:
    """Compute ``into[:] = factor * values`` for arrays of the same shape (n,) that do not overlap."""
    for k in range(into.size):
        into[k] = factor * values[k]


@inlined
def subtract(into: Array, values: Array) -> None:
    """Compute ``into -= values`` for arrays of the same shape (n,) that do not overlap."""
    for k in range(into.size):
        into[k] -= values[k]
