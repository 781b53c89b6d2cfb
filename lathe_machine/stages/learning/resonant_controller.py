# SPDX-License-Identifier: Apache-2.0
"""Adaptive feed-forward cancellation whose resonators are indexed by the spindle angle.

    u = u_form + Σ_k a_k·cos kφ + b_k·sin kφ,    k = 0 … K
    da_k/dt = 2g·e·cos(kφ + θ_k)/|Wi(jkΩ)|,  db_k/dt = 2g·e·sin(kφ + θ_k)/|Wi(jkΩ)|,    θ_k = arg Wi(jkΩ)

with the error e of ``feedback_delay`` samples ago and the angle of that sample. In the angle domain, each order is an
internal model of its own that is valid at any speed. u_form is the form fed forward through the inverse of the drive,
as defined in `lathe_machine.stages.learning.form_law`.

Source: Guo, Bodson (doi 10.1002/acs.1117): equivalence with an internal model at any rate of change of the frequency.
"""

from collections.abc import Callable
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from annotated_types import Ge, Le

from lathe_machine.control.angle_filter import at
from lathe_machine.stages.learning.form_law import FormLaw, FormLawParameters, ForwardTable, fed_forward
from lathe_machine.stages.learning.law import Now
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.arrays import Array, Complex
from lathe_rc.cell.parameters import Positive, parameter
from lathe_rc.jit import kernel


class ResonantControllerParameters(FormLawParameters):
    """Orders to be cancelled, and the rate of adaptation."""

    highest_order: Annotated[int, Ge(0), Le(64)] = parameter(24, "K: waves per revolution that are cancelled at most")
    rate: Positive = parameter(8.0, "g: how fast an order is taken up", "1/s")


class Memory(NamedTuple):
    """State and constants of the resonant law.

    Attributes:
        forward: feed-forward of the part profile, computed with the drive's inverse.
        step: sampling step [s].
        gain: 2g·step.
        amplitudes: a and b by order, shape (2, K + 1) [m].
    """

    forward: ForwardTable
    step: float
    gain: float
    amplitudes: Array


@kernel
def sample(memory: Memory, now: Now) -> float:
    """Return the law's command at one sample [m]."""
    forward, amplitudes = memory.forward, memory.amplitudes
    command = fed_forward(forward, now.angle)
    spindle, a1, a2 = forward.spindle, forward.a1, forward.a2
    if now.sample >= forward.late and now.learning:
        past, turning, _ = at(spindle, -forward.late * memory.step)
        amplitudes[0, 0] += 0.5 * memory.gain * now.error
        # cos and sin of k·(φ - Ωτ) by rotation; 1/Wi = (1 + a1·p + a2·p²)·e^{pτ} contributes the rest of the phase.
        one, two = np.cos(past - turning * forward.ahead), np.sin(past - turning * forward.ahead)
        cosine, sine = one, two
        for k in range(1, amplitudes.shape[1]):
            p = k * turning
            real, imaginary = memory.gain * now.error * (1.0 - a2 * p * p), memory.gain * now.error * a1 * p
            amplitudes[0, k] += cosine * real + sine * imaginary
            amplitudes[1, k] += sine * real - cosine * imaginary
            cosine, sine = cosine * one - sine * two, sine * one + cosine * two
    one, two = np.cos(spindle.state[0]), np.sin(spindle.state[0])
    cosine, sine = 1.0, 0.0
    for k in range(amplitudes.shape[1]):
        command += amplitudes[0, k] * cosine + amplitudes[1, k] * sine
        cosine, sine = cosine * one - sine * two, sine * one + cosine * two
    return command


class ResonantController(FormLaw):
    """Law that cancels the harmonics of the error order by order."""

    kind = "resonant_controller"
    Parameters = ResonantControllerParameters
    parameters: ResonantControllerParameters
    sample: ClassVar[Callable[[Any, Now], float]] = staticmethod(sample)
    remedy = "a smaller rate, fewer orders, or a model nearer to the drive"

    def start(self) -> Memory:
        """Return the initial state of the law, before the first sample."""
        parameters = self.parameters
        return Memory(
            self.make_forward(),
            parameters.step,
            2.0 * parameters.rate * parameters.step,
            np.zeros((2, parameters.highest_order + 1)),
        )

    def characteristic(self, drive: Response, frequency: Array, speed: float) -> tuple[Complex, Complex]:
        """Return D and F of the characteristic function at a constant ``speed`` [rad/s], shape (n,) each."""
        parameters, back = self.parameters, np.exp(-1j * frequency * self.parameters.step)
        late = parameters.feedback_delay * parameters.step
        a1, a2 = parameters.second_order
        turn = speed * parameters.step
        # With t = k·turn, the sum of Re C·e^{jtn}/zⁿ over n is (Re C - Re(C·e^{-jt})/z)/(1 - 2·cos(t)/z + 1/z²).
        own, orders = (1.0 - back) / (1.0 - np.exp(-turn) * back), 1.0 / (1.0 - back)
        for k in range(1, parameters.highest_order + 1):
            order = k * speed
            inverse = (1.0 + 1j * a1 * order - a2 * order**2) * np.exp(1j * order * (parameters.model_delay + late))
            resonance = 1.0 - 2.0 * np.cos(k * turn) * back + back**2
            resonance = np.where(resonance == 0.0, np.finfo(float).tiny, resonance)
            own = own * resonance / (1.0 - np.exp(-k * turn) * back) ** 2
            orders = orders + 2.0 * (inverse.real - (inverse * np.exp(-1j * k * turn)).real * back) / resonance
        adapted = parameters.rate * parameters.step * orders * own
        return own, np.asarray(drive(frequency) * adapted * back**parameters.feedback_delay)
