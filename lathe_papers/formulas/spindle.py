# SPDX-License-Identifier: Apache-2.0
"""How much a load changes a spindle's speed: `lathe_rc.plants.spindle` in continuous time."""

import numpy as np
import numpy.typing as npt

from lathe_rc.plants.spindle import Belt, SpeedLoop
from lathe_rc.transfer import TransferFunction


def speed_over_load(*, inertia: float, motor_inertia: float, belt: Belt | None, loop: SpeedLoop) -> TransferFunction:
    """δ' over the load's torque [rad/s over N·m], without the torque limit and the sampling of the loop.

    With a rigid belt -p/((J + Jm)·p² + Kp·p + Ki).

    Args:
        inertia: J [kg·m²].
        motor_inertia: Jm [kg·m²].
        belt: None: rigid.
        loop: of the speed.
    """
    whole = inertia + motor_inertia
    proportional, integral = loop.gains(whole)
    if belt is None:
        return TransferFunction((-1.0, 0.0), (whole, proportional, integral))
    twist = np.array([belt.damping, belt.stiffness])
    motor = np.polyadd([motor_inertia, proportional, integral], twist)
    spindle = np.polyadd([inertia, 0.0, 0.0], twist)
    bottom: npt.NDArray[np.float64] = np.polysub(np.polymul(spindle, motor), np.polymul(twist, twist))
    return TransferFunction(tuple(-np.polymul([1.0, 0.0], motor)), tuple(bottom))
