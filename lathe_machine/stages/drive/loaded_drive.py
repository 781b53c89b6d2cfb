# SPDX-License-Identifier: Apache-2.0
"""Tool drives under the cutting force: drives and cut as one stage, since they are coupled within a block."""

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le
from pydantic import create_model

from lathe_machine.control.bounded import TakeoverTable
from lathe_machine.control.limits import CommandLimits, LimiterTable, limiter
from lathe_machine.plants.chip import CutTable
from lathe_machine.plants.coil import Coil
from lathe_machine.plants.tool_drive import ToolDrive
from lathe_machine.plants.tool_motion import STOPS, MotionTable, advance_loaded, failure
from lathe_machine.signals.allowance import AllowanceTable, allow
from lathe_machine.stages.common.command_limits import Clipping, limited
from lathe_machine.stages.common.tables import ComposedParameters, made_of, prefixed
from lathe_machine.stages.cut.cutting_process import READ, TURNS, CutStage, CuttingProcessParameters
from lathe_machine.stages.drive.drive import followed
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuatorParameters
from lathe_machine.stages.drive.piezo_actuator import PiezoActuatorParameters, sum_up
from lathe_machine.stages.drive.series_drive import FINE, CoupledDrive, piezo_on_carriage
from lathe_rc import messages
from lathe_rc.arrays import put, put_scaled
from lathe_rc.blocks.ports import Input, Joint, Output
from lathe_rc.cell.parameters import NonNegative, Positive, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples
from lathe_rc.signals.noise import SensorTable, drawn, measure

_CUT = "cut_"  # prefix of the parameters of the cut
_COIL = "coil"  # source of limit events
_COIL_LIMITS = ("current_limit", "voltage_limit", "slew_rate")
_NO_LIMITS = limiter(CommandLimits(), 1.0, 1)
_REFERENCE = Input("reference", messages.REFERENCE, ("reference", "height"))


class LoadedCoarseParameters(ElectrodynamicActuatorParameters):
    """Parameters of the coarse drive with its current loop."""

    loop: Literal["ideal", "current"] = parameter(
        "ideal",
        "ideal: the force of the position loop is there at once; current: a coil with its current loop makes it",
    )
    resistance: Positive = parameter(2.0, "loop current: of the coil", "ohm")
    inductance: Positive = parameter(2e-3, "loop current: of the coil", "H")
    bandwidth: Positive = parameter(12e3, "loop current: bandwidth of the current loop", "rad/s")
    back_emf: bool = parameter(
        default=True, doc="loop current: the motion induces a voltage, force_constant · velocity"
    )
    current_limit: NonNegative = parameter(0.0, "loop current: largest set point; 0: any", "A")
    voltage_limit: NonNegative = parameter(0.0, "loop current: of the amplifier; 0: any", "V")
    slew_rate: NonNegative = parameter(0.0, "loop current: the set point changes no faster; 0: any", "A/s")

    def coil(self, node: str) -> Coil | None:
        """Return the current loop of a node, if there is one.

        Raises:
            InputError: a limit belongs to a missing current loop.
        """
        if self.loop == "current":
            limits = {name: getattr(self, name) or np.inf for name in _COIL_LIMITS}
            return made_of(Coil, self, **limits)
        for name in _COIL_LIMITS:
            if value := getattr(self, name):
                raise InputError(f"{node}.coarse_{name} = {value:g} with coarse_loop = ideal; allowed: 0, or current")
        return None


class LoadedFineParameters(PiezoActuatorParameters):
    """Parameters of the piezo drive with its preload."""

    preload: NonNegative = parameter(
        0.0, "of the stack: a larger tension tears it off and ends the run; 0: it holds any", "N"
    )


class LoadedParameters(ComposedParameters):
    """Additional parameters of drives under the cutting force, beyond those of drives and cut."""

    radial_ratio: Annotated[float, Ge(0), Le(2)] = parameter(
        0.4, "radial part of the cutting force, which pushes the tool out of the part, over the main one"
    )

    def model_post_init(self, context: Any, /) -> None:
        """Reject process damping, whose flank force would have to be solved together with the compliant drives."""
        super().model_post_init(context)
        if pressure := getattr(self, f"{_CUT}flank_pressure", 0.0):
            raise InputError(
                f"{_CUT}flank_pressure = {pressure:g}: no process damping under drives that give way; allowed: "
                "0, or a cutting_process with drives of their own"
            )

    @property
    def coarse(self) -> LoadedCoarseParameters:
        """Parameter table of the coarse drive."""
        return self.part("coarse_", LoadedCoarseParameters)

    @property
    def cut(self) -> CuttingProcessParameters:
        """Parameter table of the cut."""
        return self.part(_CUT, CuttingProcessParameters)

    def drive_models(self) -> Mapping[str, Mapping[str, float | list[float]]]:
        """Quantities of each drive alone, without force and current loop."""
        return self.coarse.drive_models()


