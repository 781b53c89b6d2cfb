# SPDX-License-Identifier: Apache-2.0
"""Feed drive of a cross or longitudinal slide: a linear model with limits, and a screw with backlash.

    command → sampling → ± limit, held → model with a limited speed → screw → backlash → slide
                                           ↑ friction

Limits on the command are in `lathe_machine.control.limits`, friction is in `lathe_machine.plants.friction`, and errors
of the screw are in `lathe_machine.plants.screw`.

The command is in the unit of the model (`lathe_machine.plants.feed_models`): [m] for a position command, [V], or a
fraction of full scale. It is held between samples, as by a power converter, and the difference equation is exact for a
held command. The position of a sample does not depend on the command of the same sample.

The states are the position of the motor and its derivatives, so that a speed limit can be applied to them: a motor
that would exceed its maximum speed runs at this speed without acceleration, as if its command were no larger than this
speed requires. There is thus no windup when the command falls.

Limits on the command apply to the requested motion, which is the steady state of the model for the command u: the speed
k·u for a model that integrates, the position k·u for any other, where k is the gain of the model.

    position  |k·u| ≤ stroke, |k·du/dt| ≤ velocity, |k·d²u/dt²| ≤ acceleration, |k·d³u/dt³| ≤ jerk
    speed     |x∞| ≤ stroke, |k·u| ≤ velocity, |k·du/dt| ≤ acceleration, |k·d²u/dt²| ≤ jerk

x∞ is the position at which the motor would come to rest if the command were 0 from now on: with the denominator
p·(a1 + a2·p + …) and the motor's position x, x∞ = x + (a2·dx/dt + a3·d²x/dt² + …)/a1, and x∞ moves at the speed k·u.
"""

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_machine.control.limits import CommandLimits, keep_position, keep_velocity, rest
from lathe_machine.plants.feed_models import realise, settles
from lathe_machine.plants.friction import LUGRE, NONE, STRIBECK, Friction, FrictionTable, bend, no_friction, slide
from lathe_machine.plants.linear import discretise
from lathe_machine.plants.screw import Screw, ScrewTable, nut, nut_speed, warm
from lathe_machine.transfer import TransferFunction
from lathe_rc.arrays import Array, Complex, Integers
from lathe_rc.compiled.struct_view import sized
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel
from lathe_rc.signals.noise import quantise


@kernel
def follow(load: float, half: float, motor: float) -> float:
    """Return the position of the load behind backlash, after the motor has moved straight to ``motor``.

    The load moves only while one side of the backlash pushes it.

    Args:
        load: previous position of the load, within ``half`` of the previous position of the motor [m].
        half: half the backlash [m].
        motor: current position of the motor [m].
    """
    return min(max(load, motor - half), motor + half)


class LimitTable(NamedTuple):
    """Limits on a drive's command for kernels (see `lathe_machine.control.limits`); all in the unit of the command.

    Attributes:
        limits: limits on the position or velocity that the command represents.
        step: time between two commands [s].
        coming: weights of the states in x∞ for a velocity command, shape (m,); empty for a position command.
    """

    limits: CommandLimits
    step: float
    coming: Array


@inlined
def keep_within(limits: LimitTable, memory: Array, state: Array, command: float) -> bool:
    """Limit a drive's command, given the ``state`` of the drive; the limited command is stored in ``memory[0]``."""
    if limits.coming.size == 0:
        return keep_position(limits.limits, limits.step, memory, command)
    coming = 0.0
    for row in range(limits.coming.size):
        coming += limits.coming[row] * state[row]
    return keep_velocity(limits.limits, limits.step, memory, coming, command)


def limit_table(model: TransferFunction, limits: CommandLimits, command_limit: float, step: float) -> LimitTable:
    """Return the limits on a drive's command that is sampled every ``step`` [s]."""
    gain, integrates = settles(model)
    if limits.any and not gain:
        raise InputError(
            f"feed drive {model}: its command stands for neither a position nor a speed, so that there is no limit of "
            "stroke, velocity, acceleration or jerk for it; allowed: a gain, and one pole at 0 at most"
        )
    gain = gain or 1.0
    scaled = CommandLimits(*(limit / gain for limit in limits))
    if integrates:
        bottom = np.trim_zeros(np.array(model.denominator), "f")
        coming = bottom[-2::-1] / (bottom[-2] * gain) if limits.any else np.empty(0)
        return LimitTable(scaled._replace(velocity=min(scaled.velocity, command_limit)), step, coming)
    return LimitTable(scaled._replace(stroke=min(scaled.stroke, command_limit)), step, np.empty(0))


