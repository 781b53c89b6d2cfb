# SPDX-License-Identifier: Apache-2.0
"""Measured frequency response of a drive as a response for the checks of the loop."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from lathe_rc.analysis.learning import Response
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

    found = frequency_response.of_states(measurement_file.read(path, {}, ".csv"))
    return [(each.frequency, each.value) for each in found]
