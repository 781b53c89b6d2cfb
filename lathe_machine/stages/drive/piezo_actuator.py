# SPDX-License-Identifier: Apache-2.0
"""Fine piezo drive of the tool; its set point combines learned command, reference and compensated displacements."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Ge, Le

from lathe_machine.control.limits import LimiterTable
from lathe_machine.plants.hysteresis import (
    THRESHOLDS,
    WEIGHTS,
    BoucWen,
    PrandtlIshlinskii,
)
from lathe_machine.plants.linear import Discretisation
from lathe_machine.plants.piezo import FineTable, PiezoDrive, Stack, advance_fine
from lathe_machine.stages.common.command_limits import LimitedCommand, LimitedParameters, limited
from lathe_machine.stages.common.tables import made_of
from lathe_machine.stages.drive.drive import Drive
from lathe_rc import messages
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.blocks.ports import Input, Joint, Output
from lathe_rc.cell.parameters import NodeParameters, NonNegative, Positive, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples
from lathe_rc.signals.noise import Sensor, SensorTable, measure


class SetPointParameters(NodeParameters):
    """Composition of the set point: command + reference - compensated displacements, each of which is optional."""

    use_command: bool = parameter(default=True, doc="the set point has the learned command in it")
    use_reference: bool = parameter(
        default=False, doc="the set point has the desired displacement at the measured angle in it"
    )
    compensates: list[str] = parameter(
        [],
        "displacements whose measurement is taken off the set point, by the first word of their state topic; direct "
        "compensation (paper 001, Fig. 4) is the reference with coarse, or vibration alone",
    )


class SetPoint:
    """Set point as the sum of the terms selected in a parameter table.

    Args:
        node: name of the node.
        table: parameters of the set point.
        inside: compensated displacements that the drive knows without a topic.
        prefix: prefix of the parameters in a composed table.

    Attributes:
        inputs: input ports.
        signs: sign of each input in the sum, shape (n,).

    Raises:
        InputError: no term is selected, or one is selected twice.
    """

    def __init__(self, node: str, table: SetPointParameters, inside: Sequence[str] = (), prefix: str = "") -> None:
        if len(set(table.compensates)) < len(table.compensates):
            raise InputError(f"{node}.{prefix}compensates = {table.compensates}; allowed: each displacement once")
        if not (table.use_command or table.use_reference or table.compensates):
            names = ", ".join(prefix + name for name in ("use_command", "use_reference", "compensates"))
            raise InputError(f"{node}.{names}: there is no set point; allowed: one of them or more")
        inputs = []
        if table.use_command:
            inputs.append(Input("fine/command", messages.COMMAND, ("position",)))
        if table.use_reference:
            inputs.append(Input("reference", messages.REFERENCE, ("expected",)))
        added = len(inputs)
        inputs += [
            Input(f"{name}/state", messages.STATE, ("measured_position",))
            for name in table.compensates
            if name not in inside
        ]
        self.inputs = inputs
        self.signs = np.array([1.0] * added + [-1.0] * (len(inputs) - added))


@kernel
def sum_up(signs: Samples, inputs: tuple[Samples, ...], begin: int, samples: int) -> Samples:
    """Return the set point [m], shape (n,), from the inputs of a `SetPoint`, starting at input ``begin``."""
    set_point = np.zeros(samples)
    for place in range(signs.size):
        part = inputs[begin + place]
        if signs[place] > 0.0:
            for k in range(samples):
                set_point[k] += part[k]
        else:
            for k in range(samples):
                set_point[k] -= part[k]
    return set_point


_Named = Callable[..., AbstractContextManager[None]]


class PiezoActuatorParameters(SetPointParameters, LimitedParameters):
    """Set point, resonance 1/(1 + 2ζp/ωn + p²/ωn²), amplifier, hysteresis and its linearisation, creep, sensor."""

    natural_frequency: Positive = parameter(14600.0, "natural frequency ωn", "rad/s")
    damping: Positive = parameter(0.299, "damping ratio ζ; 0.02 for a bare actuator", "1")
    amplifier_lag: Annotated[float, Ge(0), Le(0.1)] = parameter(
        0.0, "time constant of the amplifier; 0: none; 40e-6 for a bare actuator", "s"
    )
    slew_rate: NonNegative = parameter(
        0.0, "the amplifier changes its voltage no faster: its current over the capacity of the ceramics; 0: any", "V/s"
    )
    discretisation: Discretisation = parameter("foh", "foh: exact for a command linear between samples; or tustin")
    stroke: Positive = parameter(15e-6, "displacement at plus and minus full voltage", "m")
    full_voltage: Positive = parameter(100.0, "voltage from the middle at the full stroke", "V")
    hysteresis: Literal["none", "prandtl_ishlinskii", "bouc_wen"] = parameter(
        "prandtl_ishlinskii", "hysteresis of the ceramics, relative to the stroke"
    )
    play_thresholds: list[Positive] = parameter(
        [], "prandtl_ishlinskii: increasing thresholds of the plays; empty: ten, i/11"
    )
    play_weights: list[float] = parameter([], "prandtl_ishlinskii: their weights; empty: ten of 0.04767")
    play_proportional: Positive = parameter(0.7617, "prandtl_ishlinskii: weight p0 of no play")
    bouc_wen_a: Positive = parameter(0.33, "bouc_wen: A")
    bouc_wen_beta: float = parameter(0.7, "bouc_wen: β")
    bouc_wen_gamma: float = parameter(0.3, "bouc_wen: γ")
    linearisation: Literal["none", "inverse"] = parameter("inverse", "inverse: the hysteresis is undone beforehand")
    identified_scale: Positive = parameter(
        1.0, "error of its identification: factor on the weights of the plays, or on A; 0.85 is 15 % low"
    )
    identified_weights: list[float] = parameter(
        [], "weights of the plays that an identification found (docs/drives.md); empty: those of the drive"
    )
    identified_thresholds: list[Positive] = parameter(
        [], "thresholds that belong to identified_weights; empty: those of the drive"
    )
    identified_proportional: NonNegative = parameter(0.0, "p0 that belongs to identified_weights; 0: that of the drive")
    creep_per_decade: Annotated[float, Ge(0), Le(1)] = parameter(
        0.0, "creep in each decade of time relative to the displacement; 0: none"
    )
    creep_shortest: Positive = parameter(0.1, "shortest time constant of the creep", "s")
    creep_decades: Annotated[int, Ge(1), Le(12)] = parameter(3, "time constants of the creep, a decade apart")
    noise_rms: NonNegative = parameter(0.0, "white noise of the position sensor, RMS; 0: none", "m")
    resolution: NonNegative = parameter(0.0, "quantisation step of the position sensor; 0: none", "m")

    def _hysteresis(self, named: _Named) -> PrandtlIshlinskii | BoucWen | None:
        if self.hysteresis == "none":
            return None
        if self.hysteresis == "bouc_wen":
            with named("bouc_wen_a", "bouc_wen_beta", "bouc_wen_gamma"):
                return BoucWen(self.bouc_wen_a, self.bouc_wen_beta, self.bouc_wen_gamma)
        with named("play_thresholds", "play_weights", "play_proportional"):
            return _plays(tuple(self.play_thresholds), tuple(self.play_weights), self.play_proportional)

    def _identified(
        self, named: _Named, real: PrandtlIshlinskii | BoucWen | None
    ) -> PrandtlIshlinskii | BoucWen | None:
        """Return the hysteresis model used to linearise the ``real`` hysteresis."""
        if not self.identified_weights:
            with named("identified_weights"):
                if self.identified_thresholds or self.identified_proportional:
                    raise InputError("empty; allowed: one for each of identified_thresholds")
            return real
        with named("identified_thresholds", "identified_weights", "identified_proportional"):
            return _plays(
                tuple(self.identified_thresholds or self.play_thresholds),
                tuple(self.identified_weights),
                self.identified_proportional or self.play_proportional,
            )

    def drive_models(self) -> Mapping[str, Mapping[str, float | list[float]]]:
        """Quantities of the drive that controllers may know, without the lag of the amplifier."""
        known = {"natural_frequency": self.natural_frequency, "damping": self.damping, "delay": 0.0}
        return {"fine/command": known}

    def stack(self, node: str, prefix: str = "") -> Stack:
        """Return amplifier and ceramics of a node, at rest; ``prefix`` precedes the parameters in a composed table.

        Raises:
            InputError: the hysteresis has no inverse, or a lag is much shorter than the step.
        """

        def named(*names: str) -> AbstractContextManager[None]:
            return about(node, *(prefix + name for name in names))

        model, hysteresis = None, self._hysteresis(named)
        if self.linearisation == "inverse":
            model = self._identified(named, hysteresis)
        with named("identified_scale"):
            inverse = model.identified(self.identified_scale).inverse() if model else None
        with named("amplifier_lag", "creep_shortest"):
            return made_of(
                Stack,
                self,
                slew_rate=self.slew_rate / self.full_voltage or np.inf,
                hysteresis=hysteresis,
                inverse=inverse,
                creep_times=self.creep_shortest * 10.0 ** np.arange(self.creep_decades, dtype=np.float64),
                method=self.discretisation,
            )


@lru_cache(maxsize=64)
def _plays(thresholds: tuple[float, ...], weights: tuple[float, ...], proportional: float) -> PrandtlIshlinskii:
    """Return a copy of weighted plays at rest, since each `Stack` has a state of its own."""
    return PrandtlIshlinskii(
        np.array(thresholds) if thresholds else THRESHOLDS, np.array(weights) if weights else WEIGHTS, proportional
    )


class Memory(NamedTuple):
    """State of the piezo drive's step function."""

    signs: Samples
    limits: LimiterTable
    drive: FineTable
    sensor: SensorTable


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Move the piezo drive through one block, within its limits."""
    position, velocity, effort, measured_position = outputs
    set_point = sum_up(memory.signs, inputs, 0, position.size)
    advance_fine(memory.drive, limited(memory.limits, first, set_point), position, velocity, effort)
    measure(memory.sensor, position, measured_position)
    return position.size, DONE


class PiezoActuator(Drive):
    """Fine piezo drive (see `lathe_machine.plants.piezo`).

    Attributes:
        drive: simulated drive.
        set_point: set point of the drive.
    """

    kind = "piezo_actuator"
    Parameters = PiezoActuatorParameters
    parameters: PiezoActuatorParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: PiezoActuatorParameters) -> None:
        super().__init__(name, parameters)
        self.drive = made_of(PiezoDrive, parameters, stack=parameters.stack(name), method=parameters.discretisation)
        self.set_point = SetPoint(name, parameters)
        self._commands = [LimitedCommand(name, parameters)]
        self._sensors = [Sensor(parameters.noise_rms, parameters.resolution, parameters.seed, name)]
        self.declare(
            inputs=self.set_point.inputs,
            outputs=[Output("fine/state", messages.STATE, Joint("position", "velocity", "effort"))],
            tells=self._commands[0].on,
        )

    def responses(self) -> Mapping[str, Response]:
        """Response from the command to the position, by topic."""
        return {"fine/command": self.drive.linear.response}

    @property
    def memory(self) -> Memory:
        """Current state of the piezo drive's step function."""
        return Memory(self.set_point.signs, self._commands[0].table, self.drive.table, self._sensors[0].table)
