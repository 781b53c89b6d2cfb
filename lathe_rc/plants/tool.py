# SPDX-License-Identifier: Apache-2.0
"""The tool's edge against the desired form of the part."""

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel
from lathe_rc.signals.profile import evaluate

Array = npt.NDArray[np.float64]

_TURN = 2.0 * np.pi


@kernel
def form(
    heights: Array,
    table: Array,
    feed: float,
    start_height: float,
    angle: Array,
    angle_true: Array,
    position: Array,
    measured_position: Array,
    reference: Array,
    displacement: Array,
    error: Array,
    measured_error: Array,
    height: Array,
) -> None:
    """Fill reference, displacement, errors and height of a block; arrays of shape (n,) [rad, m].

    δ = Xd - X at the true spindle angle (paper 000, Fig. 1). What the controller can know differs: the desired
    form at the measured angle, less the measured displacement.
    """
    for k in range(angle.size):
        height[k] = start_height + feed * (angle_true[k] / _TURN)
        reference[k] = evaluate(angle_true[k], height[k], heights, table)
        displacement[k] = position[k]
        error[k] = reference[k] - displacement[k]
        if angle[k] == angle_true[k]:
            expected = reference[k]
        else:
            expected = evaluate(angle[k], start_height + feed * (angle[k] / _TURN), heights, table)
        measured_error[k] = expected - measured_position[k]
