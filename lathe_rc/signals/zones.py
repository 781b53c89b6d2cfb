# SPDX-License-Identifier: Apache-2.0
"""Zones of a part with tolerances of their own, over the angle and the height, and the largest error in each."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
import numpy.typing as npt
from annotated_types import Ge, Gt, Le
from pydantic import ConfigDict

from lathe_rc.arrays import Array, Integers
from lathe_rc.signals.form_errors import RunningErrors

_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Zone:
    """Part of the surface with a tolerance of its own.

    Attributes:
        start, width: range of angles of the part [rad].
        tolerance: allowed form error to each side [m]; 0: the zone is not judged.
        bottom, top: range of heights [m]; both 0: every height.
    """

    __pydantic_config__: ClassVar = ConfigDict(allow_inf_nan=False, extra="forbid")

    start: float
    width: Annotated[float, Gt(0), Le(_TURN)]
    tolerance: Annotated[float, Ge(0)]
    bottom: float = 0.0
    top: float = 0.0

    @property
    def name(self) -> str:
        """Place of the zone."""
        first, last = (f"{np.degrees(angle) % 360.0:.4g}°" for angle in (self.start, self.start + self.width))
        heights = f", {self.bottom * 1e3:.4g} to {self.top * 1e3:.4g} mm" if self.top > self.bottom else ""
        return f"{first} to {last}{heights}"

    def covers(self, angle: Array, height: Array) -> npt.NDArray[np.bool_]:
        """Return at which angles [rad] and heights [m] the zone is, shape (n,)."""
        inside = np.mod(angle - self.start, _TURN) < self.width
        return inside & (height >= self.bottom) & (height <= self.top) if self.top > self.bottom else inside


def zone_at(zones: Sequence[Zone], angle: Array, height: Array) -> Integers:
    """Return the number of the zone at angles [rad] and heights [m], from 1, shape (n,); 0: none.

    Where zones overlap, it is the first one.
    """
    number = np.zeros(angle.size, np.int64)
    for k, zone in reversed(list(enumerate(zones, start=1))):
        number[zone.covers(angle, height)] = k
    return number


class ZoneErrors:
    """Largest form error of each revolution outside of all zones and in each zone, fed chunk by chunk.

    Args:
        zones: the zones; without any, there is nothing to add.
        first: number of revolutions before the first evaluated one.
    """

    def __init__(self, zones: Sequence[Zone], first: int = 0) -> None:
        self._zones = zones
        self._running = [RunningErrors(first) for _ in range(1 + len(zones))] if zones else []

    def add(self, angle: Array, height: Array, error: Array) -> None:
        """Process a chunk: true angle [rad], height [m] and form error [m], shape (n,)."""
        place = zone_at(self._zones, angle, height)
        for number, running in enumerate(self._running):
            running.add(angle, np.where(place == number, error, 0.0))

    def largest(self) -> list[Array]:
        """Return the largest magnitudes [m], shape (revolutions,) each; empty without zones."""
        return [running.largest() for running in self._running]
