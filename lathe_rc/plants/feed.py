# SPDX-License-Identifier: Apache-2.0
"""Feed drive of a slide, cross or longitudinal: a linear model with limits, and a screw with backlash.

    command → sampling → ± limit, held → model with a limited speed → screw → backlash → slide
                                           ↑ friction

Limits of the command are in `lathe_rc.plants.feed`, friction in `lathe_rc.plants.friction`, errors of the screw
in `lathe_rc.plants.screw`.

The command is in the unit of the model (`lathe_rc.plants.feed_models`): [m] where it is a wanted position, [V], or a
part of full scale. It is held from sample to sample, as a power converter holds it, and for that the difference
equation is exact. The position of a sample does not depend on the command of the same sample.

The states are the position of the motor and its derivatives, so that a limit of the speed can hold them: a motor that
would go beyond its greatest speed stays at it without acceleration, as if its command were no larger than what that
speed needs. Nothing is left to unwind when the command falls.

Limits of the command are those of the motion that it asks for. What the command u asks for is where the model settles:
of a model that integrates the speed k·u, of any other the position k·u, with its gain k.

    position  |k·u| ≤ stroke, |k·du/dt| ≤ velocity, |k·d²u/dt²| ≤ acceleration, |k·d³u/dt³| ≤ jerk
    speed     |x∞| ≤ stroke, |k·u| ≤ velocity, |k·du/dt| ≤ acceleration, |k·d²u/dt²| ≤ jerk

x∞ is where the motor would come to rest if the command were 0 from now on: with the denominator p·(a1 + a2·p + …) the
motor's position x + (a2·dx/dt + a3·d²x/dt² + …)/a1, which moves with k·u. How they are kept is in
`lathe_rc.control.limits`.
"""

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array
from lathe_rc.compiled.struct_view import sized
from lathe_rc.control.limits import CommandLimits, keep_position, keep_velocity, rest
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel
from lathe_rc.plants.feed_models import realise, settles
from lathe_rc.plants.friction import LUGRE, NONE, STRIBECK, Friction, FrictionTable, bend, no_friction, slide
from lathe_rc.plants.linear import discretise
from lathe_rc.plants.screw import Screw, ScrewTable, nut, nut_speed, warm
from lathe_rc.signals.noise import quantise
from lathe_rc.transfer import TransferFunction

Complex = npt.NDArray[np.complex128]


@kernel
def follow(load: float, half: float, motor: float) -> float:
    """Position of the load once the motor has moved straight to ``motor``: it moves only when a flank pushes it.

    Args:
        load: where it was, within ``half`` of where the motor was [m].
        half: half the width of the gap [m].
        motor: where the motor is now [m].
    """
    return min(max(load, motor - half), motor + half)


class LimitTable(NamedTuple):
    """Limits of a drive's command for kernels, as `lathe_rc.control.limits` has them; all in the command's unit.

    Attributes:
        limits: of the position or the velocity that the command is.
        step: from one taken command to the next [s].
        coming: of a velocity: weights of the states in x∞, shape (m,); of a position: empty.
    """

    limits: CommandLimits
    step: float
    coming: Array


@inlined
def keep_within(limits: LimitTable, memory: Array, state: Array, command: float) -> bool:
    """Keep a command within its limits, by the ``state`` of the drive; ``memory[0]`` is the limited command."""
    if limits.coming.size == 0:
        return keep_position(limits.limits, limits.step, memory, command)
    coming = 0.0
    for row in range(limits.coming.size):
        coming += limits.coming[row] * state[row]
    return keep_velocity(limits.limits, limits.step, memory, coming, command)


def limit_table(model: TransferFunction, limits: CommandLimits, command_limit: float, step: float) -> LimitTable:
    """Return the limits of a drive's command that is taken every ``step`` [s]."""
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

# Places in a drive's state, from the end; before them the motor's position, speed, … and room for their next values.
_WARMTH, _BRISTLE, _DISTURBANCE, _EFFORT, _LOAD = -5, -4, -3, -2, -1

_UNDISTURBED = np.empty(0)
_UNTOLD = np.empty(0, np.uint8)
_FREE = CommandLimits()
_PERFECT = Screw()


@sized
class DriveTable(NamedTuple):
    """Constants of a `FeedDrive` for kernels.

    Attributes:
        transition, weights: x[n] = Φ·x[n-1] + g·u[n-1], shapes (m, m) and (m,); x is position, speed, ….
        jumps: what the command adds at once to speed, acceleration, …, shape (m,).
        command_limit: to each side, in the unit of the command.
        speed_limit: to each side [m/s].
        needed: command that keeps that speed; infinite where none does.
        furthest: travel in a step at that speed [m].
        half: half the backlash [m].
        friction: of the slide.
        rubbed: what 1 N of friction, held over a step, takes from x, shape (m,).
        screw: between motor and slide.
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
    """Position of the motor [m], in a drive's state."""
    return float(state[0])


