# SPDX-License-Identifier: Apache-2.0
"""Feed drive of a cross or longitudinal slide."""

from collections.abc import Mapping
from itertools import dropwhile
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Le

from lathe_machine.plants import feed_models
from lathe_machine.plants.feed import Feedback, FeedDrive, FeedTable, advance
from lathe_machine.plants.friction import Friction, mobility
from lathe_machine.plants.screw import Screw
from lathe_machine.signals.example_002 import fill_disturbance
from lathe_machine.stages.common.command_limits import Clipping, LimitedParameters
from lathe_machine.stages.common.obedience import (
    OBEY,
    FeedObedientParameters,
    Listener,
    Obedience,
    Obedient,
    apply,
    listens,
    piece,
)
from lathe_machine.stages.common.tables import made_of
from lathe_machine.transfer import TransferFunction
from lathe_rc import messages
from lathe_rc.arrays import put
from lathe_rc.blocks.ports import Input, Joint, Output, Sparse
from lathe_rc.cell.events import FREE, LIMITED, OUT_OF_REACH
from lathe_rc.cell.parameters import NonNegative, Positive, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples
from lathe_rc.safety.state_machine import Reaction
from lathe_rc.signals.noise import Sensor, SensorTable, measure

Axis = Literal["cross", "longitudinal"]
_COEFFICIENTS = {
    "dc_screw": ("velocity_gain", "lags", "zero"),
    "fourth_order": ("gain", "a1", "a2", "a3", "a4"),
    "sampled": ("sampled_gain", "sampled_lag"),
}  # coefficients of each model