class LoadedSeriesParameters(LoadedParameters):
    """Additional parameters of both drives in series under the cutting force."""

    mass_ratio: Annotated[float, Gt(0), Le(1)] = parameter(
        0.1, "mass of the tool over coarse_moving_mass; times that and fine_natural_frequency²: stiffness of the stack"
    )

    @property
    def fine(self) -> LoadedFineParameters:
        """Parameter table of the fine drive."""
        return self.part(FINE, LoadedFineParameters)

    def drive_models(self) -> Mapping[str, Mapping[str, float | list[float]]]:
        """Quantities of each drive alone, without force and current loop."""
        return {**self.coarse.drive_models(), **self.fine.drive_models()}


_OF_COARSE_AND_CUT = {
    **prefixed("coarse_", LoadedCoarseParameters),
    **prefixed(_CUT, CuttingProcessParameters),
    "cut_moved_by": (
        list[Literal["cross", "longitudinal"]],
        parameter([], "what moves the edge beside the drives: the cross feed, the longitudinal feed"),
    ),
}

LoadedDriveParameters = create_model(
    "LoadedDriveParameters",
    __base__=LoadedParameters,
    __doc__="The electrodynamic drive and the cut as one mechanical system; a profile node publishes the form.",
    __module__=__name__,
    **_OF_COARSE_AND_CUT,
)
LoadedSeriesDriveParameters = create_model(
    "LoadedSeriesDriveParameters",
    __base__=LoadedSeriesParameters,
    __doc__="Both drives in series (paper 001, Fig. 1b) and the cut as one mechanical system; a profile node publishes "
    "the form, and the tool is at the sum of both states.",
    __module__=__name__,
    **{
        **_OF_COARSE_AND_CUT,
        **prefixed(FINE, LoadedFineParameters),
        "coarse_moving_mass": (Positive, parameter(1.2, "carriage and coil, without the tool", "kg")),
    },
)


class Memory(NamedTuple):
    """Memory of the step of the loaded drives.

    Attributes:
        retraction, limits, limits_fine: retraction and limits of the commands.
        signs: signs of the terms of the fine set point.
        drive, cut: the machine.
        noise, sensor: noise of the carriage sensor, which is quantised by the machine, and sensor of the piezo.
        jitter: jitter of the sampling instants of the carriage sensor [s].
        allowance: machining allowance of the blank.
        force_sensor: sensor of the force.
        cross, longitudinal: number of the first input of each slide; -1 if it does not move the edge.
        even: whether the blank has the desired form.
        feed: constant feed without a longitudinal slide [m/rad].
        room: scratch arrays of a block.
    """

    retraction: TakeoverTable
    limits: LimiterTable
    limits_fine: LimiterTable
    signs: Samples
    drive: MotionTable
    cut: CutTable
    noise: SensorTable
    sensor: SensorTable
    jitter: SensorTable
    allowance: AllowanceTable
    force_sensor: SensorTable
    cross: int
    longitudinal: int
    even: bool
    feed: float
    room: Samples


# Inputs: angle and speed, form and height, command; then the terms of the piezo's set point, and the slides.
_MORE = 5


