# SPDX-License-Identifier: Apache-2.0
"""Spindle and encoder: where time, angle and the run itself begin and end."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.cell.stage import Joint, Output, Sparse, Stage
from lathe_rc.signals import speed
from lathe_rc.signals.encoder import Encoder


class SpindleEncoderParameters(NodeParameters):
    """Speed law, encoder, and, for the time master of a cell, length and pace of the run."""

    deviation_amplitude: list[float] = parameter(
        [], "harmonic speed deviations: amplitudes relative to the nominal speed", "1"
    )
    deviation_frequency: list[Annotated[float, Gt(0)]] = parameter([], "their frequencies", "rad/s")
    deviation_phase: list[float] = parameter([], "their phases at their start; empty: all 0", "rad")
    deviation_start: Annotated[float, Ge(0)] = parameter(0.0, "when the harmonic deviations begin", "s")
    tachogram_time: list[Annotated[float, Ge(0)]] = parameter([], "breakpoints of a piecewise-linear tachogram", "s")
    tachogram_deviation: list[float] = parameter(
        [], "deviation there relative to the nominal speed, held before the first and after the last", "1"
    )
    random_rms: Annotated[float, Ge(0)] = parameter(0.0, "random deviation: RMS relative to the nominal speed", "1")
    random_low: Annotated[float, Gt(0)] = parameter(1.0, "lower end of its band", "rad/s")
    random_high: Annotated[float, Gt(0)] = parameter(60.0, "upper end of its band", "rad/s")
    random_lines: Annotated[int, Ge(1), Le(1024)] = parameter(16, "spectral lines that it is made of")
    counts_per_revolution: Annotated[int, Ge(0), Le(2**31 - 1)] = parameter(
        0, "encoder counts per revolution after quadrature; 0: an ideal encoder"
    )
    speed_window: Annotated[int, Ge(1), Le(65536)] = parameter(
        64,
        "the measured speed is the angle's difference over so many samples; not used by an ideal encoder",
        "sample",
    )
    revolutions: Annotated[float, Ge(0)] = parameter(0.0, "length of the run; 0: until stopped", "rev")
    speed_factor: Annotated[float, Ge(0)] = parameter(
        1.0, "pace of the run against real time; 0: as fast as the members follow", "1"
    )
    members: list[str] = parameter([], "nodes that must be ready before block 0; empty: start alone")

    def law(self) -> speed.SpeedLaw:
        """The sum of all deviations.

        Raises:
            InputError: lists of different lengths, or a tachogram out of order.
        """
        nominal = self.nominal_speed
        phase = self.deviation_phase or [0.0] * len(self.deviation_amplitude)
        return (
            speed.harmonic(
                nominal,
                np.array(self.deviation_amplitude),
                np.array(self.deviation_frequency),
                np.array(phase),
                self.deviation_start,
            )
            + speed.tachogram(nominal, np.array(self.tachogram_time), np.array(self.tachogram_deviation))
            + speed.band_limited_random(
                nominal, self.random_rms, self.random_low, self.random_high, self.random_lines, self.seed
            )
        )


class SpindleEncoder(Stage):
    """See `lathe_rc.signals.speed` and `lathe_rc.signals.encoder`.

    Attributes:
        parameters: its table.
        law: the speed law.
        samples: length of the run [sample]; None: endless.
    """

    kind = "spindle_encoder"
    Parameters = SpindleEncoderParameters

    def __init__(self, name: str, parameters: SpindleEncoderParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        self.law = parameters.law()
        self.samples = (
            self.law.samples_until(2 * np.pi * parameters.revolutions, parameters.step)
            if parameters.revolutions
            else None
        )
        self._encoder = Encoder(self.law, parameters.step, parameters.counts_per_revolution, parameters.speed_window)
        self.declare(outputs=[Output("encoder", messages.ENCODER, Joint("angle", "speed"))])

    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest spindle speed in the run [rad/s]."""
        return self.law.speed_range(np.inf if self.samples is None else self.samples * self.shared.step)

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """See `Stage`."""
        self._encoder.block(first, **outputs[0])
        return []