class FeedDriveParameters(LimitedParameters, FeedObedientParameters):
    """Model from command to position, limits, backlash, and the position sensor."""

    axis: Axis = parameter("cross", "which slide; the first word of its topics")
    model: Literal["dc_screw", "fourth_order", "sampled"] = parameter(
        "dc_screw", "dc_screw: motor and screw of paper 004; fourth_order: paper 002; sampled: paper 003"
    )
    velocity_gain: Positive = parameter(
        4.38e-3, "dc_screw: speed at the full command, 1; the cross feed of paper 004", "m/s"
    )
    lags: list[Positive] = parameter([], "dc_screw: time constants; empty: 0.045 alone", "s")
    zero: NonNegative = parameter(
        0.0, "dc_screw: time constant of a zero, which makes room for the lag of the cutting process", "s"
    )
    gain: Positive = parameter(19.0, "fourth_order: K")
    a1: float = parameter(21.5, "fourth_order: a1, the coefficient of 1")
    a2: float = parameter(48.0, "fourth_order: a2, of p")
    a3: float = parameter(46.9, "fourth_order: a3, of p²")
    a4: float = parameter(10.2, "fourth_order: a4, of p³")
    sampled_gain: Positive = parameter(6.25, "sampled: K, for a command in m", "1/s")
    sampled_lag: Positive = parameter(0.08, "sampled: T1", "s")
    divisor: Annotated[int, Ge(1), Le(1_000_000)] = parameter(
        1, "the command is taken at samples that are multiples of it, and held between", "sample"
    )
    command_limit: NonNegative = parameter(
        1.0, "largest command to each side, in its unit; the full command is 1; 0: none"
    )
    command_stroke: NonNegative = parameter(
        0.0, "what is commanded stops the slide within this to each side; 0: none", "m"
    )
    command_velocity: NonNegative = parameter(
        0.0, "largest velocity that is commanded: gain times command, or its change for a position; 0: none", "m/s"
    )
    command_acceleration: NonNegative = parameter(0.0, "largest change of that velocity; 0: none", "m/s^2")
    command_jerk: NonNegative = parameter(0.0, "largest change of that acceleration; 0: none", "m/s^3")
    speed_limit: NonNegative = parameter(0.0, "greatest speed of the motor; 0: none", "m/s")
    disturbance: float = parameter(
        0.0, "amplitude of f(t) = A·sin²(0.04πt s⁻¹), added to the limited command; 0.5 in eq. 18 of paper 002"
    )
    backlash: NonNegative = parameter(0.0, "gap between motor and slide", "m")
    friction: Literal["none", "stribeck", "lugre"] = parameter(
        "none", "of the slide; lugre: with presliding; of a dc_screw or sampled drive, at its longest lag"
    )
    motor_force: Positive = parameter(
        1000.0, "friction: force of the motor on the slide at a command of 1, at rest", "N"
    )
    friction_coulomb: Positive = parameter(200.0, "friction: force in motion, Fc", "N")
    friction_static: Positive = parameter(300.0, "friction: greatest force at rest, Fs", "N")
    friction_speed: Positive = parameter(1e-3, "friction: speed vs at which it has fallen to Fc", "m/s")
    friction_viscous: NonNegative = parameter(
        0.0, "friction: growth with the speed Fv, beside what the lags contain", "N*s/m"
    )
    friction_stiffness: Positive = parameter(1e7, "lugre: stiffness of the bristles σ0", "N/m")
    friction_damping: NonNegative = parameter(1e4, "lugre: their damping σ1", "N*s/m")
    pitch_slope: float = parameter(0.0, "screw: error of its pitch all along, as a part of the way; 0: none")
    pitch_amplitude: float = parameter(0.0, "screw: amplitude of the error that repeats with the lead; 0: none", "m")
    pitch_lead: Positive = parameter(10e-3, "screw: lead", "m")
    pitch_phase: float = parameter(0.0, "screw: phase of that error at the place 0", "rad")
    screw_heating: NonNegative = parameter(
        0.0, "screw: rise of its temperature in the end, by the speed of the nut; 0: none", "K*s/m"
    )
    screw_surroundings: float = parameter(0.0, "screw: rise of its temperature in the end at rest; 0: none", "K")
    screw_time: Positive = parameter(1800.0, "screw: time constant of that", "s")
    screw_expansion: NonNegative = parameter(11.5e-6, "screw: growth with the temperature; steel", "1/K")
    screw_anchor: float = parameter(0.0, "screw: place of the bearing that it grows from", "m")
    feedback: Feedback = parameter("load", "where the position sensor is: at the motor or at the load")
    noise_rms: NonNegative = parameter(0.0, "white noise of the position sensor, RMS; 0: none", "m")
    resolution: NonNegative = parameter(0.0, "quantisation step of the position sensor; 0: none", "m")

    def transfer(self) -> TransferFunction:
        """Transfer function from command to position.

        Raises:
            InputError: as for `lathe_machine.plants.feed_models.dc_screw`.
        """
        if self.model == "fourth_order":
            return feed_models.fourth_order(self.gain, self.a1, self.a2, self.a3, self.a4)
        if self.model == "sampled":
            return feed_models.sampled(self.sampled_gain, self.sampled_lag)
        return feed_models.dc_screw(self.velocity_gain, tuple(self.lags or [0.045]), self.zero)

    def rubbing(self, node: str) -> Friction | None:
        """Return the friction of a node; None if there is none.

        Raises:
            InputError: the mechanical lag of the model is unknown, or as for `Friction`.
        """
        if self.friction == "none":
            return None
        if self.model == "fourth_order":
            raise InputError(
                f"{node}.friction = {self.friction} with model = fourth_order, whose mechanics are not told from the "
                "rest; allowed: dc_screw or sampled"
            )
        gain, lags = self.velocity_gain, self.lags or [0.045]
        if self.model == "sampled":
            gain, lags = self.sampled_gain, [self.sampled_lag]
        with about(node, "friction_coulomb", "friction_static"):
            moves = mobility(gain, max(lags), self.motor_force)
            return made_of(Friction, self, "friction_", law=self.friction, mobility=moves)

    def screw(self, node: str) -> Screw:
        """Return the feed screw of a node.

        Raises:
            InputError: as for `Screw.check`.
        """
        screw = made_of(Screw, self, "pitch_", "screw_")
        with about(node, "pitch_slope", "pitch_amplitude", "pitch_lead"):
            screw.check()
        return screw

    def drive_models(self) -> Mapping[str, Mapping[str, float | list[float]]]:
        """Quantities of the drive that controllers may know, by command topic."""
        known: dict[str, float | list[float]] = {}
        if self.model == "sampled":
            known |= {"gain": self.sampled_gain, "lag": self.sampled_lag}
        whole = self.transfer()
        for part in ("numerator", "denominator"):
            known[f"transfer.{part}"] = [*map(float, dropwhile(lambda factor: factor == 0.0, getattr(whole, part)))]
        return {f"{self.axis}/command": known}


