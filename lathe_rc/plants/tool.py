# SPDX-License-Identifier: Apache-2.0
"""The tool against the part: its drives add up (paper 001, Fig. 1a), the form error is what they leave."""

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]


@kernel
def add_drive(
    begins: bool,  # noqa: FBT001 - kernels take their arguments by position
    reference: Array,
    expected: Array,
    position: Array,
    measured: Array,
    displacement: Array,
    known: Array,
    error: Array,
) -> None:
    """Add a drive's motion; all [m] and of shape (n,). The first drive ``begins`` the sum.

    The error is Xd - X of what is true (paper 000, Fig. 1); what can be known of it is what is expected at the measured
    angle less the measured motions.
    """
    for k in range(reference.size):
        displacement[k] = position[k] if begins else displacement[k] + position[k]
        known[k] = (expected[k] if begins else known[k]) - measured[k]
        error[k] = reference[k] - displacement[k]


@kernel
def equal(one: Array, other: Array) -> bool:
    """Whether two signals of shape (n,) are equal, sample by sample."""
    differs = False
    for k in range(one.size):
        differs |= one[k] != other[k]
    return not differs
