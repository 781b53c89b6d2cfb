# SPDX-License-Identifier: Apache-2.0
"""Active disturbance rejection control (ADRC) with feed-forward of the form, as a law in a package of its own.

An extended state observer of third order estimates position z0, velocity z1 and disturbance z2 of the drive model
x'' + 2ζωn·x' + ωn²·x = ωn²·u(t - τ) + f from the measured position x, with all poles at -ωo:

    z0' = z1 + l0·(x - z0)                                  l0 = 3ωo - 2ζωn
    z1' = z2 + ωn²·(u - z0) - 2ζωn·z1 + l1·(x - z0)         l1 = 3ωo² - ωn² - 2ζωn·l0
    z2' = l2·(x - z0)                                       l2 = ωo³
    command = u_form + ((ωc² - ωn²)·(r - z0) + 2·(ωc - ζωn)·(r' - z1) - z2)/ωn²

The model is discretised exactly for a command that is linear between samples. The gains that correct its prediction
place the poles of the discrete observer at exp(-ωo·T), with the sampling step T; for a short step they approach T times
l0, l1 and l2. The position is ``feedback_delay`` samples old, so the observer uses the command u that had reached the
drive by then, and the form r of that sample. u_form is the form with its velocity and acceleration, fed forward through
the inverse of the model (`lathe_machine.stages.learning.form_law`); the feedback gives the error two poles at -ωc.

Source: Wu, Chen, Design and analysis of precision active disturbance rejection control for noncircular turning
process, IEEE Trans. Industrial Electronics 56 (2009), for the structure: observer, feedback of its states, and
acceleration feed-forward. The model inside the observer, its command of the past, and the settings are our own.
"""

import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np

from lathe_machine.control.angle_filter import at
from lathe_machine.plants.linear import discretise
from lathe_machine.signals.profile_table import derivatives_at
from lathe_machine.stages.learning.form_law import FormLaw, FormLawParameters, ForwardTable, fed_forward
from lathe_machine.stages.learning.law import Now
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.arrays import Array, Complex
from lathe_rc.cell.parameters import Positive, parameter
from lathe_rc.jit import kernel


class AdrcParameters(FormLawParameters):
    """Bandwidths of observer and feedback; the feed-forward has no settings beyond the model."""

    observer_bandwidth: Positive = parameter(1000.0, "ωo of the extended state observer", "rad/s")
    control_bandwidth: Positive = parameter(1000.0, "ωc of the feedback of its states", "rad/s")


class Memory(NamedTuple):
    """State and constants of the law.

    Attributes:
        forward: feed-forward of the form.
        step: sampling step [s].
        transition, weights: difference equation of z0, z1 and z2, shape (3, 3) each.
        age: age of the newest command in that equation [samples].
        gains: correction of z0, z1 and z2 per difference between the positions, shape (3,).
        stiffness, damping: gains of the feedback [1, s].
        commands: past commands; sample n is at index n modulo the length, a power of two [m].
        state: z0 [m], z1 [m/s], z2 [m/s²], shape (3,).
    """

    forward: ForwardTable
    step: float
    transition: Array
    weights: Array
    age: int
    gains: Array
    stiffness: float
    damping: float
    commands: Array
    state: Array


@kernel
def sample(memory: Memory, now: Now) -> float:
    """Return the command of the law at one sample [m]."""
    forward, z, commands = memory.forward, memory.state, memory.commands
    command, mask = fed_forward(forward, now.angle), commands.size - 1
    if now.sample >= forward.late:
        if now.sample == forward.late:  # the drive is assumed to be at rest at its first position
            z[0] = now.position
        k = now.sample - memory.age
        before = z[0], z[1], z[2]
        for i in range(3):
            z[i] = 0.0
            for j in range(3):
                z[i] += memory.transition[i, j] * before[j] + memory.weights[i, j] * commands[(k - j) & mask]
        off = now.position - z[0]
        for i in range(3):
            z[i] += memory.gains[i] * off
        angle, speed, _ = at(forward.spindle, -forward.late * memory.step)
        form = forward.form
        value, slope, _ = derivatives_at(form.heights, form.table, form.feed, form.start, form.part, angle)
        command += memory.stiffness * (value - z[0]) + memory.damping * (speed * slope - z[1]) - forward.a2 * z[2]
    commands[now.sample & mask] = command
    return command


def observer_gains(transition: Array, pole: float) -> Array:
    """Return the gains l [1, 1/s, 1/s²] that place all poles of (1 - l·c)·F at ``pole``, by Ackermann's formula.

    Args:
        transition: F of the difference equation of z0 [m], z1 [m/s] and z2 [m/s²], shape (3, 3); c·z is z0.
        pole: triple pole of the discrete observer [1].
    """
    seen = np.vstack([transition[0], transition[0] @ transition, transition[0] @ transition @ transition])
    return np.linalg.matrix_power(transition - pole * np.eye(3), 3) @ np.linalg.solve(seen, np.array([0.0, 0.0, 1.0]))


class Adrc(FormLaw):
    """Law that feeds the form forward, observes the disturbance as a third state, and feeds the states back."""

    kind = "adrc"
    Parameters = AdrcParameters
    parameters: AdrcParameters
    sample: ClassVar[Callable[[Any, Now], float]] = staticmethod(sample)
    remedy = "a smaller observer_bandwidth or control_bandwidth"

    def start(self) -> Memory:
        """Return the initial state of the law, before the first sample."""
        parameters, forward = self.parameters, self.make_forward()
        control, step = parameters.control_bandwidth, parameters.step
        square = 1.0 / forward.a2
        a = np.array([[0.0, 1.0, 0.0], [-square, -square * forward.a1, 1.0], [0.0, 0.0, 0.0]])
        delay = parameters.model_delay + parameters.feedback_delay * step
        model = discretise(a, np.array([0.0, square, 0.0]), delay, step, "foh")
        return Memory(
            forward=forward,
            step=step,
            transition=model.transition,
            weights=model.weights,
            age=model.delay,
            gains=observer_gains(model.transition, math.exp(-parameters.observer_bandwidth * step)),
            stiffness=forward.a2 * control**2 - 1.0,
            damping=2.0 * forward.a2 * control - forward.a1,
            commands=np.zeros(1 << (model.delay + 3).bit_length()),
            state=np.zeros(3),
        )

    def characteristic(self, drive: Response, frequency: Array, speed: float) -> tuple[Complex, Complex]:
        """Return D and F of the characteristic function at frequencies [rad/s], shape (n,) each.

        With the difference equation z = (1 - l·c)·(F·z/ζ + w·u) + l·x of the observer, ζ = e^{jωT}, and u = -k·z.
        """
        memory, back = self.start(), np.exp(-1j * frequency * self.parameters.step)
        left = np.eye(3) - memory.gains[:, None] @ np.eye(1, 3)
        seen, polynomial = left @ memory.transition, np.polynomial.polynomial
        # k·(1 - M/ζ)⁻¹ is a row of polynomials over det(1 - M/ζ), by the recursion of Faddeev and LeVerrier.
        below = np.poly(seen)
        rows = [np.array([memory.stiffness, memory.damping, memory.forward.a2])]
        for coefficient in below[1:3]:
            rows.append(rows[-1] @ seen + coefficient * rows[0])
        own = back**memory.age * polynomial.polyval2d(back, back, rows @ left @ memory.weights)
        fed = back**memory.forward.late * polynomial.polyval(back, rows @ memory.gains)
        whole = polynomial.polyval(back, below)
        return np.asarray(1.0 + own / whole), np.asarray(drive(frequency) * fed / whole)
