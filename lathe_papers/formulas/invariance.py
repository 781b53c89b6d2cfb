# SPDX-License-Identifier: Apache-2.0
"""Correction that makes the response of a first-order plant over the angle independent of the spindle speed.

The plant is 1/(1 + T0·p). Two elements precede the plant, the substitute first (paper 000, eqs 13-17):

    Wk2:  (θ0/Ω)·dv/dt + v = Y          the desired plant, 1/(1 + θ0·s) in the angle domain
    Wk1:  u = v + T0·dv/dt              the inverse of the actual plant

so that the output of the plant is v itself for any variation of the speed. dv/dt = (Ω/θ0)·(Y - v) is known from Wk2, so
nothing is differentiated. Operators with varying parameters do not commute: Wk1 before Wk2 gives a different output.
"""

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import LatheError
from lathe_rc.jit import kernel


@kernel
def _advance(
    time_constant: float,
    angle_constant: float,
    state: Array,
    angle: Array,
    speed: Array,
    desired: Array,
    substitute: Array,
    command: Array,
) -> int:
    """Compute one block; return the sample at which the spindle reverses, or the number of samples.

    ``state`` holds v and the angle and Y of the previous sample; the angle is NaN before the first sample.
    """
    v, last_angle, last = state[0], state[1], state[2]
    for k in range(angle.size):
        h = (angle[k] - last_angle) / angle_constant
        if h < 0.0:
            return k
        if h > 0.0:
            # In the angle domain the equation has constant coefficients: exact for Y linear in the angle over the step.
            part = -np.expm1(-h)
            mean = part / h
            v += (last - v) * part + (desired[k] - last) * (1.0 - mean)
        last_angle, last = angle[k], desired[k]
        substitute[k] = v
        command[k] = v + time_constant * speed[k] / angle_constant * (desired[k] - v)
    state[0], state[1], state[2] = v, last_angle, last
    return angle.size


class FirstOrderInvariance:
    """Correction elements Wk2 and Wk1 of a first-order plant; at rest before the first sample.

    Args:
        time_constant: T0 of the plant [s].
        angle_constant: θ0 of the substitute [rad]; with θ0 = T0·Ω0 the substitute equals the plant at the nominal
            speed.
    """

    def __init__(self, time_constant: float, angle_constant: float) -> None:
        self._time_constant, self._angle_constant = time_constant, angle_constant
        self._state = np.array([0.0, np.nan, 0.0])

    def block(self, *, angle: Array, speed: Array, desired: Array, substitute: Array, command: Array) -> None:
        """Compute one block; all arrays have the shape (n,).

        Args:
            angle: spindle angle [rad], non-decreasing.
            speed: spindle speed Ω [rad/s].
            desired: set point Y, in any unit; linear in the angle between samples.
            substitute: filled with v, the output of Wk2, which is also the output of the plant.
            command: filled with u, the input of the plant.

        Raises:
            LatheError: the angle decreases.
        """
        reached = _advance(
            self._time_constant, self._angle_constant, self._state, angle, speed, desired, substitute, command
        )  # fmt: skip
        if reached < angle.size:
            raise LatheError(f"the spindle turns back to {angle[reached]:.6g} rad; invariance needs a rising angle")
