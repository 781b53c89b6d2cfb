# SPDX-License-Identifier: Apache-2.0
"""Parameters of the spindle's speed law, for the spindle and for control laws that know the speed in advance."""

from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Ge, Le

from lathe_machine.signals.deviation_law import DeviationLaw, tabulated
from lathe_machine.stages.common.tables import made_of
from lathe_rc import resources
from lathe_rc.cell.parameters import NodeParameters, NonNegative, Positive, Values, about, parameter
from lathe_rc.errors import InputError
from lathe_rc.extensions import Named, Registry, code_of_others
from lathe_rc.messages import Samples
from lathe_rc.signals import speed

#: third-party speed laws, by name; the parameters below define the built-in law
SPEED_LAWS: Registry[DeviationLaw] = Registry("speed law", DeviationLaw, {}, "lathe_rc.speed_laws")


class SpeedLawParameters(NodeParameters):
    """Deviations from the nominal speed; their sum is the speed law."""

    deviation_amplitude: list[float] = parameter(
        [], "harmonic speed deviations: amplitudes relative to the nominal speed", "1"
    )
    deviation_frequency: list[Positive] = parameter([], "their frequencies", "rad/s")
    deviation_phase: list[float] = parameter([], "their phases at their start; empty: all 0", "rad")
    deviation_start: NonNegative = parameter(0.0, "when the harmonic deviations begin", "s")
    tachogram_time: list[NonNegative] = parameter([], "breakpoints of a piecewise-linear tachogram", "s")
    tachogram_deviation: list[float] = parameter(
        [], "deviation there relative to the nominal speed, held before the first and after the last", "1"
    )
    tachogram_file: str = parameter(
        "",
        "CSV file with time_s,rpm instead of both, from its first row on: the speed itself, other deviations add to it",
        path=True,
    )
    random_rms: NonNegative = parameter(0.0, "random deviation: RMS relative to the nominal speed", "1")
    random_low: Positive = parameter(1.0, "lower end of its band", "rad/s")
    random_high: Positive = parameter(60.0, "upper end of its band", "rad/s")
    random_lines: Annotated[int, Ge(1), Le(1024)] = parameter(16, "spectral lines that it is made of")
    deviation_law: Annotated[str, Named(SPEED_LAWS, ("",))] = parameter(
        "", "a law of others in place of the tachogram, which is made of it; empty: none"
    )
    deviation_values: list[float] = parameter([], "numbers that it is made of, in the order of its constructor")
    deviation_law_step: Positive = parameter(1e-3, "step of its tachogram", "s")
    deviation_law_end: Positive = parameter(
        60.0, "end of its tachogram, not before the end of the run; an endless one goes on with the last deviation", "s"
    )

    @classmethod
    def steady(cls) -> Values:
        """Return the values of a constant speed."""
        own = [name for name in SpeedLawParameters.model_fields if name not in NodeParameters.model_fields]
        return {name: cls.rows()[name].default for name in own}

    @property
    def varies(self) -> bool:
        """Whether the speed is not constant."""
        return any(getattr(self, name) != value for name, value in self.steady().items())

    def causes_off(self, node: str, nodes: Mapping[str, NodeParameters], height: Samples) -> dict[str, Values]:
        """Return the cause ``speed``: it varies (extends `NodeParameters`)."""
        return {"speed": self.steady()} if self.varies else {}

    def speed_law(self, node: str) -> speed.SpeedLaw:
        """Return the speed law of a node, the sum of all deviations.

        Raises:
            InputError: lists differ in length, a tachogram or a band is out of order, a file or third-party law
                cannot be used, or there is more than one tachogram.
        """
        nominal = self.nominal_speed
        lines = self.deviation_amplitude, self.deviation_frequency, self.deviation_phase
        with about(node, "deviation_amplitude", "deviation_frequency", "deviation_phase"):
            harmonic = _harmonic(nominal, *map(tuple, lines), self.deviation_start)
        tachogram = self._tachogram(node)
        law = harmonic + tachogram if tachogram else harmonic
        if not self.random_rms:
            return law
        with about(node, "random_low", "random_high"):
            return law + made_of(speed.band_limited_random, self, "random_", nominal=nominal)

    def _tachogram(self, node: str) -> speed.SpeedLaw | None:
        """Return the tachogram from the lists, the file or a third-party law; None if there is none."""
        lists = bool(self.tachogram_time or self.tachogram_deviation)
        given = {"deviation_law": self.deviation_law, "tachogram_file": self.tachogram_file, "tachogram_time": lists}
        named = [name for name, value in given.items() if value]
        if len(named) > 1:
            raise InputError(
                f"{node}.{named[0]} = {given[named[0]]} beside {named[1]}; allowed: one of them, since each gives the "
                "tachogram"
            )
        if not named:
            return None
        if self.deviation_law:
            with about(node, "deviation_law"), code_of_others(repr(self.deviation_law)):
                make: Callable[..., DeviationLaw] = SPEED_LAWS[self.deviation_law]
                return tabulated(
                    self.nominal_speed, make(*self.deviation_values), self.deviation_law_step, self.deviation_law_end
                )
        time, deviation = np.array(self.tachogram_time), np.array(self.tachogram_deviation)
        if self.tachogram_file:
            from lathe_rc.signals import tachogram

            with about(node, "tachogram_file"):
                time, rpm = tachogram.read(path := resources.find(Path(self.tachogram_file)))
                tachogram.check_unit(path, rpm, self.nominal_rpm)
                deviation = rpm / self.nominal_rpm - 1.0
        with about(node, "tachogram_time", "tachogram_deviation"):
            return speed.tachogram(self.nominal_speed, time, deviation)


@lru_cache(maxsize=64)
def _harmonic(
    nominal: float, amplitude: tuple[float, ...], frequency: tuple[float, ...], phase: tuple[float, ...], start: float
) -> speed.SpeedLaw:
    """Return the harmonic deviations, created only once for all nodes that use them."""
    phases = np.array(phase) if phase else np.zeros(len(amplitude))
    return speed.harmonic(nominal, np.array(amplitude), np.array(frequency), phases, start)
