# SPDX-License-Identifier: Apache-2.0
"""Reactions of a controller or a feed drive to the supervisor."""

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from lathe_machine.control.bounded import Bounds, Mode, Takeover, TakeoverTable, take_over
from lathe_rc import messages
from lathe_rc.arrays import Array, Integers
from lathe_rc.blocks.ports import Input, Sparse
from lathe_rc.cell.events import OUT_OF_REACH
from lathe_rc.cell.parameters import ObedientParameters, Positive, parameter
from lathe_rc.cell.stage import Stage
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples, Signals
from lathe_rc.safety.state_machine import Reaction

OBEY = 100  #: stop reason of a step function: a reaction must be obeyed


def listens(parameters: ObedientParameters) -> list[Input]:
    """Return the input with the supervisor's reactions, or no input if the node does not obey the supervisor."""
    delay = parameters.reaction_delay
    return [Input("safety", messages.SAFETY, ("reaction",), delay)] if delay else []


class FeedObedientParameters(ObedientParameters):
    """Parameters of a feed node that obeys the supervisor."""

    stop_rate: Positive = parameter(
        10.0, "largest rate of the command while it is brought to rest, and of what is left of that when given back",
        "1/s",
    )  # fmt: skip
    stop_rate_change: Positive = parameter(1000.0, "largest change of that rate", "1/s^2")
    stop_time: Positive = parameter(
        1.0, "longest duration: a command that is farther away begins where the way takes so long", "s"
    )

    def obedience(self, name: str, *, speed: bool, limit: float, settled: int) -> "Obedience":
        """Return the obedience for a feed command.

        The slide stops: a speed command goes to 0, and a position command is held. The slide does not retract the tool
        from the part.

        Args:
            name: name of the node.
            speed: whether the command represents a speed.
            limit: largest magnitude of the command, in its unit; 0 for no limit.
            settled: see `Obedience`.

        Raises:
            InputError: a command within the limit is out of reach.
        """
        bounds = Bounds(self.stop_rate, self.stop_rate_change, math.inf)
        reach, needed = bounds.reach(self.stop_time), 2.0 * limit
        if reach < needed:
            raise InputError(
                f"{name}.stop_time = {self.stop_time:g} s: stop_rate and stop_rate_change allow a way of {reach:.3g} "
                f"in that, and from one end of command_limit to the other it is {needed:.3g}; allowed: a longer "
                "stop_time, or larger rates"
            )
        rest = Mode.RETRACT if speed else Mode.HOLD
        takeover = Takeover(bounds, 0.0, self.step, reach=reach, carries=False)
        return Obedience(name, takeover, settled=settled, hold=rest, retract=rest)


_REACTION, _WANTS = 0, 1  # indices into the state: reaction in force, whether learning is requested


class ObedienceTable(NamedTuple):
    """Table of an `Obedience` for kernels.

    Attributes:
        whole: reaction in force, and whether learning is requested.
        forbidden: number of samples until learning is permitted, shape (1,).
        takeover: takeover of the command.
    """

    whole: Integers
    forbidden: Array
    takeover: TakeoverTable


class Listener(NamedTuple):
    """Optional obedience of a node, for kernels.

    Attributes:
        obedience: obedience to the supervisor, valid if ``listens``.
        listens: whether the node obeys the supervisor.
    """

    obedience: ObedienceTable
    listens: bool


@kernel
def piece(who: Listener, start: int, end: int, reaction: Samples) -> int:
    """Return the end of the segment with constant reaction that starts at sample ``start``; at most ``end``.

    The result is ``start`` itself if a new reaction must be obeyed first (`OBEY`).
    """
    if not who.listens:
        return end
    obeyed, stop = who.obedience.whole[_REACTION], start
    while stop < end and reaction[stop] == obeyed:
        stop += 1
    forbidden = who.obedience.forbidden[0]
    if 0.0 < forbidden < stop - start:
        stop = start + int(forbidden)
    return stop


