# SPDX-License-Identifier: Apache-2.0
"""Parallel PID controller for sampled signals.

    u = P·e + I·∫e dt + D·N·p/(p + N)·e,   e = set point - measurement

Integral and derivative are exact for an error that is linear between the samples at which the controller computes.
While the command is at a limit and the error drives it further out, the integral is held (clamping). Converters
round the measurement to the step of the ADC, and the command to that of the DAC. With a rate-limited set point,
smoothed as 1 - e^{-t/T}, the tool enters the cut without overshoot of the force.

The integral can be frozen. While another controller provides the command, a waiting controller with ramp or smoothing
sets its set point equal to the measurement, so that the set point starts there when control resumes, as at the start
of a run.

Source: paper 004, Figs 11 and 12. The paper uses mm, N and % of the full command; here the units are m, N and 1.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lathe_machine.transfer import TransferFunction
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.noise import quantise

# Indices in the state of a controller.
_INTEGRAL, _SLOPE, _ERROR, _SET_POINT, _COMMAND, SATURATED, CLAMPED, SLOWED, _STANDS, _WAITS, _SIZE = range(11)


@dataclass(frozen=True)
class PidGains:
    """Gains of a parallel PID, in units of the command per unit of the error.

    Args:
        proportional: P.
        integral: I [1/s].
        derivative: D [s].
        filter: N, bandwidth of the derivative [rad/s].

    Raises:
        InputError: a gain is not finite, or N is not above 0.
    """

    proportional: float
    integral: float
    derivative: float
    filter: float

    def __post_init__(self) -> None:
        values = (self.proportional, self.integral, self.derivative, self.filter)
        if not np.all(np.isfinite(values)) or self.filter <= 0.0:
            raise InputError(
                f"PID gains P {values[0]:g}, I {values[1]:g}, D {values[2]:g}, N {values[3]:g}; "
                "allowed: finite gains and N above 0"
            )

    @property
    def transfer(self) -> TransferFunction:
        """Transfer function from error to command, without the poles of terms with gain 0."""
        whole = TransferFunction((self.proportional,), (1.0,))
        if self.derivative:
            kick = self.proportional + self.derivative * self.filter
            whole = TransferFunction((kick, self.proportional * self.filter), (1.0, self.filter))
        if self.integral:
            top = np.polyadd((*whole.numerator, 0.0), np.multiply(self.integral, whole.denominator))
            whole = TransferFunction(tuple(np.trim_zeros(top, "f")), (*whole.denominator, 0.0))
        return whole


FORCE = PidGains(0.52733e-2, 1.4848e-2, 0.046435e-2, 1874.8107)  #: gains of the force loop [1/N] (paper 004, Fig. 12)
POSITION = PidGains(13510.2, 110691.7, 452.539, 4147.9572)  #: gains of the position loop [1/m] (paper 004, Fig. 11)


class PidTable(NamedTuple):
    """Constants of a `Pid` for kernels.

    Attributes:
        proportional: P.
        integral: weight of the sum of two successive errors in the integral.
        derivative: weight of the difference between two successive errors in the derivative.
        decay: decay factor of the derivative per computation.
        low, high: limits of the command.
        adc, dac: steps of the converters; 0 for no rounding.
        ramp: largest change of the set point from one computation to the next; 0 for no limit.
        approach: fraction of the remaining change of the set point made per computation; 1 for no smoothing.
        divisor: number of samples between two computations.
    """

    proportional: float
    integral: float
    derivative: float
    decay: float
    low: float
    high: float
    adc: float
    dac: float
    ramp: float
    approach: float
    divisor: int


@inlined
def control(pid: PidTable, state: Array, n: int, set_point: float, measurement: float) -> float:
    """Compute the command of sample ``n``, and update ``state``, including its counters of limited samples."""
    if n % pid.divisor:
        return float(state[_COMMAND])
    way = set_point - state[_SET_POINT]
    move = pid.approach * way
    if pid.ramp > 0.0:
        move = min(max(move, -pid.ramp), pid.ramp)
    # At the end the set point itself, since a rounding error of the sum might keep it from being reached.
    wanted = set_point if move == way else state[_SET_POINT] + move
    read = quantise(measurement, pid.adc)
    if state[_WAITS] > 0.0 and (pid.ramp > 0.0 or pid.approach < 1.0):
        wanted = read
    state[SLOWED] += wanted != set_point
    state[_SET_POINT] = wanted
    error = wanted - read
    slope = pid.decay * state[_SLOPE] + pid.derivative * (error - state[_ERROR])
    more = 0.0 if state[_STANDS] > 0.0 else pid.integral * (error + state[_ERROR])
    rest = pid.proportional * error + slope
    demand = rest + state[_INTEGRAL] + more
    if (demand > pid.high and more > 0.0) or (demand < pid.low and more < 0.0):
        state[CLAMPED] += 1.0
    else:
        state[_INTEGRAL] += more
    command = float(min(max(demand, pid.low), pid.high))
    state[SATURATED] += command != demand
    if pid.dac > 0.0:
        # Limited again, since rounding to the DAC step may exceed a limit.
        command = float(min(max(quantise(command, pid.dac), pid.low), pid.high))
    state[_SLOPE], state[_ERROR], state[_COMMAND] = slope, error, command
    return command


@kernel
def enable_integrator(state: Array, on: bool, waits: bool) -> None:  # noqa: FBT001 - kernels take them by position
    """Set whether a `Pid` integrates, and whether it waits while another controller provides the command."""
    state[_STANDS], state[_WAITS] = 0.0 if on else 1.0, 1.0 if waits else 0.0


@kernel
def control_along(
    pid: PidTable, state: Array, first: int, set_point: Array, measurement: Array, command: Array
) -> None:
    """Compute the commands of a block that begins at sample ``first`` with `control`, shape (n,)."""
    for k in range(command.size):
        command[k] = control(pid, state, first + k, set_point[k], measurement[k])


class Pid:
    """PID controller with output limits and converter quantisation; at rest at 0 before sample 0.

    Args:
        gains: gains P, I, D and filter N.
        low, high: limits of the command, in its unit.
        step: sampling step [s].
        adc: step of the measurement's converter, in the unit of the measurement; 0 for no rounding.
        dac: step of the command's converter, in the unit of the command; 0 for no rounding.
        ramp: largest rate of the set point, in its unit per s; 0 for no limit.
        smoothing: time constant of the set point [s]; 0 for none.
        divisor: the command is computed at samples that are multiples of ``divisor``, and held in between.

    Attributes:
        table: constants for `control`.
        state: state for `control`.

    Raises:
        InputError: the lower limit is not below the upper one, a converter step, the ramp or the smoothing is negative,
            or the divisor is below 1.
    """

    def __init__(
        self,
        gains: PidGains,
        *,
        low: float,
        high: float,
        step: float,
        adc: float = 0.0,
        dac: float = 0.0,
        ramp: float = 0.0,
        smoothing: float = 0.0,
        divisor: int = 1,
    ) -> None:
        if not low < high:
            raise InputError(f"PID: limits {low:g} to {high:g}; allowed: a lower one below the upper one")
        if divisor < 1:
            raise InputError(f"PID: divisor {divisor}; allowed: 1 or more")
        for name, value in (("ADC step", adc), ("DAC step", dac), ("ramp", ramp), ("smoothing", smoothing)):
            if not 0.0 <= value < np.inf:
                raise InputError(f"PID: {name} {value:g}; allowed: 0 for none, or a finite positive number")
        period = step * divisor
        self.table = PidTable(
            proportional=gains.proportional,
            integral=gains.integral * period / 2.0,
            derivative=gains.derivative * float(-np.expm1(-gains.filter * period)) / period,
            decay=float(np.exp(-gains.filter * period)),
            low=float(low),
            high=float(high),
            adc=float(adc),
            dac=float(dac),
            ramp=float(ramp) * period,
            approach=float(-np.expm1(-period / smoothing)) if smoothing else 1.0,
            divisor=divisor,
        )
        self.state = np.zeros(_SIZE)

    @property
    def saturated(self) -> int:
        """Number of computations with a limited command."""
        return int(self.state[SATURATED])

    @property
    def clamped(self) -> int:
        """Number of computations in which the integral was clamped."""
        return int(self.state[CLAMPED])

    @property
    def slowed(self) -> int:
        """Number of computations in which the ramp or the smoothing changed the set point."""
        return int(self.state[SLOWED])

    def block(self, first: int, set_point: Array, measurement: Array, command: Array) -> None:
        """Compute the commands of a block starting at sample ``first`` into ``command``; arrays of shape (n,)."""
        control_along(self.table, self.state, first, set_point, measurement, command)