class Memory(NamedTuple):
    """State of the feed drive's step function.

    Attributes:
        drive: simulated drive.
        sensor: sensor of the position.
        who: obedience to the supervisor, used if ``listens``, which is false once the drive is ``safe``.
        disturbance: amplitude of the disturbance added to the command.
        period: sampling step [s].
        clipped: ring buffer of whether the command was clipped at sample n, at index n modulo the length.
        room: scratch arrays for the command, the disturbance, the motor and the sensor input.
    """

    drive: FeedTable
    sensor: SensorTable
    who: Listener
    listens: bool
    safe: bool
    disturbance: float
    period: float
    clipped: Samples
    room: Samples


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Move the slide through one block, segment by segment between reactions."""
    command, (position, velocity, effort, measured_position) = inputs[0], outputs
    n = command.size
    while start < n:
        stop = n
        if memory.listens:
            stop = piece(memory.who, start, n, flags[0])
            if stop == start:
                return start, OBEY
        given, samples, now = command[start:stop], stop - start, first + start
        if memory.listens or memory.safe:
            # A copy, since a takeover changes the command, which is another node's output.
            given = memory.room[0, :samples]
            put(given, command[start:stop])
        apply(memory.who, given)
        load = memory.room[1, : samples if memory.disturbance else 0]
        fill_disturbance(now, memory.period, memory.disturbance, load)
        motor, seen = memory.room[2, :samples], memory.room[3, :samples]
        advance(
            memory.drive, now, given, load, position[start:stop], velocity[start:stop], effort[start:stop], motor, seen,
            memory.clipped,
        )  # fmt: skip
        measure(memory.sensor, seen, measured_position[start:stop])
        start = stop
    return n, DONE


class FeedDriveStage(Obedient):
    """Feed drive of a slide (see `lathe_machine.plants.feed`).

    Attributes:
        drive: simulated drive.
    """

    kind = "feed_drive"
    Parameters = FeedDriveParameters
    parameters: FeedDriveParameters
    announces = (LIMITED, FREE, OUT_OF_REACH)
    rooms = 4
    step = staticmethod(step)

    def __init__(self, name: str, parameters: FeedDriveParameters) -> None:
        super().__init__(name, parameters)
        limits = parameters.command_limits()
        rubbing, screw = parameters.rubbing(name), parameters.screw(name)
        with about(name, *_COEFFICIENTS[parameters.model]):
            self.drive = made_of(
                FeedDrive,
                parameters,
                model=parameters.transfer(),
                command_limit=parameters.command_limit or np.inf,
                speed_limit=parameters.speed_limit or np.inf,
                resolution=0.0,  # the stage's sensor rounds, not the drive's own
                limits=limits,
                friction=rubbing,
                screw=screw,
            )
        cuts = limits.any or bool(parameters.command_limit)
        self._clipped = np.zeros(messages.MAX_BLOCK if cuts else 1, np.uint8)
        self._clipping = Clipping(name, parameters, "", self._clipped)
        self._sensors = [Sensor(parameters.noise_rms, parameters.resolution, parameters.seed, name)]
        limit = parameters.command_limit
        self._obedience: Obedience = parameters.obedience(name, speed=self.drive.integrates, limit=limit, settled=0)
        self._safe = False
        self._said: list[Sparse] = []  # events of the transition to the safe state, published with the next sample
        axis = parameters.axis
        self.declare(
            inputs=[
                Input(f"{axis}/command", messages.SERVO, ("command",)),
                *listens(parameters),
            ],
            outputs=[Output(f"{axis}/state", messages.STATE, Joint("position", "velocity", "effort"))],
            tells=True,
        )

    def go_safe(self) -> None:
        """Stop the slide after a loss of cell members, and ignore further reactions."""
        self._safe = True
        self._said = self._obedience.obey(Reaction.STOP, 0)

    def finish(self, index: int) -> list[Sparse]:
        """Return the remaining events at the end of the run."""
        return self._clipping.finish(index)

    @property
    def memory(self) -> Memory:
        """Current state of the feed drive's step function."""
        parameters = self.parameters
        return Memory(
            drive=self.drive.whole,
            sensor=self._sensors[0].table,
            who=self.listener,
            listens=bool(parameters.reaction_delay) and not self._safe,
            safe=self._safe,
            disturbance=parameters.disturbance,
            period=parameters.step,
            clipped=self._clipped,
            room=self.room,
        )

    def tell(self, first: int, end: int) -> list[Sparse]:
        """Return the events of the last computed samples."""
        said, self._said = self._said, []
        for message in said:
            message.index = first
        return said + self._clipping.tell(first, end)
