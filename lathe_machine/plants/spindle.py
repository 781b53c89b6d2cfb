# SPDX-License-Identifier: Apache-2.0
"""Spindle under the load of the cut: motor, belt and spindle, a speed loop, and the torque of the cutting force.

The speed law is the motion of the spindle without a load; the model describes the deviations from this motion. With the
deviations δ of the spindle angle and ϑ of the motor angle, and all quantities referred to the spindle,

    J·δ''  = B - r·F,       B = k·(ϑ - δ) + c·(ϑ' - δ')
    Jm·ϑ'' = T - B,         T = Kp·(-ϑ') + Ki·∫(-ϑ')dt

or, with a rigid belt, (J + Jm)·δ'' = T - r·F. The speed loop is sampled: the torque of a sample is held until the next
one. The motor also accelerates both masses according to the law, and its torque limit applies to the sum. While the sum
is clipped, the integral is frozen. The load is linear between samples.

With a load of 0, or an inertia that no load can move, the results are bit-identical to the law.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_machine.plants.linear import discretise
from lathe_rc.arrays import Array, put
from lathe_rc.errors import InputError, LatheError
from lathe_rc.jit import kernel

_DONE, _OVERLOADED, _OUT_OF_SPEED = 0, 1, 2
STOPS = {
    _OVERLOADED: "overloaded: the cut loads the spindle beyond largest_load",
    _OUT_OF_SPEED: "out of speed: the load changes the speed beyond largest_deviation",
}  #: reasons to stop, in words
_INTEGRAL, _LOAD, _SPEED = 0, 1, 2  # indices in the state of the loop


@dataclass(frozen=True)
class Belt:
    """Belt between motor and spindle; values are referred to the spindle.

    Attributes:
        stiffness: k [N·m/rad].
        damping: c [N·m·s/rad].
    """

    stiffness: float
    damping: float


@dataclass(frozen=True)
class SpeedLoop:
    """PI control of the speed of the spindle motor.

    Attributes:
        bandwidth: Kp divided by the sum of both inertias [rad/s].
        integral_time: Kp/Ki [s].
        torque_limit: limit of the motor torque, referred to the spindle [N·m]; inf for no limit.
    """

    bandwidth: float
    integral_time: float
    torque_limit: float = np.inf

    def gains(self, inertia: float) -> tuple[float, float]:
        """Return Kp [N·m·s/rad] and Ki [N·m/rad] of the speed loop for the sum of the inertias [kg·m²]."""
        proportional = self.bandwidth * inertia
        return proportional, proportional / self.integral_time


class SpindleTable(NamedTuple):
    """Spindle under load with its state, for kernels (see `LoadedSpindle`).

    Attributes:
        step: sampling step [s].
        transition: transition matrix of δ, δ' and, with a belt, ϑ, ϑ', shape (m, m).
        motor: weights of the motor's torque, shape (m,).
        load: weights of the loads of a sample and of the previous one, shape (m, 2).
        measured: index of the motor speed in the state.
        proportional, integral: Kp, Ki.
        inertia: inertia of both masses [kg·m²].
        torque_limit: limit of the motor torque [N·m].
        radius: r [m].
        largest_load, largest_deviation: limits beyond which a run ends [N·m, rad/s].
        state: shape (m,).
        loop: integral of the speed loop, and load and speed of the law at the last sample.
        limited: ring buffer of flags, 1 where the torque was clipped; sample n is at index n modulo the size.
    """

    step: float
    transition: Array
    motor: Array
    load: Array
    measured: int
    proportional: float
    integral: float
    inertia: float
    torque_limit: float
    radius: float
    largest_load: float
    largest_deviation: float
    state: Array
    loop: Array
    limited: npt.NDArray[np.uint8]


@kernel
def turn(spindle: SpindleTable, first: int, force: Array, angle: Array, speed: Array, torque: Array) -> tuple[int, int]:
    """Apply the load to a block of the speed law (implements `LoadedSpindle.block`); return stop index and reason."""
    state, loop, transition, step = spindle.state, spindle.loop, spindle.transition, spindle.step
    order, new = state.size, np.empty(state.size)
    for k in range(angle.size):
        n = first + k
        error = -state[spindle.measured]
        integral = loop[_INTEGRAL] + error * step
        asked = spindle.proportional * error + spindle.integral * integral
        # The motor also provides the torque of the law, which uses part of the limit but is not published.
        own = spindle.inertia * ((speed[k] - loop[_SPEED]) / step) if n > 0 else 0.0
        wanted = asked + own
        given = min(max(wanted, -spindle.torque_limit), spindle.torque_limit)
        limited = given != wanted
        torque[k] = given - own if limited else asked
        if not limited:
            loop[_INTEGRAL] = integral
        spindle.limited[n & (spindle.limited.size - 1)] = limited
        load = spindle.radius * force[k]
        for i in range(order):  # into another array, since each row needs the complete old state
            new[i] = spindle.motor[i] * torque[k] + spindle.load[i, 0] * load + spindle.load[i, 1] * loop[_LOAD]
            for j in range(order):
                new[i] += transition[i, j] * state[j]
        put(state, new)
        loop[_LOAD], loop[_SPEED] = load, speed[k]
        angle[k] += state[0]
        speed[k] += state[1]
        if abs(load) > spindle.largest_load:
            return k, _OVERLOADED
        if abs(state[1]) > spindle.largest_deviation:
            return k, _OUT_OF_SPEED
    return angle.size, _DONE


class LoadedSpindle:
    """Simulated spindle under the load of the cut; before sample 0 it does not deviate from its speed law.

    Args:
        inertia: J of spindle, chuck and part [kg·m²].
        motor_inertia: Jm, referred to the spindle [kg·m²].
        belt: belt between motor and spindle; None for a rigid belt.
        loop: speed control loop.
        radius: r at which the main cutting force acts [m].
        largest_load: torque of the cut beyond which the run ends [N·m].
        largest_deviation: speed deviation caused by the load beyond which the run ends [rad/s].
        step: sampling step [s].
        kept: number of samples for which the clipped flag is stored, a power of two.

    Attributes:
        table: constants and state for `turn`.

    Raises:
        InputError: the speed loop oscillates with the belt, or is too fast for the step.
    """

    def __init__(
        self,
        *,
        inertia: float,
        motor_inertia: float,
        belt: Belt | None = None,
        loop: SpeedLoop,
        radius: float,
        largest_load: float = np.inf,
        largest_deviation: float = np.inf,
        step: float,
        kept: int = 1,
    ) -> None:
        whole = inertia + motor_inertia
        a = np.array([[0.0, 1.0], [0.0, 0.0]])
        drives, loads, measured = np.array([0.0, 1.0 / whole]), np.array([0.0, -1.0 / whole]), 1
        if belt:
            twist = np.array([-belt.stiffness, -belt.damping, belt.stiffness, belt.damping])
            a = np.array([[0.0, 1.0, 0.0, 0.0], twist / inertia, [0.0, 0.0, 0.0, 1.0], -twist / motor_inertia])
            drives, loads = np.array([0.0, 0.0, 0.0, 1.0 / motor_inertia]), np.array([0.0, -1.0 / inertia, 0.0, 0.0])
            measured = 3
        motor, load = (discretise(a, part, 0.0, step, "foh") for part in (drives, loads))
        proportional, integral = loop.gains(whole)
        self.table = SpindleTable(
            step=step,
            transition=motor.transition,
            motor=motor.weights.sum(axis=1),  # the torque is held over a step
            load=np.ascontiguousarray(load.weights[:, :2]),
            measured=measured,
            proportional=proportional,
            integral=integral,
            inertia=whole,
            torque_limit=loop.torque_limit,
            radius=radius,
            largest_load=largest_load,
            largest_deviation=largest_deviation,
            state=np.zeros(a.shape[0]),
            loop=np.zeros(3),
            limited=np.zeros(kept, np.uint8),
        )
        radius_of_poles = self._largest_pole()
        if not radius_of_poles < 1.0:
            raise InputError(
                f"speed loop of {loop.bandwidth:g} rad/s: largest pole {radius_of_poles:.6g}; allowed: below 1 (less "
                "bandwidth or a longer integral time; a stiff belt needs damping)"
            )

    def _largest_pole(self) -> float:
        """Return the largest pole magnitude of the unlimited speed loop, excluding the uncontrolled δ."""
        table = self.table
        order = table.state.size
        row = np.zeros(order + 1)
        row[table.measured], row[order] = -(table.proportional + table.integral * table.step), table.integral
        closed = np.zeros((order + 1, order + 1))
        closed[:order, :order] = table.transition
        closed[:order] += np.outer(table.motor, row)
        closed[order, table.measured], closed[order, order] = -table.step, 1.0
        # With δ, the integral of δ' would appear twice, so the twist of the belt takes the place of δ and ϑ.
        if order > 2:
            change = np.eye(order + 1)
            change[2, 0] = -1.0
            closed = change @ closed @ np.linalg.inv(change)
        return float(np.abs(np.linalg.eigvals(closed[1:, 1:])).max())

    def block(self, first: int, force: Array, angle: Array, speed: Array) -> Array:
        """Apply the load to a block of the speed law, starting at sample ``first``.

        Args:
            first: index of the first sample.
            force: main cutting force [N], shape (n,).
            angle: angle of the law [rad]; replaced by the true angle.
            speed: speed of the law [rad/s]; replaced by the true speed.

        Returns:
            Torque that the speed loop adds to the motor torque at each sample [N·m], shape (n,).

        Raises:
            LatheError: the load or the deviation is larger than allowed.
        """
        torque = np.empty_like(angle)
        reached, reason = turn(self.table, first, force, angle, speed, torque)
        if reason != _DONE:
            raise failure(reason, self.table, angle[reached], force[reached])
        return torque


def failure(reason: int, spindle: SpindleTable, angle: float, force: float) -> LatheError:
    """Return the error for an overloaded spindle at an angle [rad] and with a cutting force [N]."""
    if reason == _OVERLOADED:
        return LatheError(
            f"the cut loads the spindle with {spindle.radius * force:.4g} N·m at {angle:.6g} rad; allowed: up to "
            f"largest_load = {spindle.largest_load:g} N·m"
        )
    return LatheError(
        f"the load changes the speed by {spindle.state[1]:.4g} rad/s at {angle:.6g} rad; allowed: up to "
        f"{spindle.largest_deviation:.4g} rad/s (less force, more inertia, a faster speed loop, or a larger "
        "largest_deviation)"
    )
