# SPDX-License-Identifier: Apache-2.0
"""Backlash: a gap between the motor and the load, both given as positions of the load.

The load rests by friction wherever the motor leaves it, and moves only while the motor stands at one of the flanks of
the gap. It has no inertia of its own that could carry it through the gap.
"""

from lathe_rc.jit import kernel


@kernel
def follow(load: float, half: float, motor: float) -> float:
    """Where the load is once the motor has moved straight to ``motor``.

    Args:
        load: where it was, within ``half`` of where the motor was [m].
        half: half the width of the gap [m].
        motor: where the motor is now [m].
    """
    return min(max(load, motor - half), motor + half)
