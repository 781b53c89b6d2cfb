# SPDX-License-Identifier: Apache-2.0
"""End stops of a carriage."""

from lathe_rc.jit import inlined


@inlined
def between_stops(position: float, velocity: float, stroke: float) -> tuple[float, float, bool]:
    """Position [m] and velocity [m/s] between end stops at ± ``stroke`` [m], and whether it is at one of them.

    They are inelastic: the carriage stays there until it is driven back.
    """
    if position > stroke:
        return stroke, min(velocity, 0.0), True
    if position < -stroke:
        return -stroke, max(velocity, 0.0), True
    return position, velocity, False
