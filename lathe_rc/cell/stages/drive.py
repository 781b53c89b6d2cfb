# SPDX-License-Identifier: Apache-2.0
"""The common part of all drives of the tool, for the checks before a start."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

from lathe_rc.analysis.learning import Response
from lathe_rc.cell.stage import Stage


@dataclass(frozen=True)
class Limits:
    """The motion that a drive can follow."""

    stroke: float  #: [m] to each side
    velocity: float  #: [m/s]
    acceleration: float  #: [m/s²]


class Drive(Stage):
    """A stage that moves the tool."""

    @abstractmethod
    def responses(self) -> Mapping[str, Response]:
        """Response of the displacement to each command that a controller may learn, by topic before remapping."""

    def limits(self) -> Mapping[str, Limits]:
        """The limits of the drive, by state topic before remapping; for drives that carry the whole profile."""
        return {}
