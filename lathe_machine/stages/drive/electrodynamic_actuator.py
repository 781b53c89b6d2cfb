# SPDX-License-Identifier: Apache-2.0
"""Coarse electrodynamic tool drive."""

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

from annotated_types import Ge, Le

from lathe_machine.analysis.modal_drive import OPTIONAL, ModalDrive
from lathe_machine.analysis.rational_model import of_modal_drive
from lathe_machine.plants.drift import NONE as NO_DRIFT
from lathe_machine.plants.drift import Drift
from lathe_machine.plants.electrodynamic import CoarseTable, ElectrodynamicDrive, advance
from lathe_machine.plants.linear import Discretisation
from lathe_machine.plants.modes import Modes
from lathe_machine.stages.common.command_limits import limited
from lathe_machine.stages.common.tables import made_of
from lathe_machine.stages.drive.drive import OwnRetraction, followed
from lathe_machine.stages.drive.plant import PlantMemory, PlantParameters, SingleDrive
from lathe_rc import resources
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.analysis.measured_drive import DriftedDrive, MeasuredDrive, read_points
from lathe_rc.cell.parameters import NonNegative, Positive, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.signals.noise import Sensor, SensorTable, drawn, measure


class ElectrodynamicActuatorParameters(PlantParameters):
    """Drive with closed internal loops, g·e^{-pτ}/(1 + 2ζp/ωn + p²/ωn²), its limits and its sensor."""

    natural_frequency: Positive = parameter(1038.0, "natural frequency ωn", "rad/s")
    damping: Positive = parameter(0.804, "damping ratio ζ", "1")
    delay: Annotated[float, Ge(0), Le(0.1)] = parameter(0.36e-3, "delay τ", "s")
    gain: float = parameter(1.0, "static gain g from command to position, of either sign", "1")
    discretisation: Discretisation = parameter("foh", "foh: exact for a command linear between samples; or tustin")
    moving_mass: Positive = parameter(1.2, "carriage, coil and tool", "kg")
    force_constant: Positive = parameter(30.0, "force of the coil per current", "N/A")
    mode_frequency: list[Positive] = parameter([], "further resonances: frequency of each", "rad/s")
    mode_damping: list[Positive] = parameter([], "their damping ratios", "1")
    mode_participation: list[float] = parameter(
        [], "their parts in the motion of the position sensor; the part of the drive itself is the rest to 1", "1"
    )
    mode_edge: list[float] = parameter([], "their parts in the motion of the edge; empty: as at the sensor", "1")
    mode_velocity: list[float] = parameter(
        [], "parts of their velocities over their frequencies in the motion (complex residues); empty: none", "1"
    )
    lag_time: list[Positive] = parameter([], "further first-order lags (real poles): time constant of each", "s")
    lag_participation: list[float] = parameter([], "their parts in the motion, as of modes", "1")
    gain_drift: float = parameter(0.0, "relative change of the gain per time, up to drift_time; 0: none", "1/s")
    mode_drift: float = parameter(
        0.0, "relative change of the frequencies of the modes per time, up to drift_time; 0: none", "1/s"
    )
    drift_time: NonNegative = parameter(0.0, "time from the start of the run at which a drift ends", "s")
    sampling_jitter: NonNegative = parameter(
        0.0, "jitter of the instants at which the position sensor samples, RMS; 0: none", "s"
    )
    response_file: str = parameter(
        "",
        "measured frequency response of the drive, CSV as of lathe fit drive: checks and drive margin then hold for "
        "its points as well",
        path=True,
    )

    def _measured(self, node: str, model: Response, prefix: str) -> list[Response]:
        if not self.response_file:
            return []
        with about(node, f"{prefix}response_file"):
            states = read_points(resources.find(Path(self.response_file)))
        return [MeasuredDrive(*points, model) for points in states]

    def states(
        self, node: str, model: Response, drifted: Callable[[Modes], Response], prefix: str = ""
    ) -> Mapping[str, Sequence[Response]]:
        """Return the responses in the states beside that of the start, by topic: as measured, and along the drift.

        Args:
            node: name of the node.
            model: response at the start.
            drifted: makes the response with modes that have moved.
            prefix: prefix of the parameters.

        Raises:
            InputError: a file cannot be used.
        """
        modes, along = self._modes(), self.drift(node, prefix).states()[1:]
        drifts = [DriftedDrive(drifted(modes.moved(each.modes)), each.gain, each.time) for each in along]
        return {"coarse/command": [*self._measured(node, model, prefix), *drifts]}

    def drift(self, node: str, prefix: str = "") -> Drift:
        """Return the drift of a node; ``prefix`` precedes its parameters in a composed table.

        Raises:
            InputError: it cannot be, or the jitter of the sensor is not below a sample.
        """
        if self.sampling_jitter >= self.step:
            raise InputError(
                f"{node}.{prefix}sampling_jitter = {self.sampling_jitter:g} s; allowed: below a sample, {self.step:g} s"
            )
        with about(node, f"{prefix}gain_drift", f"{prefix}mode_drift", f"{prefix}drift_time"):
            drift = Drift(self.gain_drift, self.mode_drift, self.drift_time)
        if not self.mode_drift:
            return drift
        if not self.mode_frequency or not self._modes().normal:
            raise InputError(
                f"{node}.{prefix}mode_drift = {self.mode_drift:g} 1/s; allowed: 0, or with {prefix}mode_frequency, and "
                f"without {prefix}mode_velocity and {prefix}lag_time"
            )
        highest, nyquist = max(self.mode_frequency) * drift.states()[-1].modes, math.pi / self.step
        if highest >= nyquist:
            raise InputError(
                f"{node}.{prefix}mode_drift = {self.mode_drift:g} 1/s: a mode at {highest:g} rad/s; allowed: below "
                f"half the sample rate, {nyquist:.6g} rad/s"
            )
        return drift

    def made(self, modes: Modes, drift: Drift = NO_DRIFT) -> ElectrodynamicDrive:
        """Return the drive with these modes and drift."""
        return made_of(ElectrodynamicDrive, self, method=self.discretisation, modes=modes, drift=drift)

    def jitter(self, whose: str) -> Sensor:
        """Return the jitter of the sampling instants of a sensor, by its name."""
        return Sensor(self.sampling_jitter, 0.0, self.seed, f"{whose}/jitter")

    def modes(self, node: str, prefix: str = "") -> Modes:
        """Return the modes and lags of a node; ``prefix`` precedes its parameters in a composed table.

        Raises:
            InputError: they cannot be, or the gain is 0.
        """
        if not self.gain:
            raise InputError(f"{node}.{prefix}gain = 0; allowed: of either sign, not 0")
        names = [f"{prefix}mode_{each}" for each in ("frequency", "damping", "participation", "edge")]
        if self.mode_velocity or self.lag_time or self.lag_participation:
            names += [f"{prefix}{each}" for each in ("mode_velocity", "lag_time", "lag_participation")]
        for frequency in self.mode_frequency:
            if frequency >= math.pi / self.step:
                raise InputError(
                    f"{node}.{names[0]} = {frequency:g} rad/s; allowed: below half the sample rate, "
                    f"{math.pi / self.step:.6g} rad/s (a higher sample_rate, or without this mode)"
                )
        with about(node, *names):
            return self._modes()

    def _modes(self) -> Modes:
        sensor, edge = self.mode_participation, self.mode_edge
        of_modes = (self.mode_frequency, self.mode_damping, sensor, edge or sensor, self.mode_velocity)
        return Modes(*map(tuple, (*of_modes, self.lag_time, self.lag_participation)))

    def drive_models(self) -> Mapping[str, Mapping[str, float | list[float]]]:
        """Quantities of the drive that controllers may know, by command topic: of second and of fourth order."""
        frequency, damping = self.natural_frequency, self.damping
        if self.mode_velocity or self.lag_time:
            frequency, damping = self._modes().model(frequency, damping)
        known: dict[str, float | list[float]] = {
            "natural_frequency": frequency, "damping": damping, "delay": self.delay
        }  # fmt: skip
        model = None
        with contextlib.suppress(InputError):  # the stage itself refuses modes that cannot be, by their names
            self._modes()
            model = of_modal_drive(self._modal_drive())
        if model is not None:
            known |= {"inverse.denominator": model[:4].tolist(), "inverse.numerator": model[4:].tolist()}
        return {"coarse/command": known}

    def _modal_drive(self) -> ModalDrive:
        lists = {name: tuple(getattr(self, name)) for name in OPTIONAL}
        return ModalDrive(self.natural_frequency, self.damping, self.delay, gain=self.gain, **lists)