Feedback = Literal["motor", "load"]

# Indices in a drive's state, from the end; before them are the motor's position, speed, … and space for the next ones.
_WARMTH, _BRISTLE, _DISTURBANCE, _EFFORT, _LOAD = -5, -4, -3, -2, -1

_UNDISTURBED = np.empty(0)
_UNTOLD = np.empty(0, np.uint8)
_FREE = CommandLimits()
_PERFECT = Screw()


@sized
class DriveTable(NamedTuple):
    """Constants of a feed drive for kernels (see `FeedDrive`).

    Attributes:
        transition, weights: x[n] = Φ·x[n-1] + g·u[n-1], shapes (m, m) and (m,); x is position, speed, ….
        jumps: immediate effect of the command on speed, acceleration, …, shape (m,).
        command_limit: largest magnitude of the command, in its unit.
        speed_limit: largest magnitude of the speed [m/s].
        needed: steady command for the speed limit; infinite if there is none.
        furthest: travel per step at the speed limit [m].
        half: half the backlash [m].
        friction: friction of the slide.
        rubbed: decrease of x due to 1 N of friction held over a step, shape (m,).
        screw: screw between motor and slide.
    """

    transition: Array
    weights: Array
    jumps: Array
    command_limit: float
    speed_limit: float
    needed: float
    furthest: float
    half: float
    friction: FrictionTable
    rubbed: Array
    screw: ScrewTable


@kernel
def motor_of(state: Array) -> float:
    """Return the position of the motor [m] from a drive's state."""
    return float(state[0])


@kernel
def load_of(state: Array) -> float:
    """Return the position of the slide [m] from a drive's state."""
    return float(state[_LOAD])


@inlined
def _rub(table: DriveTable, state: Array) -> None:
    """Subtract the effect of friction from the next values, which are stored after the current values."""
    order = table.weights.size
    speed, free, gained = state[1], state[order + 1], table.rubbed[1]
    force, rests = 0.0, False
    if table.friction.law == STRIBECK:
        force, rests = slide(table.friction, gained, speed, free)
    elif table.friction.law == LUGRE:
        force, state[_BRISTLE] = bend(table.friction, gained, speed, free, state[_BRISTLE])
    for row in range(order):
        state[order + row] -= table.rubbed[row] * force
    if rests:
        state[order + 1] = 0.0
        if speed == 0.0:
            state[order] = state[0]


@inlined
def move(table: DriveTable, state: Array) -> bool:
    """Step a drive with its held command; return whether the drive is at its speed limit."""
    order = table.weights.size
    effort, before = state[_EFFORT] + state[_DISTURBANCE], state[0]
    for row in range(order):
        total = table.weights[row] * effort
        for column in range(order):
            total += table.transition[row, column] * state[column]
        state[order + row] = total
    if table.friction.law != NONE:
        _rub(table, state)
    for row in range(order):
        state[row] = state[order + row]
    travel, speed = state[0] - before, state[1]
    limited = bool(abs(speed) >= table.speed_limit or abs(travel) > table.furthest)
    if limited:
        state[0] = before + min(max(travel, -table.furthest), table.furthest)
        state[1] = min(max(speed, -table.speed_limit), table.speed_limit)
        # A drive that would accelerate further gets the state with derivatives of 0 under the steady command for this
        # speed (states exclude the immediate effect of the command), so it slows down as soon as its command falls.
        if order > 2 and (state[2] + table.jumps[1] * effort) * speed > 0.0:
            enough = min(max(effort, -table.needed), table.needed)
            for row in range(2, order):
                state[row] = -table.jumps[row - 1] * enough
    place = state[0]
    if table.screw.real:
        state[_WARMTH] = warm(table.screw, state[_WARMTH], state[1])
        place = nut(table.screw, state[_WARMTH], place)
    state[_LOAD] = follow(state[_LOAD], table.half, place)
    return limited


@inlined
def hold(table: DriveTable, state: Array, command: float) -> bool:
    """Set the command that a drive holds from now on; return whether the command was clipped."""
    state[_EFFORT] = min(max(command, -table.command_limit), table.command_limit)
    return abs(command) > table.command_limit


