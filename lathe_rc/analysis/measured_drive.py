# SPDX-License-Identifier: Apache-2.0
"""States of a drive as responses for the checks of the loop: as measured, and after a drift."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np

from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.analysis.resonance_grid import poles_of
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError


@dataclass(frozen=True, eq=False)
class MeasuredDrive:
    """Drive whose response is measured at some frequencies.

    Attributes:
        frequency: measured frequencies, increasing [rad/s], shape (n,).
        value: response of the position to the command, shape (n,).
        model: response of the drive outside of the measured range.
    """

    frequency: Array
    value: Complex
    model: Response
    state: ClassVar = "as measured"

    @property
    def poles(self) -> Complex:
        """Poles of the model [rad/s]."""
        return poles_of(self.model)

    def __call__(self, frequency: Array) -> Complex:
        """Return the response at frequencies [rad/s], shape (n,): linear between the measured points."""
        within = (frequency >= self.frequency[0]) & (frequency <= self.frequency[-1])
        measured = np.interp(frequency, self.frequency, self.value)
        return np.asarray(measured if within.all() else np.where(within, measured, self.model(frequency)))

    def waves(self, highest: float, speed: float) -> Array:
        """Return the measured points up to ``highest`` waves per revolution, at a ``speed`` [rad/s], in waves.

        Raises:
            InputError: there is none.
        """
        waves = self.frequency / speed
        if waves[0] > highest:
            low, most = self.frequency[0] / (2.0 * np.pi), highest * speed / (2.0 * np.pi)
            raise InputError(
                f"measured response of the drive from {low:.4g} Hz on; allowed: points up to {most:.4g} Hz"
            )
        return np.asarray(waves[waves <= highest])


@dataclass(frozen=True, eq=False)
class DriftedDrive:
    """Drive after some time of its drift.

    Attributes:
        response: response of the position to the command with the modes of that time and the gain of the start.
        gain: gain over that of the start.
        time: [s].
    """

    response: Response
    gain: float
    time: float

    @property
    def state(self) -> str:
        """Name of the state."""
        return f"after {self.time:g} s of its drift"

    @property
    def poles(self) -> Complex:
        """Poles of the drive [rad/s]."""
        return poles_of(self.response)

    def __call__(self, frequency: Array) -> Complex:
        """Return the response at frequencies [rad/s], shape (n,)."""
        return np.asarray(self.gain * self.response(frequency))


def read_points(path: Path) -> list[tuple[Array, Complex]]:
    """Read frequencies [rad/s] and values of frequency responses, CSV as of ``lathe fit drive``, whatever its name.

    Returns:
        The pair of each state in which the drive was measured, by the column ``state``; one pair without it.

    Raises:
        InputError: the file cannot be read, or is no frequency response.
    """
    status = path.stat() if path.exists() else None
    return _read(path, status and (status.st_mtime_ns, status.st_size))


@lru_cache(maxsize=16)
def _read(path: Path, _: tuple[int, int] | None) -> list[tuple[Array, Complex]]:
    from lathe_rc.analysis import frequency_response  # with SciPy, which a cell without measurements need not import
    from lathe_rc.signals import measurement_file

    found = frequency_response.of_states(measurement_file.read(path))
    return [(each.frequency, each.value) for each in found]
