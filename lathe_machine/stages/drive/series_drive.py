# SPDX-License-Identifier: Apache-2.0
"""Piezo and tool on the coarse carriage: both drives as one stage, since they are coupled within a block."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Le
from pydantic import create_model

from lathe_machine.control.bounded import TakeoverTable
from lathe_machine.control.limits import LimiterTable
from lathe_machine.plants.tool_drive import Piezo, ToolDrive
from lathe_machine.plants.tool_motion import MotionTable, advance
from lathe_machine.stages.common.command_limits import LimitedCommand, limited
from lathe_machine.stages.common.tables import ComposedParameters, made_of, prefixed
from lathe_machine.stages.drive.drive import Drive, MotionLimits, OwnRetraction, followed
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuatorParameters
from lathe_machine.stages.drive.piezo_actuator import PiezoActuatorParameters, SetPoint, sum_up
from lathe_rc import messages
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.blocks.ports import Input, Joint, Output
from lathe_rc.cell.parameters import Positive, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples
from lathe_rc.signals.noise import Sensor, SensorTable, drawn, measure

COARSE = "coarse"  #: the displacement that the drive knows itself
FINE = "fine_"  #: begins the parameters of the fine drive


class SeriesParameters(ComposedParameters):
    """Additional parameters of the series drive, beyond those of both drives."""

    mass_ratio: Annotated[float, Ge(0), Le(1)] = parameter(0.1, "mass of the tool over coarse_moving_mass", "1")

    @property
    def coarse(self) -> ElectrodynamicActuatorParameters:
        """Parameter table of the coarse drive."""
        return self.part("coarse_", ElectrodynamicActuatorParameters)

    @property
    def fine(self) -> PiezoActuatorParameters:
        """Parameter table of the fine drive."""
        return self.part(FINE, PiezoActuatorParameters)

    def drive_models(self) -> Mapping[str, Mapping[str, float | list[float]]]:
        """Quantities of each drive alone, without their interaction."""
        return {**self.coarse.drive_models(), **self.fine.drive_models()}


SeriesDriveParameters = create_model(
    "SeriesDriveParameters",
    __base__=SeriesParameters,
    __doc__="Both drives as one mechanical system (paper 001, Fig. 1b); the tool is at the sum of both states.",
    __module__=__name__,
    **{
        **prefixed("coarse_", ElectrodynamicActuatorParameters),
        **prefixed(FINE, PiezoActuatorParameters),
        "coarse_moving_mass": (Positive, parameter(1.2, "carriage and coil, without the tool", "kg")),
    },
)


class Memory(NamedTuple):
    """Memory of the step of the series drive; the noise is that of the carriage sensor, quantised by the machine."""

    retraction: TakeoverTable
    limits: LimiterTable
    limits_fine: LimiterTable
    signs: Samples
    drive: MotionTable
    noise: SensorTable
    sensor: SensorTable
    jitter: SensorTable


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Move carriage and piezo through one block."""
    command = inputs[0]
    noise = np.empty(command.size)
    measure(memory.noise, np.zeros(command.size), noise)
    given = limited(memory.limits, first, followed(memory.retraction, command))
    wanted = limited(memory.limits_fine, first, sum_up(memory.signs, inputs, 1, command.size))
    advance(memory.drive, first, given, wanted, noise, drawn(memory.jitter, command.size), outputs[:7])
    measure(memory.sensor, outputs[4], outputs[7])
    return command.size, DONE


def piezo_on_carriage(name: str, fine: PiezoActuatorParameters, mass_ratio: float, preload: float = np.inf) -> Piezo:
    """Return the piezo of a node, at rest, with the tool on the carriage.

    Args:
        name: name of the node.
        fine: parameter table of the fine drive.
        mass_ratio: mass of the tool over that of the carriage.
        preload: preload of the stack [N].
    """
    stack, feedback = fine.stack(name, FINE), COARSE in fine.compensates
    return made_of(Piezo, fine, stack=stack, mass_ratio=mass_ratio, feedback=feedback, preload=preload)


