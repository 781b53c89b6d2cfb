# SPDX-License-Identifier: Apache-2.0
"""Drives as plug-ins: a class with an equation per sample, independent of ports, blocks and events."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from lathe_machine.control.bounded import TakeoverTable
from lathe_machine.control.limits import LimiterTable
from lathe_machine.stages.common.command_limits import LimitedCommand, LimitedParameters, limited
from lathe_machine.stages.common.sampled import Sampled, checked
from lathe_machine.stages.drive.drive import Drive, MotionLimits, OwnRetraction, RetractionParameters, followed
from lathe_rc import messages
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.analysis.resonance_grid import NO_POLES
from lathe_rc.arrays import Array, Complex
from lathe_rc.blocks.ports import Input, Joint, Output
from lathe_rc.cell.parameters import NonNegative, Positive, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.extensions import code_of_others
from lathe_rc.signals.noise import Sensor, SensorTable, measure

_NO_FREQUENCY = np.zeros(1)  # [rad/s]


class PlantParameters(LimitedParameters, RetractionParameters):
    """Limits and sensor of a drive that moves the tool alone."""

    stroke: Positive = parameter(1e-3, "end stops at plus and minus this displacement", "m")
    max_velocity: Positive = parameter(1.0, "a profile that asks for more is refused", "m/s")
    max_acceleration: Positive = parameter(200.0, "a profile that asks for more is refused", "m/s^2")
    noise_rms: NonNegative = parameter(0.0, "white noise of the position sensor, RMS; 0: none", "m")
    resolution: NonNegative = parameter(0.0, "quantisation step of the position sensor; 0: none", "m")


class PlantMemory(NamedTuple):
    """Memory of the step of a drive.

    Attributes:
        retraction: autonomous retraction after a loss of cell members.
        limits: limits of the command.
        plant: memory of the drive itself.
        sensor: sensor of the position.
    """

    retraction: TakeoverTable
    limits: LimiterTable
    plant: Any
    sensor: SensorTable


class SingleDrive(Drive):
    """Drive that moves the tool alone, with limited command, measured position, and retraction."""

    parameters: PlantParameters
    _retraction: OwnRetraction

    def __init__(self, name: str, parameters: PlantParameters) -> None:
        super().__init__(name, parameters)
        self._retraction = OwnRetraction(parameters, parameters.stroke)
        self._limits = MotionLimits(parameters.stroke, parameters.max_velocity, parameters.max_acceleration)
        self._commands = [LimitedCommand(name, parameters)]
        self._sensors = [Sensor(parameters.noise_rms, parameters.resolution, parameters.seed, name)]
        self.declare(
            inputs=[Input("coarse/command", messages.COMMAND, ("position",))],
            outputs=[Output("coarse/state", messages.STATE, Joint("position", "velocity", "effort"))],
            tells=self._commands[0].on,
        )

    @property
    @abstractmethod
    def machine(self) -> Any:
        """Memory of the drive itself, without limits and sensor."""

    @property
    def memory(self) -> PlantMemory:
        """Current memory of the step of the drive."""
        return PlantMemory(self._retraction.table, self._commands[0].table, self.machine, self._sensors[0].table)


Moved = tuple[float, float, float]  #: position [m], velocity [m/s], and effort [N or V] of a drive


def _loop(sample: Callable[[Any, float], Moved]) -> Callable[..., Reached]:
    """Build the step of a drive from its equation for one sample."""

    def step(memory: PlantMemory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
        """Move the drive through one block, within its limits."""
        command, (position, velocity, effort, measured_position) = inputs[0], outputs
        given = limited(memory.limits, first, followed(memory.retraction, command))
        for k in range(given.size):
            position[k], velocity[k], effort[k] = sample(memory.plant, given[k])
        measure(memory.sensor, position, measured_position)
        return command.size, DONE

    return step


class Plant(Sampled, SingleDrive):
    """Base class of user-defined drives.

    A drive has a table ``Parameters``, an initial memory (`start`), and an equation ``sample(memory,
    command)``, which returns position, velocity and effort: a `kernel`, whose memory is a NamedTuple of arrays of
    float64, int64 or uint8, numbers, and nested NamedTuples; or a function in plain Python, for any memory. It may
    change arrays of the memory and nothing else.

    Attributes:
        plant: memory of the drive.

    Example:
        >>> import numpy as np
        >>> from lathe_machine import Plant, PlantParameters
        >>> from lathe_rc import kernel, parameter
        >>> from typing import NamedTuple
        >>> class LagParameters(PlantParameters):
        ...     lag: float = parameter(1e-3, "time constant", "s")
        >>> class Memory(NamedTuple):
        ...     pole: float
        ...     position: np.ndarray
        >>> @kernel  # or nothing: then it is plain Python, slower, with the same bits
        ... def sample(memory: Memory, command: float) -> tuple[float, float, float]:
        ...     memory.position[0] += memory.pole * (command - memory.position[0])
        ...     return memory.position[0], 0.0, 0.0  # position [m], velocity [m/s], effort [N or V]
        >>> class FirstOrder(Plant):
        ...     Parameters = LagParameters
        ...     sample = staticmethod(sample)
        ...
        ...     def start(self) -> Memory:
        ...         return Memory(1.0 - np.exp(-self.parameters.step / self.parameters.lag), np.zeros(1))
    """

    Parameters = PlantParameters
    parameters: PlantParameters
    #: poles of `response` [rad/s], shape (k,): checks resolve those that are narrower than their grids
    poles: Complex = NO_POLES
    sample: ClassVar[Callable[[Any, float], Moved]]
    loop = staticmethod(_loop)

    def __init__(self, name: str, parameters: PlantParameters) -> None:
        super().__init__(name, parameters)
        self.plant = self.started()

    def response(self, frequency: Array) -> Complex | None:
        """Return the response of the position to the command at frequencies [rad/s], shape (n,).

        The check before a start and the stability margin use it. A drive without this method is reported as
        unchecked.
        """
        return None

    @property
    def machine(self) -> Any:
        """Memory of the user-defined drive, used by the step."""
        return self.plant

    def responses(self) -> Mapping[str, Response]:
        """Response of the position to the command, by topic."""
        with code_of_others(f"{self.name}: response"):
            if self.response(_NO_FREQUENCY) is None:
                return {}
        return {"coarse/command": self._told}

    def _told(self, frequency: Array) -> Complex:
        with code_of_others(f"{self.name}: response"):
            told = self.response(frequency)
        return checked(f"{self.name}: response", told, frequency)
