# SPDX-License-Identifier: Apache-2.0
"""Piezo and tool on the coarse carriage: both drives as one stage, for no block may cut what couples them."""

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le
from pydantic import create_model

from lathe_rc import messages
from lathe_rc.analysis.learning import Response
from lathe_rc.cell.parameters import about, parameter
from lathe_rc.cell.stage import DONE, Fields, Input, Joint, Output, Reached
from lathe_rc.cell.stages.command_limits import LimitedCommand, limited
from lathe_rc.cell.stages.drive import Drive, Limits, OwnRetraction, followed
from lathe_rc.cell.stages.electrodynamic_actuator import ElectrodynamicActuatorParameters
from lathe_rc.cell.stages.piezo_actuator import PiezoActuatorParameters, SetPoint, sum_up
from lathe_rc.cell.stages.tables import ComposedParameters, made_of, prefixed
from lathe_rc.control.bounded import TakeoverTable
from lathe_rc.control.limits import LimiterTable
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples
from lathe_rc.plants.tool_drive import Piezo, ToolDrive
from lathe_rc.plants.tool_motion import MotionTable, advance
from lathe_rc.signals.noise import Sensor, SensorTable, measure

COARSE = "coarse"  #: the displacement that the drive knows itself
FINE = "fine_"  #: begins the parameters of the fine drive


class SeriesParameters(ComposedParameters):
    """Parameters of the series drive beyond those of both drives."""

    mass_ratio: Annotated[float, Ge(0), Le(1)] = parameter(0.1, "mass of the tool over coarse_moving_mass", "1")

    @property
    def coarse(self) -> ElectrodynamicActuatorParameters:
        """The table of the coarse drive."""
        return self.part("coarse_", ElectrodynamicActuatorParameters)

    @property
    def fine(self) -> PiezoActuatorParameters:
        """The table of the fine drive."""
        return self.part(FINE, PiezoActuatorParameters)

    def drive_models(self) -> Mapping[str, Mapping[str, float | list[float]]]:
        """See `NodeParameters`; each drive by itself, without what one does to the other."""
        return {**self.coarse.drive_models(), **self.fine.drive_models()}


SeriesDriveParameters = create_model(
    "SeriesDriveParameters",
    __base__=SeriesParameters,
    __doc__="Both drives as one mechanical system (paper 001, Fig. 1b); the tool is at the sum of both states.",
    __module__=__name__,
    **{
        **prefixed("coarse_", ElectrodynamicActuatorParameters),
        **prefixed(FINE, PiezoActuatorParameters),
        "coarse_moving_mass": (Annotated[float, Gt(0)], parameter(1.2, "carriage and coil, without the tool", "kg")),
    },
)


class Memory(NamedTuple):
    """Memory of the step; the noise is that of the carriage's sensor, which the machine itself rounds."""

    retraction: TakeoverTable
    limits: LimiterTable
    limits_fine: LimiterTable
    signs: Samples
    drive: MotionTable
    noise: SensorTable
    sensor: SensorTable


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """See `lathe_rc.cell.stage`."""
    command = inputs[0]
    noise = np.empty(command.size)
    measure(memory.noise, np.zeros(command.size), noise)
    given = limited(memory.limits, first, followed(memory.retraction, command))
    wanted = limited(memory.limits_fine, first, sum_up(memory.signs, inputs, 1, command.size))
    advance(memory.drive, first, given, wanted, noise, outputs[:7])
    measure(memory.sensor, outputs[4], outputs[7])
    return command.size, DONE


def piezo_on_carriage(name: str, fine: PiezoActuatorParameters, mass_ratio: float, preload: float = np.inf) -> Piezo:
    """The piezo of a node, at rest, with the tool on the carriage.

    Args:
        name: of the node.
        fine: its table of the fine drive.
        mass_ratio: mass of the tool over that of the carriage.
        preload: of the stack [N].
    """
    stack, feedback = fine.stack(name, FINE), COARSE in fine.compensates
    return made_of(Piezo, fine, stack=stack, mass_ratio=mass_ratio, feedback=feedback, preload=preload)


def tool_drive(coarse: ElectrodynamicActuatorParameters, shared: ComposedParameters, **beside: Any) -> ToolDrive:
    """The machine of a coarse drive's table, and of what is given ``beside`` it, see `ToolDrive`."""
    return made_of(ToolDrive, coarse, method=shared.discretisation, **beside)


class SeriesDriveStage(Drive):
    """See `lathe_rc.plants.tool_drive`.

    Attributes:
        parameters: its table.
        drive: the machine.
    """

    kind = "series_drive"
    Parameters = SeriesDriveParameters
    _retraction: OwnRetraction
    step = staticmethod(step)

    def __init__(self, name: str, parameters: SeriesParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        coarse, fine = parameters.coarse, parameters.fine
        piezo = piezo_on_carriage(name, fine, parameters.mass_ratio)
        with about(name, "mass_ratio", "sample_rate"):
            self.drive = tool_drive(coarse, parameters, piezo=piezo)
        self._limits = Limits(coarse.stroke, coarse.max_velocity, coarse.max_acceleration)
        self._retraction = OwnRetraction(coarse, coarse.stroke)
        self._limited = [LimitedCommand(name, coarse, "coarse"), LimitedCommand(name, fine, "fine")]
        self._set_point = SetPoint(name, fine, inside=(COARSE,), prefix=FINE)
        # The machine itself rounds to the resolution of the coarse sensor; here that sensor measures nothing but noise.
        self._sensors = [
            Sensor(coarse.noise_rms, 0.0, parameters.seed, f"{name}/coarse"),
            Sensor(fine.noise_rms, fine.resolution, parameters.seed, f"{name}/fine"),
        ]
        self.declare(
            inputs=[Input("coarse/command", messages.COMMAND, ("position",)), *self._set_point.inputs],
            outputs=[
                Output("coarse/state", messages.STATE, Joint("position", "velocity", "effort")),
                Output("fine/state", messages.STATE),
            ],
            tells=any(limited.on for limited in self._limited),
        )

    def responses(self) -> Mapping[str, Response]:
        """See `Drive`."""
        return {"coarse/command": self.drive.coarse_response, "fine/command": self.drive.fine_response}

    @property
    def memory(self) -> Memory:
        """See `Stage`."""
        limits, limits_fine = (limited.table for limited in self._limited)
        sensors = (sensor.table for sensor in self._sensors)
        return Memory(self._retraction.table, limits, limits_fine, self._set_point.signs, self.drive.table, *sensors)
