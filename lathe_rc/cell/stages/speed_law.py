# SPDX-License-Identifier: Apache-2.0
"""The spindle's speed law as parameters: of the spindle that follows it, and of whoever knows it in advance."""

from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le

from lathe_rc import resources
from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.errors import InputError
from lathe_rc.signals import speed, tachogram


class SpeedLawParameters(NodeParameters):
    """Deviations from the nominal speed; their sum is the law."""

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
    tachogram_file: str = parameter(
        "", "CSV file with time_s,rpm instead of both: the speed itself, the other deviations add to it", path=True
    )
    random_rms: Annotated[float, Ge(0)] = parameter(0.0, "random deviation: RMS relative to the nominal speed", "1")
    random_low: Annotated[float, Gt(0)] = parameter(1.0, "lower end of its band", "rad/s")
    random_high: Annotated[float, Gt(0)] = parameter(60.0, "upper end of its band", "rad/s")
    random_lines: Annotated[int, Ge(1), Le(1024)] = parameter(16, "spectral lines that it is made of")

    def speed_law(self) -> speed.SpeedLaw:
        """The sum of all deviations.

        Raises:
            InputError: lists of different lengths, a tachogram out of order, twice, or in a file that cannot be used.
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
            + self._tachogram()
            + speed.band_limited_random(
                nominal, self.random_rms, self.random_low, self.random_high, self.random_lines, self.seed
            )
        )

    def _tachogram(self) -> speed.SpeedLaw:
        if not self.tachogram_file:
            return speed.tachogram(
                self.nominal_speed, np.array(self.tachogram_time), np.array(self.tachogram_deviation)
            )
        if self.tachogram_time or self.tachogram_deviation:
            raise InputError(
                f"tachogram_file = {self.tachogram_file} beside tachogram_time and tachogram_deviation; allowed: the "
                "file or both lists"
            )
        time, rpm = tachogram.read(resources.find(Path(self.tachogram_file)))
        return speed.tachogram(self.nominal_speed, time, rpm / self.nominal_rpm - 1.0)
