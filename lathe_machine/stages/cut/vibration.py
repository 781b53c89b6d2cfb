# SPDX-License-Identifier: Apache-2.0
"""Vibration of the tool against the part, as a source of displacement."""

import zlib
from types import MappingProxyType
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Le

from lathe_machine.signals import vibration
from lathe_machine.stages.common.tables import made_of
from lathe_rc import messages
from lathe_rc.blocks.ports import CLOCK, Joint, Output
from lathe_rc.cell.parameters import NodeParameters, NonNegative, Positive, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached, Stage
from lathe_rc.errors import InputError, at_most
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples
from lathe_rc.signals.noise import Sensor, SensorTable, measure


class VibrationParameters(NodeParameters):
    """Random vibration within a band, harmonic lines, and the sensor that measures their sum."""

    causes = MappingProxyType(
        {"vibration": {"random_rms": 0.0, "line_amplitude": [], "line_frequency": [], "line_phase": []}}
    )

    random_rms: NonNegative = parameter(0.2e-6, "random vibration: RMS; 0: none", "m")
    random_low: Positive = parameter(200.0, "lower end of its band", "rad/s")
    random_high: Positive = parameter(2000.0, "upper end of its band", "rad/s")
    random_lines: Annotated[int, Ge(1), Le(1024)] = parameter(32, "spectral lines that it is made of")
    line_amplitude: list[float] = parameter([], "harmonic vibrations: amplitudes", "m")
    line_frequency: list[Positive] = parameter([], "their frequencies", "rad/s")
    line_phase: list[float] = parameter([], "their phases at sample 0; empty: all 0", "rad")
    noise_rms: NonNegative = parameter(0.0, "white noise of the sensor, RMS; 0: none", "m")
    resolution: NonNegative = parameter(0.0, "quantisation step of the sensor; 0: none", "m")


class Memory(NamedTuple):
    """State of the vibration source's step function."""

    lines: Samples
    period: float
    sensor: SensorTable


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Sum and measure the vibration lines of one block."""
    position, velocity, effort, measured_position = outputs
    vibration.evaluate(first, memory.period, memory.lines, position, velocity)
    effort[:] = 0.0
    measure(memory.sensor, position, measured_position)
    return position.size, DONE


class Vibration(Stage):
    """Source of vibration between tool and part (see `lathe_machine.signals.vibration`).

    Attributes:
        lines: amplitude [m], frequency [rad/s] and phase [rad] of each line, shape (3, n).
    """

    kind = "vibration"
    Parameters = VibrationParameters
    parameters: VibrationParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: VibrationParameters) -> None:
        super().__init__(name, parameters)
        # The name makes the random seeds of vibrations differ; the 1 makes each differ from that of its own sensor.
        random = np.random.default_rng(np.random.SeedSequence([parameters.seed, zlib.crc32(name.encode()), 1]))
        phase = parameters.line_phase or [0.0] * len(parameters.line_amplitude)
        with about(name, "line_amplitude", "line_frequency", "line_phase"):
            given = vibration.harmonic(
                np.array(parameters.line_amplitude), np.array(parameters.line_frequency), np.array(phase)
            )
        with about(name, "random_low", "random_high"):
            drawn = made_of(vibration.band_limited_random, parameters, "random_", random=random)
        self.lines = np.concatenate((given, drawn), axis=1)
        nyquist = np.pi / parameters.step
        for whose, lines in (("line_frequency", given), ("random_high", drawn)):
            if lines[1].max(initial=0.0) >= nyquist:
                raise InputError(
                    f"{name}.{whose}: vibration at {lines[1].max():g} rad/s; allowed: below {at_most(nyquist)} rad/s, "
                    "half the sample rate"
                )
        self._sensors = [Sensor(parameters.noise_rms, parameters.resolution, parameters.seed, name)]
        self.declare(
            inputs=[CLOCK],
            outputs=[Output("vibration/state", messages.STATE, Joint("position", "velocity"))],
        )

    @property
    def memory(self) -> Memory:
        """Current state of the vibration source's step function."""
        return Memory(self.lines, self.parameters.step, self._sensors[0].table)
