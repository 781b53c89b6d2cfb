# SPDX-License-Identifier: Apache-2.0
"""Reading a table between its rows."""

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import inlined

Array = npt.NDArray[np.float64]


@inlined
def linear(places: Array, values: Array, place: float) -> float:
    """Linear between the rising ``places``, the same beyond their ends; both of shape (n,)."""
    last = places.size - 1
    if not place > places[0]:
        return float(values[0])
    if place >= places[last]:
        return float(values[last])
    i = np.searchsorted(places, place, side="right") - 1
    return float(values[i] + (values[i + 1] - values[i]) * (place - places[i]) / (places[i + 1] - places[i]))
