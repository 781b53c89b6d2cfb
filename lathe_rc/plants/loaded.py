# SPDX-License-Identifier: Apache-2.0
"""Tool drives under the cutting force: drives and cut as one mechanical system.

The radial part ρ·F of the cutting force F pushes the tool out of the part. Alone, the electrodynamic drive carries the
tool (mass m at x); in series a piezo of mass ratio r = mt/M with the tool at x2 rides on its carriage at x1
(`lathe_rc.plants.series`):

    m·x''   = k·i + ρ·F
    mt·x2'' = mt·q + ρ·F,    q = ω2²·(e - (x2 - x1)) - 2ζ2ω2·(x2 - x1)'
    M·x1''  = k·i - mt·q

The stack's stiffness is mt·ω2². The coil's current i comes from the drive's position loop

    i* = (m/k)·(ω1²·(u(t - τ) - x1) - 2ζ1ω1·x1')

either at once (``coil=None``: the second-order drive of papers 000 and 001, to the bit where there is no force), or by
a current loop. That is a sampled one with the step of the cell: from the state of a sample it gives the voltage U that
stands until the next one,

    L·di/dt = U - R·i - k·x1',    U = ωc·(L·(i* - i) + R·∫(i* - i)dt)

so that i/i* is about 1/(1 + p/ωc). i* may be limited in size and slope, U in size; while U is cut off the integral
stands.

What drives and cut do to each other within a sample is solved with the chip, see `lathe_rc.plants.cutting`: the force
of sample n moves the tool that makes the chip of sample n. The force acts on the drives as linear between samples.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError, LatheError
from lathe_rc.jit import inlined, kernel
from lathe_rc.plants.cutting import DRAWN_IN, CutTable, CuttingProcess, chip_of, held, leave, meet, press
from lathe_rc.plants.cutting import failure as failure_of_cut
from lathe_rc.plants.linear import Discretisation, discretise, second_order
from lathe_rc.plants.piezo import VOLTAGE, Stack, StackTable, extend
from lathe_rc.plants.series import SeriesDrive, seen_at
from lathe_rc.signals.noise import quantise

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

_ROUNDS = 32  # at most, to find the carriage's position and the extension of the same sample
_TURN = 2.0 * np.pi
_DONE = 0
_TORN_OFF = DRAWN_IN + 1  # why the kernel stopped, beside the reasons of the cut
_STOPPED, _SATURATED, _APART, _BACKWARDS = 0, 1, 0, 1  # what is counted, here and in the cut
_WEAR = 0  # place in the state of the cut


# What a block takes and makes, in the order of the kernel.
_GIVEN = (
    "command", "set_point", "noise", "met", "angle", "speed", "height", "cross_position", "feed_velocity", "allowance",
)  # fmt: skip
_MADE = (
    "position", "velocity", "current", "measured", "extension", "extension_velocity", "voltage",
    "force", "deflection", "depth_of_cut", "feed", "wear",
)  # fmt: skip


@dataclass(frozen=True)
class Coil:
    """The current loop of a voice coil.

    Attributes:
        resistance: R [Ω].
        inductance: L [H].
        bandwidth: ωc of its loop [rad/s].
        back_emf: whether the motion induces a voltage.
        current_limit, voltage_limit: of i* and U [A, V]; inf for none.
        slew_rate: largest slope of i* [A/s]; inf for none.
    """

    resistance: float
    inductance: float
    bandwidth: float
    back_emf: bool = True
    current_limit: float = np.inf
    voltage_limit: float = np.inf
    slew_rate: float = np.inf


class CoilTable(NamedTuple):
    """A `Coil` for kernels; without one the position loop's force is there at once.

    Attributes:
        on: whether there is one.
        proportional, integral: of the current loop [V/A, V/(A·s)].
        current_limit, voltage_limit: [A, V].
        slew: largest change of i* in a sample [A].
        step: [s].
        state: integral of i* - i [A·s], and i* [A].
        limited: of each sample whether something was cut off; sample n stands at n modulo the size.
    """

    on: bool
    proportional: float
    integral: float
    current_limit: float
    voltage_limit: float
    slew: float
    step: float
    state: Array
    limited: npt.NDArray[np.uint8]


class LoadedTable(NamedTuple):
    """A `LoadedDrive` for kernels.

    Attributes:
        series: whether a piezo rides on the carriage.
        transition: of positions, velocities and, with a current loop, the current, shape (m, m).
        coarse: weights of the command, or of the voltage, shape (m, 3).
        fine, load: weights of the extension e and of the radial force, shape (m, 3).
        tool: place of the tool's position.
        delay, part: of the command [sample].
        spring, damper, force_per_current: of the position loop.
        carriage_stroke: [m].
        stack, memory, full_voltage: of the piezo.
        feedback, resolution: see `lathe_rc.plants.series.SeriesTable`.
        stiff, loss: ω2², 2ζ2ω2.
        tension: largest q before the stack is torn off its preload [m/s²]; inf for any.
        radial: ρ.
        coil: its current loop.
        state: shape (m,).
        before: e [m] and radial force [N] of the last sample.
        reading: of the carriage's sensor in the last sample [m], shape (1,).
        line: a ring of past commands: sample n stands at n modulo its length.
        counts: samples at an end stop, and in which the piezo saturated.
    """

    series: bool
    transition: Array
    coarse: Array
    fine: Array
    load: Array
    tool: int
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
    stiff: float
    loss: float
    tension: float
    radial: float
    coil: CoilTable
    state: Array
    before: Array
    reading: Array
    line: Array
    counts: npt.NDArray[np.int64]


@kernel
def _voltage(drive: LoadedTable, n: int, wanted: float) -> float:
    """The voltage of the current loop until sample ``n`` [V], from the state of the sample before."""
    coil, state = drive.coil, drive.state
    current = state[state.size - 1]
    asked = (drive.spring * (wanted - state[0]) - drive.damper * state[1]) * drive.force_per_current
    demand = min(max(asked, coil.state[1] - coil.slew), coil.state[1] + coil.slew)
    demand = min(max(demand, -coil.current_limit), coil.current_limit)
    error = demand - current
    integral = coil.state[0] + error * coil.step
    given = coil.proportional * error + coil.integral * integral
    voltage = min(max(given, -coil.voltage_limit), coil.voltage_limit)
    if voltage == given:
        coil.state[0] = integral
    coil.state[1] = demand
    coil.limited[n & (coil.limited.size - 1)] = demand != asked or voltage != given
    return float(voltage)


@inlined
def _begin(drive: LoadedTable, n: int, command: float, free: Array) -> float:
    """Fill what the drives do without the extension and the force of sample ``n``; returns the delayed command [m]."""
    line, transition, coarse = drive.line, drive.transition, drive.coarse
    size, delay, part = line.size, drive.delay, drive.part
    line[n % size] = command
    u0, u1, u2 = line[(n - delay) % size], line[(n - delay - 1) % size], line[(n - delay - 2) % size]
    d0, d1, d2 = u0, u1, u2
    if drive.coil.on:
        d0, d1, d2 = _voltage(drive, n, (1.0 - part) * u1 + part * u2), 0.0, 0.0
    for i in range(free.size):
        # In the order of the drives that feel no force, for the same bits.
        free[i] = 0.0
        if drive.series:
            free[i] = coarse[i, 0] * d0 + coarse[i, 1] * d1 + coarse[i, 2] * d2 + drive.fine[i, 1] * drive.before[0]
        for j in range(free.size):
            free[i] += transition[i, j] * drive.state[j]
        if not drive.series:
            free[i] = free[i] + coarse[i, 0] * d0 + coarse[i, 1] * d1 + coarse[i, 2] * d2
        free[i] += drive.load[i, 1] * drive.before[1]
    return float((1.0 - part) * u0 + part * u1)


@inlined
def _carriage(drive: LoadedTable, free: Array, e: float, pushes: float) -> float:
    """Position of the carriage [m] with an extension and a radial force, between its end stops."""
    stroke = drive.carriage_stroke
    return float(min(max(free[0] + drive.fine[0, 0] * e + drive.load[0, 0] * pushes, -stroke), stroke))


@inlined
def _chip(
    drive: LoadedTable, cut: CutTable, free: Array, e: float, here: tuple[float, ...], stiffness: float, c: float
) -> float:
    """Depth of cut with an extension, see `chip_of`; ``here``: place, angle, cross position, met form, allowance."""
    place, angle, cross_position, met, allowance = here
    kept, tool = drive.radial * held(cut), drive.tool
    displacement = free[tool] + drive.fine[tool, 0] * e + drive.load[tool, 0] * kept
    if drive.series:  # in the rounding of two states that are added
        x1 = _carriage(drive, free, e, kept)
        displacement = x1 + (displacement - x1)
    give = drive.radial * drive.load[tool, 0]
    chip = chip_of(cut, place, angle, cross_position, displacement - met, allowance, stiffness, c, give, 0.0)
    if not drive.series:
        x1 = free[0] + drive.load[0, 0] * (kept + drive.radial * cut.process.lag_now * stiffness * max(chip, 0.0))
        if abs(x1) > drive.carriage_stroke:  # an end stop holds it, and it does not give way
            x1 = drive.carriage_stroke if x1 > 0.0 else -drive.carriage_stroke
            chip = chip_of(cut, place, angle, cross_position, x1 - met, allowance, stiffness, c, 0.0, 0.0)
    return chip


@inlined
def _solve(
    drive: LoadedTable,
    cut: CutTable,
    free: Array,
    trial: Array,
    set_point: float,
    noise: float,
    here: tuple[float, ...],
    stiffness: float,
    c: float,
) -> tuple[float, float]:
    """Extension [m] and depth of cut [m] of a sample; with feedback they are found by iteration.

    The extension then needs the carriage's position of this sample and moves it by a thousandth of itself.
    """
    memory, e, cuts = drive.memory, 0.0, False
    if not drive.feedback:
        if drive.series:
            e, cuts = extend(drive.stack, memory, set_point)
            drive.counts[_SATURATED] += cuts
        return e, _chip(drive, cut, free, e, here, stiffness, c)
    chip, x1 = 0.0, _carriage(drive, free, drive.before[0], 0.0)
    for _ in range(_ROUNDS):
        guess = x1
        drive.reading[0] = quantise(guess + noise, drive.resolution)
        trial[:] = memory
        e, cuts = extend(drive.stack, trial, set_point - drive.reading[0])
        chip = _chip(drive, cut, free, e, here, stiffness, c)
        force = held(cut) + cut.process.lag_now * stiffness * max(chip, 0.0)
        x1 = _carriage(drive, free, e, drive.radial * force)
        if x1 == guess:
            break
    memory[:] = trial
    drive.counts[_SATURATED] += cuts
    return e, chip


@inlined
def _settle(drive: LoadedTable, free: Array, e: float, pushes: float, noise: float) -> None:
    """Where the drives are at the end of the sample, with its extension and its radial force."""
    state, stroke = drive.state, drive.carriage_stroke
    for i in range(free.size):
        state[i] = free[i] + drive.fine[i, 0] * e + drive.load[i, 0] * pushes
    drive.before[0], drive.before[1] = e, pushes
    # The end stops are inelastic: the carriage stays there until it is driven back; the tool swings on.
    if state[0] > stroke:
        state[0], state[1] = stroke, min(state[1], 0.0)
        drive.counts[_STOPPED] += 1
    elif state[0] < -stroke:
        state[0], state[1] = -stroke, max(state[1], 0.0)
        drive.counts[_STOPPED] += 1
    if not drive.feedback:
        drive.reading[0] = quantise(state[0] + noise, drive.resolution)


@kernel
def advance_loaded(
    drive: LoadedTable,
    cut: CutTable,
    first: int,
    command: Array,
    set_point: Array,
    noise: Array,
    met: Array,
    angle: Array,
    speed: Array,
    height: Array,
    cross_position: Array,
    feed_velocity: Array,
    allowance: Array,
    carriage: Array,
    carriage_velocity: Array,
    current: Array,
    measured: Array,
    extension: Array,
    extension_velocity: Array,
    voltage: Array,
    force: Array,
    deflection: Array,
    depth_of_cut: Array,
    feed: Array,
    wear: Array,
) -> tuple[int, int]:
    """Step drives and cut through a block, see `LoadedDrive.block`; returns the sample where it stopped and why."""
    state, per_radian = drive.state, cut.process.grid / _TURN
    free, trial = np.empty(state.size), np.empty(drive.memory.size)
    for k in range(command.size):
        place = angle[k] * per_radian
        reason, feed[k], stiffness, c = meet(cut, place, speed[k], height[k], angle[k], feed_velocity[k])
        if reason != _DONE:
            return k, reason
        wear[k] = cut.state[_WEAR]
        delayed = _begin(drive, first + k, command[k], free)
        here = (place, angle[k], cross_position[k], met[k], allowance[k])
        e, chip = _solve(drive, cut, free, trial, set_point[k], noise[k], here, stiffness, c)
        if np.isnan(chip):
            return k, DRAWN_IN
        cut.counts[_BACKWARDS] += feed_velocity[k] < 0.0
        cut.counts[_APART] += chip < 0.0
        depth_of_cut[k] = chip = max(chip, 0.0)
        force[k], deflection[k] = press(cut, chip, stiffness, c, speed[k], 0.0, 0.0)
        _settle(drive, free, e, drive.radial * force[k], noise[k])
        carriage[k], carriage_velocity[k], measured[k] = state[0], state[1], drive.reading[0]
        current[k] = (drive.spring * (delayed - state[0]) - drive.damper * state[1]) * drive.force_per_current
        if drive.coil.on:
            current[k] = state[state.size - 1]
        moved = state[0]
        if drive.series:
            extension[k], extension_velocity[k] = state[2] - state[0], state[3] - state[1]
            voltage[k], moved = drive.memory[VOLTAGE] * drive.full_voltage, state[0] + extension[k]
            if drive.stiff * (e - extension[k]) - drive.loss * extension_velocity[k] > drive.tension:
                return k, _TORN_OFF
        leave(cut, place, chip, cross_position[k] + (moved - met[k]) + deflection[k])
    return command.size, _DONE


def failure(reason: int, angle: float, speed: float, feed: float) -> LatheError:
    """Why drives and cut cannot go on, see `lathe_rc.plants.cutting.failure`."""
    if reason == _TORN_OFF:
        return LatheError(
            f"the tool's acceleration tears the stack off its preload at {angle:.6g} rad; allowed: more preload, or a "
            "gentler command"
        )
    return failure_of_cut(reason, angle, speed, feed)


@dataclass(frozen=True)
class Piezo:
    """The piezo drive on the carriage.

    Attributes:
        stack: amplifier and ceramics; the drive takes over its state.
        tool_frequency, tool_damping: ω2 [rad/s], ζ2 [1] of the tool on a blocked carriage.
        mass_ratio: r.
        full_voltage: voltage at the full stroke [V].
        feedback: direct compensation, see `lathe_rc.plants.series.SeriesDrive`.
        preload: of the stack [N]; inf: it holds any tension.
    """

    stack: Stack
    tool_frequency: float
    tool_damping: float
    mass_ratio: float
    full_voltage: float
    feedback: bool = False
    preload: float = np.inf


class LoadedDrive:
    """Tool drives that feel the cutting force.

    Args:
        carriage_frequency, carriage_damping: ω1 [rad/s], ζ1 [1] of the position loop.
        delay: τ of the command [s].
        carriage_stroke: end stops at ± this displacement [m].
        moving_mass: m or M [kg].
        force_constant: k of the coil [N/A].
        radial: ρ, the part of the main cutting force that acts along the drives.
        coil: current loop; None: the position loop's force is there at once.
        piezo: what rides on the carriage; None: the tool alone.
        resolution: of the carriage's position sensor [m]; 0 for none.
        step: sampling step [s].
        method: discretisation, see `lathe_rc.plants.linear.discretise`.
        kept: samples of which it is kept whether the current loop was limited, a power of two.

    Attributes:
        table: for `advance_loaded`.

    Raises:
        InputError: the current loop is too fast for the step, or it oscillates.
    """

    def __init__(
        self,
        *,
        carriage_frequency: float,
        carriage_damping: float,
        delay: float,
        carriage_stroke: float,
        moving_mass: float,
        force_constant: float,
        radial: float,
        coil: Coil | None = None,
        piezo: Piezo | None = None,
        resolution: float = 0.0,
        step: float,
        method: Discretisation,
        kept: int = 1,
    ) -> None:
        servo, _ = second_order(carriage_frequency, carriage_damping)
        spring, damper = float(-servo[1, 0]), float(-servo[1, 1])
        masses = 2 if piezo else 1
        order = 2 * masses + (coil is not None)
        a, drives, extends, loads = np.zeros((order, order)), np.zeros(order), np.zeros(order), np.zeros(order)
        for mass in range(masses):
            a[2 * mass, 2 * mass + 1] = 1.0
        stiff = loss = 0.0
        tool, mass_of_tool = 0, moving_mass
        if piezo:
            tool, mass_of_tool = 2, piezo.mass_ratio * moving_mass
            stiff, loss = piezo.tool_frequency**2, 2.0 * piezo.tool_damping * piezo.tool_frequency
            q = np.array([stiff, loss, -stiff, -loss])
            a[1, :4], a[3, :4] = -piezo.mass_ratio * q, q
            extends[1], extends[3] = -piezo.mass_ratio * stiff, stiff
        loads[tool + 1] = 1.0 / mass_of_tool
        if coil:
            a[1, -1] = force_constant / moving_mass
            a[-1, -1] = -coil.resistance / coil.inductance
            a[-1, 1] = -force_constant / coil.inductance if coil.back_emf else 0.0
            drives[-1] = 1.0 / coil.inductance
        else:
            a[1, 0] -= spring
            a[1, 1] -= damper
            drives[1] = spring
        self._coarse = discretise(a, drives, delay, step, method)
        self._fine = discretise(a, extends, 0.0, step, method)
        load = discretise(a, loads, 0.0, step, method)
        weights = self._coarse.weights
        if coil:  # the voltage stands through a step
            weights = np.zeros((order, 3))
            weights[:, 0] = discretise(a, drives, 0.0, step, method).weights.sum(axis=1)
        self.step, self._piezo = step, piezo
        stack = piezo.stack if piezo else _no_stack(step)
        self.table = LoadedTable(
            series=piezo is not None,
            transition=self._coarse.transition,
            coarse=weights,
            fine=self._fine.weights,
            load=load.weights,
            tool=tool,
            delay=self._coarse.delay,
            part=self._coarse.fraction,
            spring=spring,
            damper=damper,
            force_per_current=moving_mass / force_constant,
            carriage_stroke=carriage_stroke,
            stack=stack.table,
            memory=stack.state,
            full_voltage=piezo.full_voltage if piezo else 0.0,
            feedback=piezo is not None and piezo.feedback,
            resolution=resolution,
            stiff=stiff,
            loss=loss,
            tension=piezo.preload / mass_of_tool if piezo else np.inf,
            radial=radial,
            coil=CoilTable(
                on=coil is not None,
                proportional=coil.bandwidth * coil.inductance if coil else 0.0,
                integral=coil.bandwidth * coil.resistance if coil else 0.0,
                current_limit=coil.current_limit if coil else np.inf,
                voltage_limit=coil.voltage_limit if coil else np.inf,
                slew=coil.slew_rate * step if coil else np.inf,
                step=step,
                state=np.zeros(2),
                limited=np.zeros(kept, np.uint8),
            ),
            state=np.zeros(order),
            before=np.zeros(2),
            reading=np.zeros(1),
            line=np.zeros(self._coarse.delay + 3),
            counts=np.zeros(2, np.int64),
        )
        if coil:
            self._check(coil)
        if piezo and piezo.feedback:  # which may oscillate, and is refused then
            SeriesDrive(
                piezo.stack, carriage_frequency=carriage_frequency, carriage_damping=carriage_damping, delay=delay,
                carriage_stroke=carriage_stroke, moving_mass=moving_mass, force_constant=force_constant,
                tool_frequency=piezo.tool_frequency, tool_damping=piezo.tool_damping, full_voltage=piezo.full_voltage,
                mass_ratio=piezo.mass_ratio, feedback=True, resolution=resolution, step=step, method=method,
            )  # fmt: skip

    def block(self, cut: CuttingProcess, first: int, given: Mapping[str, Array]) -> dict[str, Array]:
        """Step drives and cut from sample ``first`` on; at rest at 0 before sample 0.

        Args:
            cut: what the tool cuts; its state goes on.
            first: index of the first sample.
            given: by name, of shape (n,): ``command`` [m], ``angle`` [rad], ``speed`` [rad/s] and ``feed_velocity``
                [m/s]; 0 unless given: ``set_point`` of the piezo [m], ``noise`` of the carriage's sensor [m], ``met``,
                the form that the blank has already [m], and ``height``, ``cross_position`` and ``allowance`` as in
                `lathe_rc.plants.cutting.CuttingProcess.block`.

        Returns:
            By name: ``position``, ``velocity``, ``current`` and ``measured`` of the carriage, ``extension``,
            ``extension_velocity`` and ``voltage`` of the piezo [m, m/s, A, m, m, m/s, V], and ``force``,
            ``deflection``, ``depth_of_cut``, ``feed`` and ``wear`` of the cut.

        Raises:
            LatheError: drives and cut cannot go on, see `failure`.
        """
        none = np.zeros_like(given["command"])
        taken = [given.get(name, none) for name in _GIVEN]
        made = {name: np.zeros_like(none) for name in _MADE}
        reached, reason = advance_loaded(self.table, cut.table, first, *taken, *made.values())
        if reason != _DONE:
            raise failure(reason, given["angle"][reached], given["speed"][reached], made["feed"][reached])
        return made

    def _check(self, coil: Coil) -> None:
        radius = float(np.abs(np.linalg.eigvals(self._closed()[0])).max())
        if radius >= 1.0:
            raise InputError(
                f"current loop of {coil.bandwidth:g} rad/s at a step of {self.step:.4g} s: largest pole {radius:.4g}; "
                "allowed: below 1 (less bandwidth or a higher sample rate; above the drive's own frequency)"
            )

    @property
    def stopped(self) -> int:
        """Samples so far that the carriage spent at an end stop."""
        return int(self.table.counts[_STOPPED])

    @property
    def saturated(self) -> int:
        """Samples so far in which the piezo's set point or voltage was cut off."""
        return int(self.table.counts[_SATURATED])

    def _closed(self) -> tuple[Array, Array]:
        """Transition of state and current loop's integral without limits, and the weight of the wanted position."""
        table, coil = self.table, self.table.coil
        order = table.state.size
        # U of the state before: (kp + ki·h)·(i* - i) + ki·integral
        gain = coil.proportional + coil.integral * coil.step
        row = np.zeros(order + 1)
        row[0], row[1] = -table.spring * table.force_per_current, -table.damper * table.force_per_current
        row[order - 1] = -1.0
        wanted = table.spring * table.force_per_current
        closed, weight = np.zeros((order + 1, order + 1)), np.zeros(order + 1)
        closed[:order, :order] = table.transition
        closed[:order] += np.outer(table.coarse[:, 0], gain * row + coil.integral * np.eye(order + 1)[order])
        closed[order] = coil.step * row
        closed[order, order] = 1.0
        weight[:order], weight[order] = table.coarse[:, 0] * gain * wanted, coil.step * wanted
        return closed, weight

    def _of(self, place: int, frequency: npt.ArrayLike, *, command: bool) -> Complex:
        """Response of a state to the command, or to the extension e, without feedback and force."""
        table = self.table
        if not table.coil.on:
            return seen_at(self._coarse if command else self._fine, place).response(frequency)
        wanted = np.asarray(frequency, dtype=np.float64)
        z = np.exp(1j * wanted.reshape(-1, 1) * self.step)
        transition, weight = self._closed()
        if command:
            late = (1.0 - table.part) * z ** -(table.delay + 1.0) + table.part * z ** -(table.delay + 2.0)
            right = weight * late
        else:
            extends = np.append(table.fine[:, :2], [[0.0, 0.0]], axis=0)
            right = extends[:, 0] + extends[:, 1] / z
        left = np.eye(weight.size) - transition / z[:, :, None]
        return np.asarray(np.linalg.solve(left, right[:, :, None])[:, place, 0].reshape(wanted.shape))

    def _with_feedback(self, alone: Complex, frequency: npt.ArrayLike) -> Complex:
        if self._piezo is None or not self._piezo.feedback:
            return alone
        reaction = self._piezo.stack.response(frequency) * self._of(0, frequency, command=False)
        return np.asarray(alone / (1.0 + reaction))

    def coarse_response(self, frequency: npt.ArrayLike) -> Complex:
        """Carriage over its command at ``frequency`` [rad/s], without limits and force."""
        return self._with_feedback(self._of(0, frequency, command=True), frequency)

    def fine_response(self, frequency: npt.ArrayLike) -> Complex:
        """Tool over the piezo's set point at ``frequency`` [rad/s], without limits and force."""
        assert self._piezo is not None, "there is one"
        alone = self._piezo.stack.response(frequency) * self._of(2, frequency, command=False)
        return self._with_feedback(alone, frequency)


def _no_stack(step: float) -> Stack:
    return Stack(
        stroke=1.0, amplifier_lag=0.0, hysteresis=None, inverse=None, creep_per_decade=0.0, creep_times=np.empty(0),
        step=step, method="foh",
    )  # fmt: skip
