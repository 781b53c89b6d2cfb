# SPDX-License-Identifier: Apache-2.0
"""Parts that lathe_rc does not have: docs/extending.md runs them, tests/bag/test_parts.py in every host."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, exp

import numpy as np
import scipy
from matplotlib.figure import Figure
from rich.table import Table

from lathe_machine.control.q_filter import Weights
from lathe_machine.safety.monitors import Alarm, PlainMonitor
from lathe_machine.signals.deviation_law import DeviationLaw
from lathe_machine.signals.part_profile import PartProfile
from lathe_rc import parameter
from lathe_rc.arrays import Array
from lathe_rc.study import Study, StudyParameters, Track, comparison, untracked


class Hann(Weights):
    """Q with the kernel 1 + cos(πj/L): nothing beyond L grid points, and no ringing."""

    def __init__(self, width: float, cycle: int) -> None:
        # For long waves Q = 1 - (σν)²/2, σ² = L²·(1/3 - 2/π²) the variance of the kernel: (width·ν)² as for ours.
        length = max(width * np.sqrt(2.0 / (1.0 / 3.0 - 2.0 / np.pi**2)), 1.0)
        super().__init__(1.0 + np.cos(np.pi * np.arange(ceil(length)) / length), cycle)


class Chirp(DeviationLaw):
    """A swing of the speed whose frequency goes from ``slow`` to ``fast`` [rad/s] within ``seconds``, and on."""

    def __init__(self, amplitude: float, slow: float, fast: float, seconds: float) -> None:
        self._amplitude, self._slow, self._rise = amplitude, slow, (fast - slow) / seconds

    def deviation(self, time: Array) -> Array:
        """A·sin(ωs·t + (ωf - ωs)/T·t²/2)."""
        return self._amplitude * np.sin((self._slow + 0.5 * self._rise * time) * time)


class Lobes(PartProfile):
    """A form with some lobes, whose amplitude [m] grows from none to the whole within ``length`` [m] along the part."""

    def __init__(self, lobes: float, amplitude: float, length: float) -> None:
        self._lobes, self._amplitude, self._length = lobes, amplitude, length

    @property
    def heights(self) -> Array:
        """Both ends: what grows linearly is right between them."""
        return np.array([0.0, self._length])

    def deviation(self, angle: Array, height: float) -> Array:
        """A·(h/l)·cos(nφ)."""
        return self._amplitude * height / self._length * np.cos(self._lobes * angle)


class Drift(PlainMonitor):
    """The mean of a signal, or of its difference from another one, away from 0 by more than the limit.

    The mean forgets with a time constant of 50 ms; what it knows goes from piece to piece.
    """

    def __init__(self, limit: float, step: float) -> None:
        super().__init__(limit, step)
        self._kept, self._state = exp(-step / 0.05), np.zeros(1)

    def find(self, first: int, signal: Array, other: Array) -> Alarm | None:
        """The first sample at which the mean is beyond the limit."""
        seen = signal - other if other.size else signal
        mean, self._state = scipy.signal.lfilter([1.0 - self._kept], [1.0, -self._kept], seen, zi=self._state)
        beyond = np.flatnonzero(np.abs(mean) > self.limit)
        return Alarm(beyond[0], mean[beyond[0]]) if beyond.size else None


class PassedParameters(StudyParameters):
    """Which filters are looked at."""

    widths: list[float] = parameter([1.0, 2.0, 4.0], "widths of Q", "1")
    points: int = parameter(1024, "grid points per revolution")


@dataclass(frozen=True)
class Passed:
    """Waves per revolution that Q passes by a half, by its width in grid points."""

    widths: Sequence[float]
    waves: Sequence[float]

    def to_json(self) -> dict[str, object]:
        """Both."""
        return {"widths": list(self.widths), "waves": list(self.waves)}

    def table(self) -> Table:
        """Both."""
        rows = [(f"{width:g}", f"{waves:.1f}") for width, waves in zip(self.widths, self.waves, strict=True)]
        return comparison("Waves per revolution of which Q leaves a half", ("width [grid points]", "waves"), rows)

    def draw(self, figure: Figure) -> None:
        """One over the other."""
        axes = figure.add_subplot(xlabel="width [grid points]", ylabel="waves per revolution", xscale="log")
        axes.plot(self.widths, self.waves, "o-")


def passed(parameters: PassedParameters, track: Track = untracked) -> Passed:
    """The place at which the response falls to a half."""
    waves = np.linspace(0.0, parameters.points / 2.0, 4096)
    radians = 2.0 * np.pi * waves / parameters.points
    halves = []
    for width in track(parameters.widths):
        response = Hann(width, parameters.points).response(radians)
        halves.append(float(waves[np.argmax(response < 0.5)]))
    return Passed(parameters.widths, halves)


STUDY = Study("passed", "Which waves the Hann filter of figures/parts.py passes", PassedParameters, passed)