@kernel
def _advance(
    memory: Memory, first: int, inputs: Fields, motion: Fields, fine_measured: Samples, of_cut: Fields
) -> tuple[int, int]:
    """Advance drives and cut through a block; without a fine drive, its arrays are scratch memory."""
    angle, speed, wanted, height, command = inputs[0], inputs[1], inputs[2], inputs[3], inputs[4]
    force, measured_force, depth_of_cut, feed, allowance, wear, deflection = of_cut
    n, room = angle.size, memory.room
    met, cross_position, feed_velocity, noise, still = room[0, :n], room[1, :n], room[2, :n], room[3, :n], room[4, :n]
    met[:] = cross_position[:] = still[:] = 0.0
    if memory.even:
        put(met, wanted)
    if memory.cross >= 0:
        put_scaled(cross_position, -1.0, inputs[memory.cross])
    if memory.longitudinal >= 0:
        height, feed_velocity = inputs[memory.longitudinal], inputs[memory.longitudinal + 1]
    else:
        put_scaled(feed_velocity, memory.feed, speed)
    allow(memory.allowance, angle, allowance)
    measure(memory.noise, still, noise)
    command = limited(memory.limits, first, followed(memory.retraction, command))
    set_point = limited(memory.limits_fine, first, sum_up(memory.signs, inputs, _MORE, n))
    jitter = drawn(memory.jitter, n)
    given = (command, set_point, noise, jitter, met, angle, speed, height, cross_position, feed_velocity, allowance)
    made = (force, deflection, depth_of_cut, feed, wear)
    reached, reason = advance_loaded(memory.drive, memory.cut, first, given, motion, made)
    if reason != DONE:
        return reached, reason
    measure(memory.sensor, motion[4], fine_measured)
    measure(memory.force_sensor, force, measured_force)
    return reached, DONE


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Move the coarse drive through one block, under the cutting force."""
    n, room = inputs[0].size, memory.room
    motion = (outputs[0], outputs[1], outputs[2], outputs[3], room[5, :n], room[6, :n], room[7, :n])
    return _advance(memory, first, inputs, motion, room[8, :n], outputs[4:])


@kernel
def step_series(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Move both drives through one block, under the cutting force."""
    return _advance(memory, first, inputs, outputs[:7], outputs[7], outputs[8:])


class LoadedDriveStage(CutStage, CoupledDrive):
    """Electrodynamic drive under the cutting force (see `lathe_machine.plants.tool_drive`)."""

    kind = "loaded_drive"
    Parameters = LoadedDriveParameters
    parameters: LoadedParameters
    failure = staticmethod(failure)
    stops = STOPS
    rooms = 9
    step = staticmethod(step)

    def __init__(self, name: str, parameters: LoadedParameters) -> None:
        super().__init__(name, parameters, parameters.cut, _CUT)
        self._cut = parameters.cut
        coarse, fine, piezo = parameters.coarse, None, None
        coil = coarse.coil(name)
        if isinstance(parameters, LoadedSeriesParameters):
            fine = parameters.fine
            piezo = piezo_on_carriage(name, fine, parameters.mass_ratio, fine.preload or np.inf)
        self._equip(coarse, fine)
        with about(name, *(("coarse_loop", "coarse_bandwidth") if coil else ("mass_ratio",)), "sample_rate"):
            make = partial(
                made_of,
                ToolDrive,
                coarse,
                method=parameters.discretisation,
                radial=parameters.radial_ratio,
                coil=coil,
                piezo=piezo,
                kept=messages.MAX_BLOCK if coil else 1,
            )
            self._build(make, coarse)
        if coil:
            self._clippings = [Clipping(name, parameters, _COIL, self.drive.table.coil.limited)]
        inputs = [TURNS, _REFERENCE, Input("coarse/command", messages.COMMAND, ("position",))]
        inputs += self._set_point.inputs if self._set_point else []
        self._slides, place = dict.fromkeys(("cross", "longitudinal"), -1), sum(len(port.fields) for port in inputs)
        for slide in self._cut.moved_by:
            inputs.append(READ[slide])
            self._slides[slide], place = place, place + len(READ[slide].fields)
        outputs = [Output("coarse/state", messages.STATE, Joint("position", "velocity", "effort"))]
        if fine:
            outputs.append(Output("fine/state", messages.STATE))
        outputs.append(Output("cut", messages.CUT))
        self.declare(inputs=inputs, outputs=outputs, tells=bool(coil) or any(command.on for command in self._commands))

    @property
    def memory(self) -> Memory:
        """Current memory of the step of the loaded drive."""
        cut = self._cut
        return Memory(
            retraction=self._retraction.table,
            limits=self._commands[0].table,
            limits_fine=self._commands[1].table if self._set_point else _NO_LIMITS,
            signs=self._set_point.signs if self._set_point else np.empty(0),
            drive=self.drive.table,
            cut=self.cut.table,
            noise=self._sensors[0].table,
            sensor=self._sensors[1].table,
            jitter=self._sensors[2].table,
            allowance=self._allowance.table,
            force_sensor=self._force_sensor.table,
            **self._slides,
            even=cut.blank == "form",
            feed=cut.feed / (2.0 * np.pi),
            room=self.room,
        )


class LoadedSeriesDrive(LoadedDriveStage):
    """Electrodynamic drive with piezo and tool on its carriage, under the cutting force."""

    kind = "loaded_series_drive"
    Parameters = LoadedSeriesDriveParameters
    step = staticmethod(step_series)