class FeedTable(NamedTuple):
    """Feed drive with its limits and states, for kernels (see `FeedDrive`).

    Attributes:
        drive, state: constants and state of the drive.
        limits, memory: limits on the command and state of the limiter, used only if ``kept`` is true; the last entry of
            the state is 1 while the held command is clipped.
        divisor: the command is sampled every ``divisor`` samples.
        resolution: resolution of the position sensor [m].
        from_load: whether the position sensor is at the load.
        kept: whether the command has limits.
        counts: numbers of clipped commands and of samples at the speed limit so far.
    """

    drive: DriveTable
    state: Array
    limits: LimitTable
    memory: Array
    divisor: int
    resolution: float
    from_load: bool
    kept: bool
    counts: Integers


@kernel
def advance(
    feed: FeedTable,
    first: int,
    command: Array,
    disturbance: Array,
    position: Array,
    velocity: Array,
    effort: Array,
    motor: Array,
    measured: Array,
    clipped: npt.NDArray[np.uint8],
) -> None:
    """Step a feed drive through a block (implements `FeedDrive.block`); ``clipped`` is a ring, sample n at n % size."""
    table, state, memory, divisor = feed.drive, feed.state, feed.memory, feed.divisor
    saturated = limited = 0
    mask = clipped.size - 1
    for k in range(command.size):
        before = state[_LOAD]
        limited += move(table, state)
        if (first + k) % divisor == 0:
            wanted, changed = command[k], False
            if feed.kept:
                changed = keep_within(feed.limits, memory, state, wanted)
                wanted = memory[0]
            cut = hold(table, state, wanted)
            saturated += cut
            memory[-1] = 1.0 if changed or cut else 0.0
        clipped[(first + k) & mask] = memory[-1] > 0.0
        state[_DISTURBANCE] = disturbance[k] if disturbance.size else 0.0
        motor[k], position[k], effort[k] = state[0], state[_LOAD], state[_EFFORT]
        # While the motor moves within the backlash, the slide is at rest.
        speed = state[1]
        if table.screw.real:
            speed = nut_speed(table.screw, state[_WARMTH], state[0], speed)
        velocity[k] = speed if table.half == 0.0 or state[_LOAD] != before else 0.0
        seen = state[_LOAD] if feed.from_load else state[0]
        measured[k] = quantise(seen, feed.resolution)
    feed.counts[0] += saturated
    feed.counts[1] += limited


def _rubbed(model: TransferFunction, friction: Friction, step: float) -> Array:
    """Return the decrease of position, speed, … due to 1 N of friction held over a step, shape (m,).

    Raises:
        InputError: the friction has a pole that the drive does not have.
    """
    lags, rest = np.polydiv(model.denominator, friction.mobility.denominator)
    if np.abs(rest).max() > 1e-9 * np.abs(model.denominator).max():
        raise InputError(
            f"feed drive {model}: friction with a mobility {friction.mobility}; allowed: one whose poles the drive has"
        )
    a, b = realise(TransferFunction(tuple(np.polymul(friction.mobility.numerator, lags)), model.denominator))
    linear = discretise(a, b, 0.0, step, "foh")
    return np.ascontiguousarray(linear.weights[:, 0] + linear.weights[:, 1])


