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
from lathe_rc.cell.stage import DONE, Fields, Input, Joint, Output, Reached, Sparse
from lathe_rc.cell.stages.command_limits import FREE, LIMITED, LimitedCommand, limited
from lathe_rc.cell.stages.composed import ComposedParameters, prefixed
from lathe_rc.cell.stages.drive import Drive, Limits
from lathe_rc.cell.stages.electrodynamic_actuator import ElectrodynamicActuatorParameters
from lathe_rc.cell.stages.piezo_actuator import PiezoActuatorParameters
from lathe_rc.cell.stages.retraction import OwnRetraction, followed
from lathe_rc.cell.stages.set_point import SetPoint, sum_up
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
    position, velocity, effort, measured, fine_position, fine_velocity, fine_effort, fine_measured = outputs
    noise = np.empty(command.size)
    measure(memory.noise, np.zeros(command.size), noise)
    given = limited(memory.limits, first, followed(memory.retraction, command))
    wanted = limited(memory.limits_fine, first, sum_up(memory.signs, inputs, 1, command.size))
    advance(
        memory.drive, first, given, wanted, noise, position, velocity, effort, measured, fine_position, fine_velocity,
        fine_effort,
    )  # fmt: skip
    measure(memory.sensor, fine_position, fine_measured)
    return command.size, DONE


def piezo_on_carriage(name: str, fine: PiezoActuatorParameters, mass_ratio: float, preload: float = np.inf) -> Piezo:
    """The piezo of a node, at rest, with the tool on the carriage.

    Args:
        name: of the node.
        fine: its table of the fine drive.
        mass_ratio: mass of the tool over that of the carriage.
        preload: of the stack [N].
    """
    return Piezo(
        stack=fine.stack(name, FINE),
        tool_frequency=fine.natural_frequency,
        tool_damping=fine.damping,
        mass_ratio=mass_ratio,
        full_voltage=fine.full_voltage,
        feedback=COARSE in fine.compensates,
        preload=preload,
    )


def tool_drive(coarse: ElectrodynamicActuatorParameters, shared: ComposedParameters, **beside: Any) -> ToolDrive:
    """The machine of a coarse drive's table, and of what is given ``beside`` it, see `ToolDrive`."""
    return ToolDrive(
        carriage_frequency=coarse.natural_frequency,
        carriage_damping=coarse.damping,
        delay=coarse.delay,
        carriage_stroke=coarse.stroke,
        moving_mass=coarse.moving_mass,
        force_constant=coarse.force_constant,
        resolution=coarse.resolution,
        step=shared.step,
        method=shared.discretisation,
        **beside,
    )


class SeriesDriveStage(Drive):
    """See `lathe_rc.plants.tool_drive`.

    Attributes:
        parameters: its table.
        drive: the machine.
    """

    kind = "series_drive"
    Parameters = SeriesDriveParameters
    announces = (LIMITED, FREE)
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
        self._limited = LimitedCommand(name, coarse, "coarse"), LimitedCommand(name, fine, "fine")
        self._set_point = SetPoint(name, fine, inside=(COARSE,), prefix=FINE)
        # The machine itself rounds to the resolution of the coarse sensor; here that sensor measures nothing but noise.
        self._coarse_noise = Sensor(coarse.noise_rms, 0.0, parameters.seed, f"{name}/coarse")
        self._fine_sensor = Sensor(fine.noise_rms, fine.resolution, parameters.seed, f"{name}/fine")
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

    def limits(self) -> Mapping[str, Limits]:
        """See `Drive`."""
        return {"coarse/state": self._limits}

    def go_safe(self) -> None:
        """See `Stage`; the carriage takes the tool out."""
        self._retraction.begin()

    def finish(self, index: int) -> list[Sparse]:
        """See `Stage`."""
        return [message for limited in self._limited for message in limited.finish(index)]

    @property
    def memory(self) -> Memory:
        """See `Stage`."""
        limits, limits_fine = (limited.table for limited in self._limited)
        return Memory(
            self._retraction.table, limits, limits_fine, self._set_point.signs, self.drive.table,
            self._coarse_noise.table, self._fine_sensor.table,
        )  # fmt: skip

    def prepare(self, first: int, samples: int) -> None:
        """See `Stage`."""
        self._coarse_noise.draw(samples)
        self._fine_sensor.draw(samples)

    def tell(self, first: int, end: int) -> list[Sparse]:
        """See `Stage`."""
        return [message for limited in self._limited for message in limited.tell(first, end)]
