# SPDX-License-Identifier: Apache-2.0
"""Series summation (paper 001, Fig. 1b): the piezo with the tool rides on the coarse carriage.

Two masses, one mechanical system. With the carriage at x1, the tool at x2, the extension e that the piezo would have
without mass, and q = ω2²·(e - (x2 - x1)) - 2ζ2ω2·(x2 - x1)' the acceleration of the tool:

    x2'' = q
    x1'' = ω1²·(u(t - τ) - x1) - 2ζ1ω1·x1' - (m/M)·q

M is the carriage without the tool, and ω1, ζ1 are those of the servo with M alone: its spring Mω1² and damper 2ζ1ω1M
stand between the carriage and the delayed command, and only the command is delayed. m is the tool; ω2, ζ2 are those of
the tool on a blocked carriage. The piezo's force acts on the carriage in full.

This definition gives |1 - Wpk| = .0396 .1016 .1348 .1515 at 500 ... 2000 rad/s for m/M = 0.1, where Wpk is x2 over e.
The .039 .101 .133 .150 of spec/learning.md come out to all digits with ζ2 = 0.292, for which a blocked carriage gives
the .020 .040 .061 .083 printed beside them; with ζ2 = 0.299 both rows are 1-3 % higher. With ω1 referred to M + m two
entries are 5 % too low, with the servo's delay inside its loop one is 60 % too high.

For m/M -> 0 the carriage is the coarse drive and x2/e is that of the fine drive. What remains is no matter of the
mass ratio: the tool's inertia bends the piezo by -x1''/ω2² while the carriage accelerates.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import put
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.plants.end_stops import between_stops
from lathe_rc.plants.linear import DiscretePlant, Discretisation, discretise
from lathe_rc.plants.piezo import VOLTAGE, Stack, StackTable, extend
from lathe_rc.signals.noise import quantise

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

_CARRIAGE, _TOOL = 0, 2  # places of the positions in the state: x1, x1', x2, x2'
_ROUNDS = 32  # at most, to find the carriage's position and the extension of the same sample


class SeriesTable(NamedTuple):
    """A `SeriesDrive` for kernels.

    Attributes:
        transition: of both masses, shape (4, 4).
        coarse, fine: weights of the command and of the extension e, shape (4, 3).
        delay, part: of the command [sample].
        spring, damper, force_per_current: of the carriage's own loops.
        carriage_stroke: [m].
        stack, memory: of the piezo.
        full_voltage: [V].
        feedback: whether the carriage's measured position is taken off the set point.
        resolution: of its sensor [m].
        state: x1, x1', x2, x2' and the last e.
        line: a ring of past commands: sample n stands at n modulo its length.
        counts: samples at an end stop, and in saturation, so far.
    """

    transition: Array
    coarse: Array
    fine: Array
    delay: int
    part: float
    spring: float
    damper: float
    force_per_current: float
    carriage_stroke: float
    stack: StackTable
    memory: Array
    full_voltage: float
    feedback: bool
    resolution: float
    state: Array
    line: Array
    counts: npt.NDArray[np.int64]


@kernel
def advance(
    drive: SeriesTable,
    first: int,
    command: Array,
    set_point: Array,
    noise: Array,
    carriage: Array,
    carriage_velocity: Array,
    current: Array,
    measured: Array,
    extension: Array,
    extension_velocity: Array,
    voltage: Array,
) -> None:
    """Step both masses through a block, see `SeriesDrive.block`."""
    transition, coarse, fine, delay, part = drive.transition, drive.coarse, drive.fine, drive.delay, drive.part
    carriage_stroke, stack, memory, resolution = drive.carriage_stroke, drive.stack, drive.memory, drive.resolution
    state, line, feedback, size = drive.state, drive.line, drive.feedback, drive.line.size
    stopped = saturated = 0
    free, trial = np.empty(4), np.empty_like(memory)
    for k in range(command.size):
        n = first + k
        line[n % size] = command[k]
        u0, u1, u2 = line[(n - delay) % size], line[(n - delay - 1) % size], line[(n - delay - 2) % size]
        for i in range(4):
            free[i] = coarse[i, 0] * u0 + coarse[i, 1] * u1 + coarse[i, 2] * u2 + fine[i, 1] * state[4]
            for j in range(4):
                free[i] += transition[i, j] * state[j]
        if feedback:
            # The extension needs the carriage's position of this sample and moves it by a thousandth of itself.
            x1 = min(max(free[0] + fine[0, 0] * state[4], -carriage_stroke), carriage_stroke)
            for _ in range(_ROUNDS):
                guess = x1
                measured[k] = quantise(guess + noise[k], resolution)
                put(trial, memory)
                e, cut = extend(stack, trial, set_point[k] - measured[k])
                x1 = min(max(free[0] + fine[0, 0] * e, -carriage_stroke), carriage_stroke)
                if x1 == guess:
                    break
            put(memory, trial)
        else:
            e, cut = extend(stack, memory, set_point[k])
        saturated += cut
        for i in range(4):
            state[i] = free[i] + fine[i, 0] * e
        state[4] = e
        state[0], state[1], stops = between_stops(state[0], state[1], carriage_stroke)  # the tool swings on
        stopped += stops
        carriage[k], carriage_velocity[k] = state[0], state[1]
        if not feedback:
            measured[k] = quantise(state[0] + noise[k], resolution)
        delayed = (1.0 - part) * u0 + part * u1
        current[k] = (drive.spring * (delayed - state[0]) - drive.damper * state[1]) * drive.force_per_current
        extension[k], extension_velocity[k] = state[2] - state[0], state[3] - state[1]
        voltage[k] = memory[VOLTAGE] * drive.full_voltage
    drive.counts[0] += stopped
    drive.counts[1] += saturated


def seen_at(plant: DiscretePlant, place: int) -> DiscretePlant:
    """The same plant with another state as the first, whose response is asked for."""
    order = np.roll(np.arange(plant.transition.shape[0]), -place)
    return DiscretePlant(
        plant.transition[np.ix_(order, order)], plant.weights[order], plant.delay, plant.fraction, plant.step
    )


class SeriesDrive:
    """Both drives as one machine: command and set point in, motion of carriage and piezo out.

    Args:
        stack: amplifier and ceramics of the piezo; the drive takes over its state.
        carriage_frequency, carriage_damping: ω1 [rad/s], ζ1 [1].
        delay: τ of the command [s].
        carriage_stroke: end stops at ± this displacement [m].
        moving_mass: M [kg].
        force_constant: of the coil [N/A].
        tool_frequency, tool_damping: ω2 [rad/s], ζ2 [1].
        full_voltage: voltage at the piezo's full stroke [V].
        mass_ratio: m/M.
        feedback: direct compensation: the measured position of the carriage is taken off the piezo's set point,
            in the same sample.
        resolution: of the carriage's position sensor [m]; 0 for none.
        step: sampling step [s].
        method: discretisation, see `lathe_rc.plants.linear.discretise`.

    Attributes:
        table: for `advance`.

    Raises:
        InputError: direct compensation that would oscillate, or a step too coarse for it.
    """

    def __init__(
        self,
        stack: Stack,
        *,
        carriage_frequency: float,
        carriage_damping: float,
        delay: float,
        carriage_stroke: float,
        moving_mass: float,
        force_constant: float,
        tool_frequency: float,
        tool_damping: float,
        full_voltage: float,
        mass_ratio: float,
        feedback: bool,
        resolution: float,
        step: float,
        method: Discretisation,
    ) -> None:
        spring, damper = carriage_frequency**2, 2.0 * carriage_damping * carriage_frequency
        stiff, loss = tool_frequency**2, 2.0 * tool_damping * tool_frequency
        tool = np.array([stiff, loss, -stiff, -loss])
        a = np.array([[0.0, 1.0, 0.0, 0.0], -mass_ratio * tool, [0.0, 0.0, 0.0, 1.0], tool])
        a[1, :2] -= spring, damper
        self._coarse = discretise(a, np.array([0.0, spring, 0.0, 0.0]), delay, step, method)
        self._fine = discretise(a, np.array([0.0, -mass_ratio * stiff, 0.0, stiff]), 0.0, step, method)
        self._stack, self._feedback = stack, feedback
        self.table = SeriesTable(
            transition=self._coarse.transition,
            coarse=self._coarse.weights,
            fine=self._fine.weights,
            delay=self._coarse.delay,
            part=self._coarse.fraction,
            spring=spring,
            damper=damper,
            force_per_current=moving_mass / force_constant,
            carriage_stroke=carriage_stroke,
            stack=stack.table,
            memory=stack.state,
            full_voltage=full_voltage,
            feedback=feedback,
            resolution=resolution,
            state=np.zeros(5),
            line=np.zeros(self._coarse.delay + 3),
            counts=np.zeros(2, np.int64),
        )
        if feedback:
            self._check_feedback(mass_ratio)

    @property
    def stopped(self) -> int:
        """Samples so far that the carriage spent at an end stop."""
        return int(self.table.counts[0])

    @property
    def saturated(self) -> int:
        """Samples so far in which the piezo's set point or voltage was cut off."""
        return int(self.table.counts[1])

    def _check_feedback(self, mass_ratio: float) -> None:
        step = self._fine.step
        within = abs(self._fine.weights[_CARRIAGE, 0]) * self._stack.steepest
        if within >= 0.5:
            raise InputError(
                f"series drive: at a step of {step:g} s direct compensation moves the carriage by {within:.3g} of "
                "itself within a sample; allowed: below 0.5 (raise the sample rate)"
            )
        radius = self._feedback_radius()
        if radius >= 1.0:
            raise InputError(
                f"series drive: direct compensation oscillates over the carriage with m/M = {mass_ratio:g}: largest "
                f"pole {radius:.6g}; allowed: below 1 (more damping of the piezo or less mass on it)"
            )

    def _feedback_radius(self) -> float:
        """Largest magnitude of the poles under direct compensation, linearised, without creep."""
        table, fine = self._stack.table, self._fine
        # The state is x1, x1', x2, x2', e and the amplifier's input -x1; left·state[n] = right·state[n-1].
        left, right = np.eye(6), np.zeros((6, 6))
        left[:4, 4] = -fine.weights[:, 0]
        left[4, 5], left[5, _CARRIAGE] = -table.now, 1.0
        right[:4, :4], right[:4, 4] = fine.transition, fine.weights[:, 1]
        right[4, 4:] = table.decay, table.before
        return float(np.abs(np.linalg.eigvals(np.linalg.solve(left, right))).max())

    def _reaction(self, frequency: npt.ArrayLike) -> Complex:
        """Carriage over the piezo's set point, without feedback."""
        return np.asarray(self._stack.response(frequency) * seen_at(self._fine, _CARRIAGE).response(frequency))

    def response(self, frequency: npt.ArrayLike) -> Complex:
        """Wpk: tool over the piezo's set point at ``frequency`` [rad/s], with the feedback if there is one."""
        alone = self._stack.response(frequency) * seen_at(self._fine, _TOOL).response(frequency)
        return np.asarray(alone / (1.0 + self._reaction(frequency)) if self._feedback else alone)

    def coarse_response(self, frequency: npt.ArrayLike) -> Complex:
        """Carriage over its command at ``frequency`` [rad/s], with the feedback if there is one."""
        alone = seen_at(self._coarse, _CARRIAGE).response(frequency)
        return np.asarray(alone / (1.0 + self._reaction(frequency)) if self._feedback else alone)

    def block(
        self,
        first: int,
        command: Array,
        set_point: Array,
        noise: Array,
        carriage: Array,
        carriage_velocity: Array,
        current: Array,
        measured: Array,
        extension: Array,
        extension_velocity: Array,
        voltage: Array,
    ) -> None:
        """Step from sample ``first`` on; at rest at 0 before sample 0. Arrays of shape (n,), the last seven filled.

        Args:
            first: index of the first sample.
            command: set point of the carriage [m].
            set_point: of the piezo, without what the feedback takes off [m].
            noise: of the carriage's position sensor [m].
            carriage: its true position [m].
            carriage_velocity: [m/s].
            current: of the coil [A].
            measured: position of the carriage as its sensor reads it [m].
            extension: of the piezo, the tool against the carriage [m].
            extension_velocity: [m/s].
            voltage: at the piezo [V].
        """
        advance(
            self.table, first, command, set_point, noise, carriage, carriage_velocity, current, measured, extension,
            extension_velocity, voltage,
        )  # fmt: skip
