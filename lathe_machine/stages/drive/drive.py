# SPDX-License-Identifier: Apache-2.0
"""Common part of all tool drives: command limits, sensors, and autonomous retraction."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lathe_machine.control.bounded import Bounds, Mode, Takeover, TakeoverTable, follows, take_over
from lathe_machine.stages.common.command_limits import Clipping, LimitedCommand
from lathe_machine.stages.common.tables import made_of
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.events import FREE, LIMITED
from lathe_rc.cell.parameters import NodeParameters, Positive, parameter
from lathe_rc.cell.stage import Stage
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples


class BoundedParameters(NodeParameters):
    """Bounds on a command during a takeover."""

    retract_velocity: Positive = parameter(0.1, "largest velocity of a takeover", "m/s")
    retract_acceleration: Positive = parameter(50.0, "its largest acceleration", "m/s^2")
    retract_jerk: Positive = parameter(1e5, "its largest jerk", "m/s^3")

    def bounds(self) -> Bounds:
        """Return the bounds on a takeover."""
        return made_of(Bounds, self, "retract_")


class RetractionParameters(BoundedParameters):
    """Parameters of a drive that retracts the tool from the part."""

    safe_position: float = parameter(
        0.3e-3, "where the drive goes by itself when members of the cell are lost: out of the part", "m"
    )


class OwnRetraction:
    """Command of a drive with autonomous retraction.

    Args:
        parameters: parameter table of the node.
        stroke: largest displacement of the drive in either direction [m]; commands beyond it are out of reach.
        gain: static gain from the command to the displacement; position and bounds are those of the displacement.
    """

    def __init__(self, parameters: RetractionParameters, stroke: float, gain: float = 1.0) -> None:
        reach = (stroke + abs(parameters.safe_position)) / abs(gain)
        bounds = Bounds(*(each / abs(gain) for each in vars(parameters.bounds()).values()))
        self._takeover = Takeover(bounds, parameters.safe_position / gain, parameters.step, reach=reach)

    @property
    def table(self) -> TakeoverTable:
        """Table for `followed`."""
        return self._takeover.table

    def begin(self) -> None:
        """Start the retraction at the next sample, overriding the command."""
        self._takeover.change(Mode.RETRACT)


@kernel
def followed(takeover: TakeoverTable, command: Samples) -> Samples:
    """Return the command that the drive follows [m], shape (n,)."""
    # A takeover would write into the command, which is another node's output.
    own = command if follows(takeover) else command.copy()
    take_over(takeover, own)
    return own


@dataclass(frozen=True)
class MotionLimits:
    """Limits on the motion that a drive can follow."""

    stroke: float  #: largest displacement in either direction [m]
    velocity: float  #: largest velocity [m/s]
    acceleration: float  #: largest acceleration [m/s²]


class Drive(Stage):
    """Stage that moves the tool; subclasses override the methods that apply."""

    announces = (LIMITED, FREE)
    _commands: Sequence[LimitedCommand] = ()
    _clippings: Sequence[Clipping] = ()  # clipping of further limited quantities
    _limits: MotionLimits | None = None  # only for a drive that follows the whole profile
    _retraction: OwnRetraction | None = None  # only for a drive that retracts the tool

    @abstractmethod
    def responses(self) -> Mapping[str, Response]:
        """Response of the displacement to each command that a controller may learn, by topic before remapping."""

    def states(self) -> Mapping[str, Sequence[Response]]:
        """Responses of the displacement to a command in further states, by topic: as measured, and along a drift."""
        return {}

    def limits(self) -> Mapping[str, MotionLimits]:
        """Limits of the drive by state topic before remapping, for a drive that follows the whole profile."""
        return {"coarse/state": self._limits} if self._limits else {}

    def go_safe(self) -> None:
        """Retract the carriage after a loss of cell members, overriding the command."""
        if self._retraction:
            self._retraction.begin()

    def tell(self, first: int, end: int) -> list[Sparse]:
        """Return the events of the last computed samples."""
        return [message for each in (*self._commands, *self._clippings) for message in each.tell(first, end)]

    def finish(self, index: int) -> list[Sparse]:
        """Return the remaining events at the end of the run."""
        return [message for each in (*self._commands, *self._clippings) for message in each.finish(index)]
