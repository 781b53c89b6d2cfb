# SPDX-License-Identifier: Apache-2.0
"""Feed drive of a slide: cross or longitudinal."""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.parameters import parameter
from lathe_rc.cell.stage import Input, Joint, Output, Sparse, Stage
from lathe_rc.cell.stages.command_limits import FREE, LIMITED, Clipping, LimitedParameters
from lathe_rc.cell.stages.obedience import OUT_OF_REACH, FeedObedientParameters, Obedience, listens
from lathe_rc.errors import InputError
from lathe_rc.plants import feed
from lathe_rc.plants.feed import Feedback, FeedDrive
from lathe_rc.safety.state_machine import Reaction
from lathe_rc.signals.example_002 import fill_disturbance
from lathe_rc.signals.noise import Sensor
from lathe_rc.transfer import TransferFunction

Axis = Literal["cross", "longitudinal"]


class FeedDriveParameters(LimitedParameters, FeedObedientParameters):
    """Model from command to position, limits, backlash, and the position sensor."""

    axis: Axis = parameter("cross", "which slide; the first word of its topics")
    model: Literal["dc_screw", "fourth_order", "sampled"] = parameter(
        "dc_screw", "dc_screw: motor and screw of paper 004; fourth_order: paper 002; sampled: paper 003"
    )
    velocity_gain: Annotated[float, Gt(0)] = parameter(
        4.38e-3, "dc_screw: speed at the full command, 1; the cross feed of paper 004", "m/s"
    )
    lags: list[Annotated[float, Gt(0)]] = parameter([], "dc_screw: time constants; empty: 0.045 alone", "s")
    zero: Annotated[float, Ge(0)] = parameter(
        0.0, "dc_screw: time constant of a zero, which makes room for the lag of the cutting process", "s"
    )
    gain: Annotated[float, Gt(0)] = parameter(19.0, "fourth_order: K")
    a1: float = parameter(21.5, "fourth_order: a1, the coefficient of 1")
    a2: float = parameter(48.0, "fourth_order: a2, of p")
    a3: float = parameter(46.9, "fourth_order: a3, of p²")
    a4: float = parameter(10.2, "fourth_order: a4, of p³")
    sampled_gain: Annotated[float, Gt(0)] = parameter(6.25, "sampled: K, for a command in m", "1/s")
    sampled_lag: Annotated[float, Gt(0)] = parameter(0.08, "sampled: T1", "s")
    divisor: Annotated[int, Ge(1), Le(1_000_000)] = parameter(
        1, "the command is taken at samples that are multiples of it, and held between", "sample"
    )
    command_limit: Annotated[float, Ge(0)] = parameter(
        1.0, "largest command to each side, in its unit; the full command is 1; 0: none"
    )
    command_stroke: Annotated[float, Ge(0)] = parameter(
        0.0, "what is commanded stops the slide within this to each side; 0: none", "m"
    )
    command_velocity: Annotated[float, Ge(0)] = parameter(
        0.0, "largest velocity that is commanded: gain times command, or its change for a position; 0: none", "m/s"
    )
    command_acceleration: Annotated[float, Ge(0)] = parameter(0.0, "largest change of that velocity; 0: none", "m/s^2")
    command_jerk: Annotated[float, Ge(0)] = parameter(0.0, "largest change of that acceleration; 0: none", "m/s^3")
    speed_limit: Annotated[float, Ge(0)] = parameter(0.0, "greatest speed of the motor; 0: none", "m/s")
    disturbance: float = parameter(
        0.0, "amplitude of f(t) = A·sin²(0.04πt s⁻¹), added to the limited command; 0.5 in eq. 18 of paper 002"
    )
    backlash: Annotated[float, Ge(0)] = parameter(0.0, "gap between motor and slide", "m")
    feedback: Feedback = parameter("load", "where the position sensor is: at the motor or at the load")
    noise_rms: Annotated[float, Ge(0)] = parameter(0.0, "white noise of the position sensor, RMS; 0: none", "m")
    resolution: Annotated[float, Ge(0)] = parameter(0.0, "quantisation step of the position sensor; 0: none", "m")

    def transfer(self) -> TransferFunction:
        """Position over command.

        Raises:
            InputError: see `lathe_rc.plants.feed`.
        """
        if self.model == "fourth_order":
            return feed.fourth_order(self.gain, self.a1, self.a2, self.a3, self.a4)
        if self.model == "sampled":
            return feed.sampled(self.sampled_gain, self.sampled_lag)
        return feed.dc_screw(self.velocity_gain, self.lags or [0.045], self.zero)


class FeedDriveStage(Stage):
    """See `lathe_rc.plants.feed`.

    Attributes:
        parameters: its table.
        drive: the machine.
    """

    kind = "feed_drive"
    Parameters = FeedDriveParameters
    announces = (LIMITED, FREE, OUT_OF_REACH)

    def __init__(self, name: str, parameters: FeedDriveParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        limits = parameters.command_limits()
        try:
            self.drive = FeedDrive(
                parameters.transfer(),
                step=parameters.step,
                divisor=parameters.divisor,
                command_limit=parameters.command_limit or np.inf,
                speed_limit=parameters.speed_limit or np.inf,
                backlash=parameters.backlash,
                feedback=parameters.feedback,
                limits=limits,
            )
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
        self._clipping = Clipping(name, parameters)
        cuts = limits.any or bool(parameters.command_limit)
        self._clipped = np.empty(messages.MAX_BLOCK if cuts else 0, np.uint8)
        self._sensor = Sensor(parameters.noise_rms, parameters.resolution, parameters.seed, name)
        self._motor, self._seen, self._load = (np.empty(messages.MAX_BLOCK) for _ in range(3))
        self._obedience, self._safe = self._obeys(), False
        axis = parameters.axis
        self.declare(
            inputs=[
                Input(f"{axis}/command", messages.SERVO, ("command",)),
                *listens(parameters),
            ],
            outputs=[Output(f"{axis}/state", messages.STATE, Joint("position", "velocity", "effort"))],
            tells=True,
        )

    def _obeys(self) -> Obedience:
        limit = self.parameters.command_limit
        return self.parameters.obedience(self.name, None, speed=self.drive.integrates, limit=limit, settled=0)

    def go_safe(self) -> None:
        """See `Stage`; the slide stops, and nobody is listened to any more."""
        self._safe = True
        self._obedience.obey(Reaction.STOP)

    def finish(self, index: int) -> list[Sparse]:
        """See `Stage`."""
        return self._clipping.finish(index)

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """See `Stage`."""
        (servo, *safety), (state,) = inputs, outputs
        command = servo["command"]
        size = command.size
        if self._safe or safety:
            command = command.copy()
        listening = safety and not self._safe
        sparse: list[Sparse] = []
        for start, stop in self._obedience.pieces(safety[0]["reaction"]) if listening else [(0, size)]:
            sparse += self._obedience.told(first + start)
            self._obedience.apply(command[start:stop])
        motor, seen = self._motor[:size], self._seen[:size]
        load = self._load[: size if self.parameters.disturbance else 0]
        fill_disturbance(first, self.parameters.step, self.parameters.disturbance, load)
        clipped = self._clipped[:size]
        self.drive.block(
            first, command, state["position"], state["velocity"], state["effort"], motor, seen, load, clipped
        )
        self._sensor.measure(seen, state["measured_position"])
        return sparse + self._clipping.told(first, clipped)
