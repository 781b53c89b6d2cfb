# SPDX-License-Identifier: Apache-2.0
"""Limits on a drive's command, and events about clipped samples."""

import numpy as np
import numpy.typing as npt

from lathe_machine.control.limits import CommandLimits, LimiterTable, limit, limiter
from lathe_rc import messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.events import FREE, LIMITED
from lathe_rc.cell.parameters import NodeParameters, NonNegative, parameter
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples

_TELL = 0.1  # interval of reports about a command that remains clipped [s]
_QUIET = 10e-3  # time without a clipped sample until a command counts as free again [s]


class LimitedParameters(NodeParameters):
    """Limits on the command sent to the drive."""

    command_stroke: NonNegative = parameter(0.0, "the command is kept within this to each side; 0: none", "m")
    command_velocity: NonNegative = parameter(0.0, "and within this velocity; 0: none", "m/s")
    command_acceleration: NonNegative = parameter(0.0, "and within this acceleration; 0: none", "m/s^2")
    command_jerk: NonNegative = parameter(0.0, "and within this jerk; 0: none", "m/s^3")

    def command_limits(self) -> CommandLimits:
        """Active limits on the command."""
        given = (self.command_stroke, self.command_velocity, self.command_acceleration, self.command_jerk)
        return CommandLimits(*(limit or np.inf for limit in given))


class Clipping:
    """Monitor that reports, as events, when the clipping of a command starts and ends.

    Args:
        node: name of the commanding node.
        parameters: parameter table of the node.
        which: name of the command; empty if the node has only one.
        flags: ring buffer of whether sample n was clipped, at index n modulo the length, a power of two; a length of
            1 means that there is no limit.
    """

    def __init__(self, node: str, parameters: NodeParameters, which: str, flags: npt.NDArray[np.uint8]) -> None:
        self._topic, self._flags = f"{node}/events", flags
        self._which = f" {which}" if which else ""
        self._begins = f"{LIMITED}:{self._which}" if which else LIMITED
        self._quiet = round(_QUIET * parameters.sample_rate)
        self._tell = max(round(_TELL * parameters.sample_rate), 1)
        # Number of clipped samples, last free sample, and samples until the command counts as free again.
        self._clipped, self._before, self._left = 0, 0, 0

    def tell(self, first: int, end: int) -> list[Sparse]:
        """Return the events for samples ``first`` to ``end`` (exclusive), which were computed last."""
        found: list[Sparse] = []
        if self._flags.size == 1:
            return found
        # In a ring buffer, consecutive samples may be at the end and the start.
        begin, start = first & (self._flags.size - 1), 0
        clipped = self._flags[begin : begin + end - first]
        if clipped.size < end - first:
            clipped = np.concatenate((clipped, self._flags[: end - first - clipped.size]))
        if not self._left and self._clipped == self._before and not clipped.any():
            return found
        # Split at multiples of `_TELL`, so that the samples of the reports do not depend on the blocks.
        while start < clipped.size:
            stop = min(start + self._tell - (first + start) % self._tell, clipped.size)
            found += self._ends(first + start, clipped[start:stop])
            if (first + stop) % self._tell == 0:
                found += self.finish(first + stop - 1)
            start = stop
        return found

    def finish(self, index: int) -> list[Sparse]:
        """Return the unpublished events of the samples up to ``index``."""
        if self._clipped == self._before:
            return []
        action = f"{LIMITED}:{self._which} {self._clipped - self._before} samples were clipped"
        self._before = self._clipped
        return [Sparse(self._topic, messages.EVENT, index, {"action": action})]

    def _ends(self, first: int, clipped: Samples) -> list[Sparse]:
        """Return the samples at which clipping starts and ends."""
        found: list[Sparse] = []
        count, place, samples = self._clipped, 0, clipped.size
        self._clipped += int(clipped.sum())
        if not self._left and self._clipped == count:
            return found
        while place < samples:
            ahead = np.flatnonzero(clipped[place : place + self._left] if self._left else clipped[place:])
            if self._left and ahead.size:
                # Still clipped: the quiet time restarts after the last clipped sample.
                after = int(ahead[-1]) + 1
                count += int(clipped[place : place + after].sum())
                place, self._left = place + after, self._quiet
            elif self._left > samples - place:
                self._left -= samples - place
                place = samples
            elif self._left:
                place, self._left = place + self._left, 0
                action = f"{FREE}:{self._which} {count - self._before} samples were clipped"
                found.append(Sparse(self._topic, messages.EVENT, first + place - 1, {"action": action}))
                self._before = count
            elif ahead.size:
                place += int(ahead[0])
                found.append(Sparse(self._topic, messages.EVENT, first + place, {"action": self._begins}))
                place, count, self._left = place + 1, count + 1, self._quiet
            else:
                place = samples
        return found


class LimitedCommand(Clipping):
    """Limiter that keeps a command within its limits, and reports the samples at which clipping starts and ends.

    Args:
        node: name of the commanding node.
        parameters: parameter table of the node.
        which: name of the command; empty if the node has only one.

    Attributes:
        on: whether there is a limit.
        table: table for `limited`.
    """

    def __init__(self, node: str, parameters: LimitedParameters, which: str = "") -> None:
        limits = parameters.command_limits()
        self.on = limits.any
        self.table = limiter(limits, parameters.step, messages.MAX_BLOCK if self.on else 1)
        super().__init__(node, parameters, which, self.table.clipped)


@kernel
def limited(limits: LimiterTable, first: int, command: Samples) -> Samples:
    """Return the drive's input [m], shape (n,), for samples starting at ``first`` (see `LimitedCommand`)."""
    if limits.clipped.size == 1:
        return command
    given = np.empty_like(command)
    limit(limits, first, command, given)
    return given
