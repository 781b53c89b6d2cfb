# SPDX-License-Identifier: Apache-2.0
"""The desired form of the part under the tool's edge."""

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.profile import evaluate

Array = npt.NDArray[np.float64]

_TURN = 2.0 * np.pi


@inlined
def _height(angle: float, feed: float, start_height: float, part: int) -> float:
    turns = angle / _TURN
    if part > 0:
        turns -= part * np.floor(turns / part)
    return start_height + feed * turns


@kernel
def desired(
    heights: Array,
    table: Array,
    feed: float,
    start_height: float,
    part: int,
    angle: Array,
    angle_true: Array,
    reference: Array,
    expected: Array,
    height: Array,
) -> None:
    """Fill the desired displacement at the true and at the measured angle, and the height; shape (n,) [rad, m].

    ``part`` is the revolutions after which the next part begins; 0 for one endless part.
    """
    row = 0
    for k in range(angle.size):
        height[k] = _height(angle_true[k], feed, start_height, part)
        reference[k], row = evaluate(angle_true[k], height[k], heights, table, row)
        if angle[k] == angle_true[k]:
            expected[k] = reference[k]
        else:
            measured = _height(angle[k], feed, start_height, part)
            expected[k], row = evaluate(angle[k], measured, heights, table, row)


@kernel
def desired_at(
    heights: Array,
    table: Array,
    start_height: float,
    slide: Array,
    slide_measured: Array,
    angle: Array,
    angle_true: Array,
    reference: Array,
    expected: Array,
    height: Array,
) -> None:
    """The same where a longitudinal slide makes the height [m], true and as its sensor reads it."""
    row = 0
    for k in range(angle.size):
        height[k] = start_height + slide[k]
        reference[k], row = evaluate(angle_true[k], height[k], heights, table, row)
        if angle[k] == angle_true[k] and slide[k] == slide_measured[k]:
            expected[k] = reference[k]
        else:
            expected[k], row = evaluate(angle[k], start_height + slide_measured[k], heights, table, row)