class FeedDrive:
    """Simulated feed drive: from the command to the motion of slide and motor.

    Args:
        model: position over command, see `lathe_machine.plants.feed_models`.
        step: sampling step [s].
        divisor: the command is sampled at multiples of this number of samples, and held in between.
        command_limit: magnitude to which the command is clipped, in its unit.
        speed_limit: maximum speed of the motor in both directions [m/s].
        backlash: backlash between motor and slide [m].
        resolution: resolution of the position sensor [m]; 0 for no rounding.
        feedback: location of the position sensor.
        limits: limits on the motion that the command requests.
        friction: friction of the slide; None for no friction.
        screw: screw between motor and slide; without errors by default.

    Attributes:
        table: constants for `move` and `hold`.
        state: state for `move` and `hold`.
        whole: constants and state for `advance`.
        integrates: whether the command represents a speed.

    Raises:
        InputError: the speed of the model would jump with the command, a value is out of range, there are limits on a
            command that represents neither a position nor a speed, or the friction does not fit the model.
    """

    def __init__(
        self,
        model: TransferFunction,
        *,
        step: float,
        divisor: int = 1,
        command_limit: float = np.inf,
        speed_limit: float = np.inf,
        backlash: float = 0.0,
        resolution: float = 0.0,
        feedback: Feedback = "load",
        limits: CommandLimits = _FREE,
        friction: Friction | None = None,
        screw: Screw = _PERFECT,
    ) -> None:
        for name, value, allowed in (
            ("divisor", divisor, divisor >= 1),
            ("command limit", command_limit, command_limit > 0.0),
            ("speed limit", speed_limit, speed_limit > 0.0),
        ):
            if not allowed:
                raise InputError(f"feed drive: {name} = {value:g}; allowed: above 0")
        for name, value in (("backlash", backlash), ("resolution", resolution)):
            if not 0.0 <= value < np.inf:
                raise InputError(f"feed drive: {name} = {value:g} m; allowed: 0 for none, or above 0")
        a, b = realise(model)
        linear = discretise(a, b, 0.0, step, "foh")
        # A discretisation that is exact for a command that is linear over a step is also exact for a constant one.
        held = linear.weights[:, 0] + linear.weights[:, 1]
        # A model that integrates has one steady command for each speed.
        gain, self.integrates = settles(model)
        needed = speed_limit / gain if self.integrates and gain > 0.0 else np.inf
        if friction and np.isfinite(speed_limit) and held.size > 2:
            raise InputError(
                f"feed drive: speed limit = {speed_limit:g} m/s with friction and {held.size - 1} lags; allowed: one "
                "lag, or one of both"
            )
        self.table = DriveTable(
            transition=np.ascontiguousarray(linear.transition),
            weights=held,
            jumps=b,
            command_limit=float(command_limit),
            speed_limit=float(speed_limit),
            needed=float(needed),
            furthest=float(speed_limit * step),
            half=backlash / 2.0,
            friction=friction.table(step) if friction else no_friction(step),
            rubbed=_rubbed(model, friction, step) if friction else np.zeros(held.size),
            screw=screw.table(step),
        )
        self.state = np.zeros(2 * held.size + 5)
        self._step = step
        self.whole = FeedTable(
            drive=self.table,
            state=self.state,
            limits=limit_table(model, limits, command_limit, divisor * step),
            memory=np.append(rest(), 0.0),
            divisor=divisor,
            resolution=float(resolution),
            from_load=feedback == "load",
            kept=limits.any,
            counts=np.zeros(2, np.int64),
        )

    @property
    def saturated(self) -> int:
        """Number of clipped commands so far."""
        return int(self.whole.counts[0])

    @property
    def limited(self) -> int:
        """Number of samples at the speed limit so far."""
        return int(self.whole.counts[1])

    def response(self, frequency: npt.ArrayLike) -> Complex:
        """Return the difference equation's frequency response from command to motor at ``frequency`` [rad/s].

        Limits, divisor and friction are ignored.
        """
        z = np.exp(1j * np.asarray(frequency, dtype=np.float64) * self._step)
        weights = self.table.weights
        whole = z[..., None, None] * np.eye(weights.size) - self.table.transition
        states = np.linalg.solve(whole, np.broadcast_to(weights[:, None], (*z.shape, weights.size, 1)))
        return np.asarray(states[..., 0, 0])

    def block(
        self,
        first: int,
        command: Array,
        position: Array,
        velocity: Array,
        effort: Array,
        motor: Array,
        measured: Array,
        disturbance: Array = _UNDISTURBED,
        clipped: npt.NDArray[np.uint8] = _UNTOLD,
    ) -> None:
        """Step the drive through a block of samples; the output arrays are filled, and all arrays have shape (n,).

        The drive is at rest at 0 before sample 0.

        Args:
            first: index of the first sample.
            command: command, in the unit of the model.
            position: position of the slide [m].
            velocity: velocity of the slide [m/s].
            effort: input of the motor from this sample on, which is the sampled and clipped command.
            motor: position of the motor, converted to slide travel by an ideal screw [m].
            measured: reading of the position sensor, at the slide or the motor [m].
            disturbance: added to the limited command, in its unit (f of paper 002, eq. 2); empty for no disturbance.
            clipped: filled with 1 where the held command differs from the sampled command; may be empty if there are
                no limits.
        """
        wanted = command.size if self.whole.kept or clipped.size else 0
        assert clipped.size == wanted, "room for what is clipped"
        ring = np.zeros(1 << max(clipped.size - 1, 0).bit_length(), np.uint8)
        advance(self.whole, first, command, disturbance, position, velocity, effort, motor, measured, ring)
        clipped[:] = ring[np.arange(first, first + clipped.size) & (ring.size - 1)]
