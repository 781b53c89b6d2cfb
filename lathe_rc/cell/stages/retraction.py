# SPDX-License-Identifier: Apache-2.0
"""How a drive of the tool retracts by itself, without a command, when members of the cell are lost."""

from typing import Annotated

from annotated_types import Gt

from lathe_rc.cell.parameters import NodeParameters, parameter
from lathe_rc.control.bounded import Bounds, Mode, Takeover, TakeoverTable, follows, take_over
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples


class BoundedParameters(NodeParameters):
    """Bounds of a command that is taken over."""

    retract_velocity: Annotated[float, Gt(0)] = parameter(0.1, "largest velocity of a takeover", "m/s")
    retract_acceleration: Annotated[float, Gt(0)] = parameter(50.0, "its largest acceleration", "m/s^2")
    retract_jerk: Annotated[float, Gt(0)] = parameter(1e5, "its largest jerk", "m/s^3")

    def bounds(self) -> Bounds:
        """The same for a motion."""
        return Bounds(self.retract_velocity, self.retract_acceleration, self.retract_jerk)


class RetractionParameters(BoundedParameters):
    """Of a drive that takes the tool out of the part."""

    safe_position: float = parameter(
        0.3e-3, "where the drive goes by itself when members of the cell are lost: out of the part", "m"
    )


class OwnRetraction:
    """The command of a drive, until the drive goes its own way.

    Args:
        parameters: its table.
        stroke: of the drive, to each side [m]: a command beyond is where the drive cannot be.
    """

    def __init__(self, parameters: RetractionParameters, stroke: float) -> None:
        reach = stroke + abs(parameters.safe_position)
        self._takeover = Takeover(parameters.bounds(), parameters.safe_position, parameters.step, reach=reach)

    @property
    def table(self) -> TakeoverTable:
        """For `followed`."""
        return self._takeover.table

    def begin(self) -> None:
        """Retract from the next sample on, whatever is commanded."""
        self._takeover.change(Mode.RETRACT)


@kernel
def followed(takeover: TakeoverTable, command: Samples) -> Samples:
    """The command that the drive follows [m], shape (n,)."""
    own = command if follows(takeover) else command.copy()
    take_over(takeover, own)
    return own