@kernel
def forbidden(who: Listener) -> bool:
    """Return whether a reaction, or the return from it, forbids a listening node to learn in the next segment."""
    return bool(who.obedience.forbidden[0] > 0.0)


@kernel
def may_learn(who: Listener) -> bool:
    """Return whether a listening node may learn in the next segment."""
    return bool(who.obedience.whole[_WANTS]) and not forbidden(who)


@kernel
def obeyed(who: Listener) -> int:
    """Return the reaction in force."""
    return int(who.obedience.whole[_REACTION])


@kernel
def apply(who: Listener, command: Samples) -> None:
    """Convert the controller's command of a segment into the drive's command in place, in the unit of the command."""
    if who.listens:
        take_over(who.obedience.takeover, command)
        who.obedience.forbidden[0] = max(who.obedience.forbidden[0] - command.size, 0.0)


NOBODY = ObedienceTable(
    np.zeros(2, np.int64), np.zeros(1), TakeoverTable(np.zeros(0), np.zeros(2, np.int64), np.zeros(2), np.zeros(2))
)  #: obedience table of a node without a supervisor


class Obedience:
    """Obedience of a node: stops learning, holds or retracts the command, and restores it after the reaction.

    Args:
        name: name of the node.
        takeover: takeover of the command.
        settled: number of samples after the return of control until errors may be learned.
        hold: takeover mode for the reaction hold.
        retract: takeover mode for the reactions retract and stop.
    """

    def __init__(
        self,
        name: str,
        takeover: Takeover,
        *,
        settled: int,
        hold: Mode = Mode.HOLD,
        retract: Mode = Mode.RETRACT,
    ) -> None:
        self._name, self._takeover, self._settled = name, takeover, settled
        self._hold, self._retract = hold, retract
        self._whole, self._forbidden = np.array([Reaction.NONE, 1], np.int64), np.zeros(1)

    @property
    def table(self) -> ObedienceTable:
        """Table for `piece` and `apply`."""
        return ObedienceTable(self._whole, self._forbidden, self._takeover.table)

    @property
    def wanted(self) -> tuple[Integers, int]:
        """Array and index of the number that tells whether learning is requested."""
        return self._whole, _WANTS

    def learn(self, *, wanted: bool) -> None:
        """Start or stop learning as soon as no reaction forbids it."""
        self._whole[_WANTS] = wanted

    def obey(self, reaction: Reaction, index: int) -> list[Sparse]:
        """Obey a reaction from the next sample, ``index``, on; return the resulting messages."""
        self._whole[_REACTION] = reaction
        following = self._hold if reaction == Reaction.HOLD else Mode.FOLLOW
        self._takeover.change(self._retract if reaction >= Reaction.RETRACT else following)
        if reaction >= Reaction.FREEZE:
            self._forbidden[0] = math.inf
        elif self._forbidden[0]:
            # Delayed errors from the return motion must not be learned.
            self._forbidden[0] = self._takeover.remaining + self._settled
        skipped, self._takeover.skipped = self._takeover.skipped, 0.0
        if not skipped:
            return []
        return [Sparse(f"{self._name}/events", messages.EVENT, index, {"action": f"{OUT_OF_REACH}: by {skipped:g}"})]


class Obedient(Stage):
    """Stage that may obey the supervisor, whose reactions are its last input; a subclass sets the obedience, if any."""

    stops: ClassVar[Mapping[int, str]] = {OBEY: "reaction: the supervisor asks for another one"}
    _obedience: Obedience | None = None

    @property
    def listener(self) -> Listener:
        """Obedience of the stage for kernels."""
        obedience = self._obedience
        return Listener(obedience.table if obedience else NOBODY, obedience is not None)

    def serve(
        self, reason: int, first: int, reached: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        """Obey a new reaction for which the step function has stopped (`OBEY`)."""
        if reason != OBEY or self._obedience is None:
            return []
        return self._obedience.obey(Reaction(inputs[self.own_inputs - 1]["reaction"][reached]), first + reached)
