# SPDX-License-Identifier: Apache-2.0
"""Columns of a measurement by name, and their sampling, in a file of any format or in a bag."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError


class Clock(NamedTuple):
    """Sampling of a column of a file that states it: time of the first value and step [s]."""

    start: float
    step: float


class MeasurementSource(ABC):
    """Opened measurement: columns by name.

    Attributes:
        units: unit by column, in the order of the file; empty if the file states none.
        has_header: whether a user can rename the columns.
    """

    units: Mapping[str, str]
    has_header = True

    @abstractmethod
    def read(self, names: Sequence[str], gaps: Collection[str] = ()) -> Mapping[str, npt.NDArray[Any]]:
        """Return columns by name, shape (n,) each; ``gaps``: those in which a missing value is NaN."""

    def since_first(self, name: str) -> Array:
        """Return a column less its first value, shape (n,)."""
        values = self.read([name])[name]
        return np.asarray(values - values[:1], np.float64)

    def clock(self, name: str) -> Clock | None:
        """Return the sampling of a column; None if the file does not state it."""
        return None

    def start(self, name: str) -> float | None:
        """Return the time of the first value of a column [s]; None if the file does not state it."""
        clock = self.clock(name)
        return clock.start if clock else None


def even_clock(time: Array, what: str, cure: str = "resample the record") -> Clock:
    """Return start and step of evenly spaced times.

    Args:
        time: times [s], shape (n,), n at least 2.
        what: description of the times for error messages.
        cure: remedy for times that are not even.

    Raises:
        InputError: the times are not even.
    """
    if time.size < 2:
        raise InputError(f"{what}: {time.size} samples; allowed: 2 or more")
    step = float(time[-1] - time[0]) / (time.size - 1)
    off = np.abs(time - (time[0] + step * np.arange(time.size)))
    if step <= 0.0 or off.max() > 0.1 * step:
        at = int(off.argmax())
        raise InputError(
            f"{what}: not in even steps, {time[at]:.9g} s at sample {at} is {off[at]:.3g} s off; allowed: even steps "
            f"({cure})"
        )
    return Clock(float(time[0]), step)