class CoupledDrive(Drive):
    """Coarse drive, optionally with the piezo drive and the tool on its carriage, as one machine.

    Attributes:
        drive: the machine.
    """

    drive: ToolDrive
    _retraction: OwnRetraction
    _set_point: SetPoint | None = None  # of the piezo drive
    _coarse: ElectrodynamicActuatorParameters
    _make: Callable[..., ToolDrive]

    def _build(self, make: Callable[..., ToolDrive], coarse: ElectrodynamicActuatorParameters) -> None:
        """Build the machine by a function of its modes and their drift."""
        self._make = make
        self.drive = make(modes=coarse.modes(self.name, "coarse_"), drift=coarse.drift(self.name, "coarse_"))

    def _equip(self, coarse: ElectrodynamicActuatorParameters, fine: PiezoActuatorParameters | None) -> None:
        """Set limits, retraction, commands and sensors from the tables of the drives."""
        name, seed, self._coarse = self.name, self.shared.seed, coarse
        self._limits = MotionLimits(coarse.stroke, coarse.max_velocity, coarse.max_acceleration)
        self._retraction = OwnRetraction(coarse, coarse.stroke, coarse.gain)
        self._commands = [LimitedCommand(name, coarse, "coarse" if fine else "")]
        # The machine itself rounds to the resolution of the coarse sensor; here that sensor only adds noise.
        self._sensors = [Sensor(coarse.noise_rms, 0.0, seed, f"{name}/coarse"), Sensor(0.0, 0.0, seed, f"{name}/fine")]
        self._sensors.append(coarse.jitter(f"{name}/coarse"))
        if fine:
            self._set_point = SetPoint(name, fine, inside=(COARSE,), prefix=FINE)
            self._commands.append(LimitedCommand(name, fine, "fine"))
            self._sensors[1] = Sensor(fine.noise_rms, fine.resolution, seed, f"{name}/fine")

    def responses(self) -> Mapping[str, Response]:
        """Responses of the motions to the commands, in air, without active limits."""
        coarse = {"coarse/command": self.drive.coarse_response}
        return {**coarse, "fine/command": self.drive.fine_response} if self._set_point else coarse

    def states(self) -> Mapping[str, Sequence[Response]]:
        """Responses of the carriage to its command in states beside that of the start."""
        return self._coarse.states(
            self.name, self.drive.coarse_response, lambda modes: self._make(modes=modes).coarse_response, "coarse_"
        )


class SeriesDriveStage(CoupledDrive):
    """Piezo and tool on the coarse carriage, in air (see `lathe_machine.plants.tool_drive`)."""

    kind = "series_drive"
    Parameters = SeriesDriveParameters
    parameters: SeriesParameters
    step = staticmethod(step)
    _set_point: SetPoint

    def __init__(self, name: str, parameters: SeriesParameters) -> None:
        super().__init__(name, parameters)
        coarse, fine = parameters.coarse, parameters.fine
        piezo = piezo_on_carriage(name, fine, parameters.mass_ratio)
        with about(name, "mass_ratio", "sample_rate"):
            self._build(partial(made_of, ToolDrive, coarse, method=parameters.discretisation, piezo=piezo), coarse)
        self._equip(coarse, fine)
        self.declare(
            inputs=[Input("coarse/command", messages.COMMAND, ("position",)), *self._set_point.inputs],
            outputs=[
                Output("coarse/state", messages.STATE, Joint("position", "velocity", "effort")),
                Output("fine/state", messages.STATE),
            ],
            tells=any(command.on for command in self._commands),
        )

    @property
    def memory(self) -> Memory:
        """Current memory of the step of the series drive."""
        limits, limits_fine = (command.table for command in self._commands)
        sensors = (sensor.table for sensor in self._sensors)
        return Memory(self._retraction.table, limits, limits_fine, self._set_point.signs, self.drive.table, *sensors)