class Machine(NamedTuple):
    """Drive, and the jitter of its sensor [s]."""

    drive: CoarseTable
    jitter: SensorTable


@kernel
def step(memory: PlantMemory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Move the drive through one block, within its limits."""
    command, (position, velocity, effort, measured_position) = inputs[0], outputs
    given, machine = limited(memory.limits, first, followed(memory.retraction, command)), memory.plant
    jitter = drawn(machine.jitter, command.size)
    advance(machine.drive, first, given, jitter, position, velocity, effort, measured_position)
    measure(memory.sensor, measured_position, measured_position)
    return command.size, DONE


class ElectrodynamicActuator(SingleDrive):
    """Coarse electrodynamic drive in air (see `lathe_machine.plants.electrodynamic`).

    Attributes:
        drive: machine of the drive.
    """

    parameters: ElectrodynamicActuatorParameters
    kind = "electrodynamic_actuator"
    Parameters = ElectrodynamicActuatorParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: ElectrodynamicActuatorParameters) -> None:
        self.drive = parameters.made(parameters.modes(name), parameters.drift(name))
        super().__init__(name, parameters)
        self._sensors = [*self._sensors, parameters.jitter(name)]
        self._retraction = OwnRetraction(parameters, parameters.stroke, parameters.gain)

    @property
    def machine(self) -> Machine:
        """Parameter and state table of the machine, used by the step."""
        return Machine(self.drive.table, self._sensors[1].table)

    def responses(self) -> Mapping[str, Response]:
        """Response of the sensor's position to the command, by topic."""
        return {"coarse/command": self.drive.plant.response}

    def states(self) -> Mapping[str, Sequence[Response]]:
        """Responses of the sensor's position to the command in states beside that of the start, by topic."""
        parameters, model = self.parameters, self.drive.plant.response
        return parameters.states(self.name, model, lambda modes: parameters.made(modes).plant.response)