@kernel
def load_of(state: Array) -> float:
    """Position of the slide [m], in a drive's state."""
    return float(state[_LOAD])


@inlined
def _rub(table: DriveTable, state: Array) -> None:
    """Subtract friction from the next values, which stand behind the present ones."""
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
    """Step a drive with the command that it holds; returns whether it is at its greatest speed."""
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
        # A drive that would accelerate further gets derivatives of 0 under the command that just keeps this speed (the
        # states lack what the command adds at once), so that it slows down as soon as its command falls.
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
    """Give a drive the command to hold from now on; returns whether it was cut off."""
    state[_EFFORT] = min(max(command, -table.command_limit), table.command_limit)
    return abs(command) > table.command_limit


class FeedTable(NamedTuple):
    """A `FeedDrive` for kernels.

    Attributes:
        drive, state: its constants and memory.
        limits, memory: those of its command, which are looked at if it is ``kept``; the memory ends with whether the
            command that is held is clipped.
        divisor: the command is taken every so many samples.
        resolution: of the position sensor [m].
        from_load: whether that is at the load.
        kept: see above.
        counts: commands that were cut off and samples at the greatest speed so far.
    """

    drive: DriveTable
    state: Array
    limits: LimitTable
    memory: Array
    divisor: int
    resolution: float
    from_load: bool
    kept: bool
    counts: npt.NDArray[np.int64]


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
    """Step through a block, see `FeedDrive.block`; what is ``clipped`` of sample n stands at n modulo its size."""
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
        # Within the gap the slide stands.
        speed = state[1]
        if table.screw.real:
            speed = nut_speed(table.screw, state[_WARMTH], state[0], speed)
        velocity[k] = speed if table.half == 0.0 or state[_LOAD] != before else 0.0
        seen = state[_LOAD] if feed.from_load else state[0]
        measured[k] = quantise(seen, feed.resolution)
    feed.counts[0] += saturated
    feed.counts[1] += limited


def _rubbed(model: TransferFunction, friction: Friction, step: float) -> Array:
    """Loss of position, speed, … by 1 N of friction, held over a step, shape (m,).

    Raises:
        InputError: the friction acts on a lag that the drive does not have.
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
    """The drive as a machine: command in, motion of the slide and of the motor out.

    Args:
        model: position over command, see `lathe_rc.plants.feed_models`.
        step: sampling step [s].
        divisor: the command is taken at samples that are multiples of it, and held between.
        command_limit: the command is cut off at ± this, in its unit.
        speed_limit: of the motor, to each side [m/s].
        backlash: width of the gap between motor and slide [m].
        resolution: of the position sensor [m]; 0 for none.
        feedback: where the position sensor is.
        limits: of the motion that the command asks for.
        friction: of the slide; None: it has none.
        screw: between motor and slide; perfect by default.

    Attributes:
        table: its constants for `move` and `hold`.
        state: its memory for them.
        whole: both and all else for `advance`.
        integrates: whether the command stands for a speed.

    Raises:
        InputError: a model whose speed would jump with the command, a value that is out of range, limits for a
            command that stands for neither a position nor a speed, or friction that does not fit the model.
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
        # What is exact for a command that is linear over a step is so for one that does not change in it.
        held = linear.weights[:, 0] + linear.weights[:, 1]
        # A model that integrates needs a certain command for a certain speed.
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
        """Commands so far that were cut off."""
        return int(self.whole.counts[0])

    @property
    def limited(self) -> int:
        """Samples so far at the greatest speed."""
        return int(self.whole.counts[1])

    def response(self, frequency: npt.ArrayLike) -> Complex:
        """Motor over command, as the difference equation has it, at ``frequency`` [rad/s].

        Limits, divisor and friction are left out.
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
        """Step from sample ``first`` on; at rest at 0 before sample 0. Arrays of shape (n,); the motion is filled.

        Args:
            first: index of the first sample.
            command: in the unit of the model.
            position: of the slide [m].
            velocity: of the slide [m/s].
            effort: what the motor is given from this sample on: the command, sampled and cut off.
            motor: position of the motor, on the slide's scale by a perfect screw [m].
            measured: that of the two which the sensor sees, as it reads it [m].
            disturbance: adds to the limited command, in its unit (f of paper 002, eq. 2); none if empty.
            clipped: filled with 1 where the command that is held is not what it was when it was taken; needed if there
                are limits, else it may be empty.
        """
        wanted = command.size if self.whole.kept or clipped.size else 0
        assert clipped.size == wanted, "room for what is clipped"
        ring = np.zeros(1 << max(clipped.size - 1, 0).bit_length(), np.uint8)
        advance(self.whole, first, command, disturbance, position, velocity, effort, motor, measured, ring)
        clipped[:] = ring[np.arange(first, first + clipped.size) & (ring.size - 1)]
