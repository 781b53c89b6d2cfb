# SPDX-License-Identifier: Apache-2.0
"""Compound law for non-circular turning: PID with input feed-forward and dynamic compensation.

The structure is that of PMC8878366, of which only the abstract was available: input feed-forward of the form with its
velocity and acceleration, dynamic compensation of the drive's lag (here by the drive's inverse and delay), and a PID on
the following error. The settings are our own, tuned under the conditions of ``lathe study robust``.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np

from lathe_machine.stages.learning.form_law import FormLaw, FormLawParameters, ForwardTable, fed_forward
from lathe_machine.stages.learning.law import Now
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.arrays import Array, Complex
from lathe_rc.cell.parameters import NonNegative, Positive, parameter
from lathe_rc.jit import kernel


class CompoundControllerParameters(FormLawParameters):
    """Input feed-forward and dynamic compensation from the model, and a PID on the measured error."""

    proportional: NonNegative = parameter(0.5, "of the PID, Kp")
    integral: NonNegative = parameter(700.0, "of the PID, Ki", "1/s")
    derivative: NonNegative = parameter(1.3e-3, "of the PID, Kd", "s")
    derivative_bandwidth: Positive = parameter(1600.0, "of its low-pass", "rad/s")


class Memory(NamedTuple):
    """State and constants of the compound law.

    Attributes:
        forward: feed-forward of the part profile, computed with the drive's inverse.
        proportional, integral, derivative: gains of the PID; the last two are per sample.
        keep: weight of the previous sample in the derivative's low-pass.
        state: integral, filtered derivative, previous error, shape (3,).
    """

    forward: ForwardTable
    proportional: float
    integral: float
    derivative: float
    keep: float
    state: Array


@kernel
def sample(memory: Memory, now: Now) -> float:
    """Return the law's command at one sample [m]."""
    state, late = memory.state, memory.forward.late
    command = fed_forward(memory.forward, now.angle)
    if now.sample < late:
        return command
    if now.sample == late:
        state[2] = now.error
    if now.learning:
        state[0] += memory.integral * now.error
    state[1] = memory.keep * state[1] + (1.0 - memory.keep) * memory.derivative * (now.error - state[2])
    state[2] = now.error
    return float(command + memory.proportional * now.error + state[0] + state[1])


class CompoundController(FormLaw):
    """Law with feed-forward of the form and a PID on the error."""

    kind = "compound_controller"
    Parameters = CompoundControllerParameters
    parameters: CompoundControllerParameters
    sample: ClassVar[Callable[[Any, Now], float]] = staticmethod(sample)
    remedy = "smaller gains of its PID"

    def start(self) -> Memory:
        """Return the initial state of the law, before the first sample."""
        parameters = self.parameters
        step = parameters.step
        return Memory(
            self.make_forward(),
            parameters.proportional,
            parameters.integral * step,
            parameters.derivative / step,
            float(np.exp(-parameters.derivative_bandwidth * step)),
            np.zeros(3),
        )

    def characteristic(self, drive: Response, frequency: Array, speed: float) -> tuple[Complex, Complex]:
        """Return D and F of the characteristic function at frequencies [rad/s], shape (n,) each."""
        parameters, back = self.parameters, np.exp(-1j * frequency * self.parameters.step)
        memory = self.start()
        lag = 1.0 - memory.keep * back
        own = (1.0 - back) / lag
        pid = memory.proportional * own + memory.integral / lag + memory.derivative * (1.0 - memory.keep) * own**2
        return own, np.asarray(drive(frequency) * pid * back**parameters.feedback_delay)
