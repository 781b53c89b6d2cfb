# SPDX-License-Identifier: Apache-2.0
"""Norm-optimal iterative learning over the spindle angle, with limits on the command.

    u = u_form + v,   v = Σ_n Re(V_n·e^{jnφ}),   n = 0 … N
    V <- the V with the least Σ_n |E_n - Z_n·(V_n - U_n)|² + r·|V_n - U_n|²  and  |u|, |du/dt|, |d²u/dt²| within limits

where U is the V so far, E_n are the harmonics of the error of a revolution, and Z_n = Wi(jnΩ)·e^{jnΩτ} is the model of
the drive without its delay, since v is read ahead by it. u_form is the form fed forward, as in `form_law`.
A new V takes over within half a revolution, so every second revolution is learned from; in the first one the drive
settles. Without active limits the law is V = U + conj(Z)·E/(|Z|² + r).

Source: Amann, Owens, Rogers (1996, IEE Proc. Control Theory Appl. 143), Mishra, Topcu, Tomizuka (2011, IEEE Trans.
Control Syst. Technol. 19) for limits.
"""

from collections.abc import Callable
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from annotated_types import Ge, Le

from lathe_machine.control.angle_filter import at
from lathe_machine.control.angle_memory import soft
from lathe_machine.control.norm_optimal import nearest, waves
from lathe_machine.stages.learning.form_law import FormLaw, FormLawParameters, ForwardTable, fed_forward
from lathe_machine.stages.learning.law import Now
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.arrays import Array, Complex, Integers
from lathe_rc.cell.parameters import NonNegative, Positive, parameter
from lathe_rc.jit import kernel

_TURN = 2.0 * np.pi
_PER_WAVE = 8  # angles per shortest wave at which the limits hold
_REVOLUTION, _SINCE, _LEARNS = range(3)  # number of the revolution, revolutions since V changed, whether all is learned
_BEGAN, _AHEAD, _SPEED = range(3)  # angle from which the new V takes over, newest such angle [rad], and speed [rad/s]


class NormOptimalControllerParameters(FormLawParameters):
    """Orders that are learned, weight of their changes, and limits on the command."""

    highest_order: Annotated[int, Ge(1), Le(64)] = parameter(12, "N: waves per revolution that are learned at most")
    change_weight: Positive = parameter(0.1, "r: weight of a change of the command beside the error")
    command_stroke: NonNegative = parameter(0.0, "largest command either way; 0: no limit", "m")
    command_velocity: NonNegative = parameter(0.0, "its largest velocity; 0: no limit", "m/s")
    command_acceleration: NonNegative = parameter(0.0, "its largest acceleration; 0: no limit", "m/s^2")


class Memory(NamedTuple):
    """State and constants of the norm-optimal law.

    Attributes:
        forward: feed-forward of the part profile, computed with the drive's inverse.
        step: sampling step [s].
        asks: whether a revolution has ended, shape (1,).
        sums: harmonics of the error and of the feed-forward in the current revolution [m], cosines and sines, shape
            (4, N + 1).
        given, before: V and the one before, cosines and sines [m], shape (2, N + 1).
        whole, place: integer and real state, indexed by the module's constants.
    """

    forward: ForwardTable
    step: float
    asks: Integers
    sums: Array
    given: Array
    before: Array
    whole: Integers
    place: Array


@kernel
def sample(memory: Memory, now: Now) -> float:
    """Return the law's command at one sample [m]."""
    forward, sums, whole, place = memory.forward, memory.sums, memory.whole, memory.place
    command = fed_forward(forward, now.angle)
    ahead, _, _ = at(forward.spindle, forward.ahead)
    if now.sample >= forward.late:
        past, turning, _ = at(forward.spindle, -forward.late * memory.step)
        share = turning * memory.step / np.pi
        for k, (value, angle) in enumerate(((now.error, past), (command, ahead))):
            one, two = np.cos(angle), np.sin(angle)
            cosine, sine = 0.5 * share * value, 0.0
            for n in range(sums.shape[1]):
                sums[2 * k, n] += cosine
                sums[2 * k + 1, n] += sine
                cosine, sine = cosine * one - sine * two, sine * one + cosine * two
                if n == 0:
                    cosine, sine = 2.0 * cosine, 2.0 * sine
        if not now.learning:
            whole[_LEARNS] = 0
        turn = int(np.floor(past / _TURN))
        if turn > whole[_REVOLUTION]:
            whole[_REVOLUTION] = turn
            place[_AHEAD], place[_SPEED] = ahead, turning
            memory.asks[0] = 1
    part = soft(max((ahead - place[_BEGAN]) / np.pi, 0.0))
    one, two = np.cos(ahead), np.sin(ahead)
    cosine, sine = 1.0, 0.0
    for n in range(sums.shape[1]):
        command += cosine * (memory.before[0, n] + part * (memory.given[0, n] - memory.before[0, n]))
        command += sine * (memory.before[1, n] + part * (memory.given[1, n] - memory.before[1, n]))
        cosine, sine = cosine * one - sine * two, sine * one + cosine * two
    return command


