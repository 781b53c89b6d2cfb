# SPDX-License-Identifier: Apache-2.0
"""Coarse electrodynamic tool drive."""

from collections.abc import Mapping
from typing import Annotated, NamedTuple

from annotated_types import Ge, Gt, Le

from lathe_rc.analysis.learning import Response
from lathe_rc.cell import messages
from lathe_rc.cell.parameters import parameter
from lathe_rc.cell.stage import DONE, Fields, Input, Joint, Output, Reached, Sparse
from lathe_rc.cell.stages.command_limits import FREE, LIMITED, LimitedCommand, LimitedParameters, limited
from lathe_rc.cell.stages.drive import Drive, Limits
from lathe_rc.cell.stages.retraction import OwnRetraction, RetractionParameters, followed
from lathe_rc.control.bounded import TakeoverTable
from lathe_rc.control.limits import LimiterTable
from lathe_rc.jit import kernel
from lathe_rc.plants.electrodynamic import CoarseTable, ElectrodynamicDrive, advance
from lathe_rc.plants.linear import Discretisation
from lathe_rc.signals.noise import Sensor, SensorTable, measure


class ElectrodynamicActuatorParameters(LimitedParameters, RetractionParameters):
    """The drive closed by its own loops, e^{-pτ}/(1 + 2ζp/ωn + p²/ωn²), its limits and its sensor."""

    natural_frequency: Annotated[float, Gt(0)] = parameter(1038.0, "natural frequency ωn", "rad/s")
    damping: Annotated[float, Gt(0)] = parameter(0.804, "damping ratio ζ", "1")
    delay: Annotated[float, Ge(0), Le(0.1)] = parameter(0.36e-3, "delay τ", "s")
    discretisation: Discretisation = parameter("foh", "foh: exact for a command linear between samples; or tustin")
    stroke: Annotated[float, Gt(0)] = parameter(1e-3, "end stops at plus and minus this displacement", "m")
    max_velocity: Annotated[float, Gt(0)] = parameter(1.0, "a profile that asks for more is refused", "m/s")
    max_acceleration: Annotated[float, Gt(0)] = parameter(200.0, "a profile that asks for more is refused", "m/s^2")
    moving_mass: Annotated[float, Gt(0)] = parameter(1.2, "carriage, coil and tool", "kg")
    force_constant: Annotated[float, Gt(0)] = parameter(30.0, "force of the coil per current", "N/A")
    noise_rms: Annotated[float, Ge(0)] = parameter(0.0, "white noise of the position sensor, RMS; 0: none", "m")
    resolution: Annotated[float, Ge(0)] = parameter(0.0, "quantisation step of the position sensor; 0: none", "m")

    def drive_models(self) -> Mapping[str, Mapping[str, float | list[float]]]:
        """See `NodeParameters`."""
        known = {"natural_frequency": self.natural_frequency, "damping": self.damping, "delay": self.delay}
        return {"coarse/command": known}


class Memory(NamedTuple):
    """What the step works on."""

    retraction: TakeoverTable
    limits: LimiterTable
    drive: CoarseTable
    sensor: SensorTable


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """See `lathe_rc.cell.stage`."""
    (command,), (position, velocity, effort, measured_position) = inputs, outputs
    given = limited(memory.limits, first, followed(memory.retraction, command))
    advance(memory.drive, given, position, velocity, effort)
    measure(memory.sensor, position, measured_position)
    return command.size, DONE


class ElectrodynamicActuator(Drive):
    """See `lathe_rc.plants.electrodynamic`.

    Attributes:
        parameters: its table.
        drive: the machine.
    """

    kind = "electrodynamic_actuator"
    Parameters = ElectrodynamicActuatorParameters
    announces = (LIMITED, FREE)
    step = staticmethod(step)

    def __init__(self, name: str, parameters: ElectrodynamicActuatorParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        self.drive = ElectrodynamicDrive(
            natural_frequency=parameters.natural_frequency,
            damping=parameters.damping,
            delay=parameters.delay,
            stroke=parameters.stroke,
            moving_mass=parameters.moving_mass,
            force_constant=parameters.force_constant,
            step=parameters.step,
            method=parameters.discretisation,
        )
        self._retraction = OwnRetraction(parameters, parameters.stroke)
        self._limited = LimitedCommand(name, parameters)
        self._sensor = Sensor(parameters.noise_rms, parameters.resolution, parameters.seed, name)
        self.declare(
            inputs=[Input("coarse/command", messages.COMMAND, ("position",))],
            outputs=[Output("coarse/state", messages.STATE, Joint("position", "velocity", "effort"))],
            tells=self._limited.on,
        )

    def responses(self) -> Mapping[str, Response]:
        """See `Drive`."""
        return {"coarse/command": self.drive.plant.response}

    def limits(self) -> Mapping[str, Limits]:
        """See `Drive`."""
        table = self.parameters
        return {"coarse/state": Limits(table.stroke, table.max_velocity, table.max_acceleration)}

    def go_safe(self) -> None:
        """See `Stage`."""
        self._retraction.begin()

    def finish(self, index: int) -> list[Sparse]:
        """See `Stage`."""
        return self._limited.finish(index)

    @property
    def memory(self) -> Memory:
        """See `Stage`."""
        return Memory(self._retraction.table, self._limited.table, self.drive.table, self._sensor.table)

    def prepare(self, first: int, samples: int) -> None:
        """See `Stage`."""
        self._sensor.draw(samples)

    def tell(self, first: int, end: int) -> list[Sparse]:
        """See `Stage`."""
        return self._limited.tell(first, end)