class NormOptimalController(FormLaw):
    """Law that learns the best command within limits for every second revolution."""

    kind = "norm_optimal_controller"
    Parameters = NormOptimalControllerParameters
    parameters: NormOptimalControllerParameters
    sample: ClassVar[Callable[[Any, Now], float]] = staticmethod(sample)

    def start(self) -> Memory:
        """Return the initial state of the law, before the first sample."""
        orders = self.parameters.highest_order + 1
        return Memory(
            forward=self.make_forward(),
            step=self.parameters.step,
            asks=np.zeros(1, np.int64),
            sums=np.zeros((4, orders)),
            given=np.zeros((2, orders)),
            before=np.zeros((2, orders)),
            whole=np.array([-(1 << 62), -1, 1]),  # the drive settles in the first revolution
            place=np.zeros(3),
        )

    def _model(self, frequency: Array) -> Complex:
        a1, a2 = self.parameters.second_order
        return np.asarray(1.0 / (1.0 + 1j * frequency * a1 - frequency**2 * a2))

    def contraction(self, drive: Response, waves: Array, speed: float) -> Complex:
        """Return 1 - conj(Z)·Zt/(|Z|² + r) for the true drive's Zt without active limits, shape (n,)."""
        frequency = waves * speed
        known, true = self._model(frequency), drive(frequency) * np.exp(1j * frequency * self.parameters.model_delay)
        return np.asarray(1.0 - known.conj() * true / (np.abs(known) ** 2 + self.parameters.change_weight))

    def highest_waves(self, speed: float) -> float:
        """Return the highest order that is learned."""
        return float(self.parameters.highest_order)

    def asked(self) -> None:
        """Learn from the revolution that has ended, unless a new V began in it."""
        memory = self.law
        whole, place = memory.whole, memory.place
        whole[_SINCE] += 1
        if whole[_SINCE] > 1 and whole[_LEARNS]:
            self._learn(memory)
            place[_BEGAN], whole[_SINCE] = place[_AHEAD], 0
        memory.sums[:], whole[_LEARNS] = 0.0, 1

    def _learn(self, memory: Memory) -> None:
        parameters, speed = self.parameters, float(memory.place[_SPEED])
        orders = parameters.highest_order
        model = self._model(speed * np.arange(orders + 1, dtype=float))
        weight = np.abs(model) ** 2 + parameters.change_weight
        error = memory.sums[0] - 1j * memory.sums[1]
        change = model.conj() * error / weight
        wanted = np.concatenate((memory.given[0] + change.real, memory.given[1, 1:] - change.imag[1:]))
        form = np.concatenate((memory.sums[2], memory.sums[3, 1:]))
        weights = np.concatenate((weight[:1], 0.5 * weight[1:], 0.5 * weight[1:]))
        angle = np.arange(_PER_WAVE * orders, dtype=float) * (_TURN / (_PER_WAVE * orders))
        limits = (parameters.command_stroke, parameters.command_velocity, parameters.command_acceleration)
        rows = [waves(angle, orders, k) * (speed**k / limit) for k, limit in enumerate(limits) if limit]
        if rows:
            both = np.concatenate((*rows, *(-each for each in rows)))
            wanted = nearest(wanted, weights, both, 1.0 - both @ form)
        memory.before[:] = memory.given
        memory.given[0], memory.given[1, 1:] = wanted[: orders + 1], wanted[orders + 1 :]
