# SPDX-License-Identifier: Apache-2.0
"""What a controller or a feed drive does when the supervisor asks for a reaction."""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Protocol

import numpy as np
from annotated_types import Gt

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Samples
from lathe_rc.cell.parameters import ObedientParameters, parameter
from lathe_rc.cell.stage import Input, Sparse
from lathe_rc.control import bounded
from lathe_rc.control.bounded import Bounds, Mode, Takeover
from lathe_rc.errors import InputError
from lathe_rc.safety.state_machine import Reaction

OUT_OF_REACH = "out of reach"  #: event of a takeover that could not begin where the command was


def listens(parameters: ObedientParameters) -> list[Input]:
    """The input with the reactions, if anybody is listened to."""
    delay = parameters.reaction_delay
    return [Input("safety", messages.SAFETY, ("reaction",), delay)] if delay else []


class FeedObedientParameters(ObedientParameters):
    """Of a node of the feed that obeys the supervisor."""

    stop_rate: Annotated[float, Gt(0)] = parameter(
        10.0, "largest rate of the command while it is brought to rest, and of what is left of that when given back",
        "1/s",
    )  # fmt: skip
    stop_rate_change: Annotated[float, Gt(0)] = parameter(1000.0, "largest change of that rate", "1/s^2")
    stop_time: Annotated[float, Gt(0)] = parameter(
        1.0, "longest duration: a command that is farther away begins where the way takes so long", "s"
    )

    def obedience(
        self, name: str, learner: "Learner | None", *, speed: bool, limit: float, settled: int
    ) -> "Obedience":
        """What obeys for a command of the feed.

        A command for a speed goes to 0, one for a position stays: so the slide stands. Nothing is taken out of the
        part along the slide.

        Args:
            name: of the node.
            learner: see `Obedience`.
            speed: whether the command stands for a speed.
            limit: largest command to each side, in its unit; 0: there is none.
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
        if self.reaction_delay:
            bounded.prepare()
        rest = Mode.RETRACT if speed else Mode.HOLD
        takeover = Takeover(bounds, 0.0, self.step, reach=reach, carries=False)
        return Obedience(name, learner, takeover, settled=settled, hold=rest, retract=rest)


class Learner(Protocol):
    """Who learns."""

    def may_learn(self, *, on: bool) -> None:
        """Learn, or do not."""


class Obedience:
    """Stops learning, holds or retracts the command, and gives it back when the reaction is over.

    Args:
        name: of the node.
        learner: that learns at first; None: there is nothing to learn.
        takeover: of the command.
        settled: samples from where a command is given back until errors are worth learning from.
        hold: what to hold is.
        retract: what to retract and to stop are.

    Attributes:
        reaction: that is obeyed.
    """

    def __init__(
        self,
        name: str,
        learner: Learner | None,
        takeover: Takeover,
        *,
        settled: int,
        hold: Mode = Mode.HOLD,
        retract: Mode = Mode.RETRACT,
    ) -> None:
        self._name, self._learner, self._takeover, self._settled = name, learner, takeover, settled
        self._hold, self._retract = hold, retract
        self.reaction = Reaction.NONE
        self._wants_to_learn = True
        self._skipped = 0.0  # where the command was out of reach: by how much, in its unit
        self._forbidden = 0.0  # samples until learning is no longer forbidden

    @property
    def newest(self) -> float:
        """The command of the last sample, in its unit."""
        return self._takeover.newest

    @property
    def held(self) -> bool:
        """Whether the command is not the controller's."""
        return self.reaction >= Reaction.HOLD

    def idle(self, reaction: Samples) -> bool:
        """Whether a block is one piece without a reaction, and nothing of an earlier one is left to wait for."""
        # Bytes are compared in a third of the time that np.count_nonzero takes.
        return not self.reaction and not self._forbidden and reaction.tobytes() == bytes(reaction.size)

    def pieces(self, reaction: Samples) -> Iterator[tuple[int, int]]:
        """Pieces of a block in which the reaction stays the same; it is obeyed when its piece is handed out."""
        if self.idle(reaction):
            yield 0, reaction.size
            return
        changes = np.flatnonzero(np.diff(reaction, prepend=reaction.dtype.type(self.reaction))).tolist()
        for start, stop in pairwise([0, *(change for change in changes if change), reaction.size]):
            if start in changes:
                self.obey(Reaction(reaction[start]))
            if 0 < self._forbidden < stop - start:
                free = start + int(self._forbidden)
                yield start, free
                self._forbid(0.0)
                yield free, stop
            else:
                yield start, stop
                self._forbid(max(self._forbidden - (stop - start), 0.0))

    def learn(self, *, wanted: bool) -> None:
        """Learn or freeze as soon as no reaction forbids it."""
        self._wants_to_learn = wanted
        if self._learner:
            self._learner.may_learn(on=wanted and not self._forbidden)

    def _forbid(self, samples: float) -> None:
        """Let nobody learn for so many samples."""
        self._forbidden = samples
        self.learn(wanted=self._wants_to_learn)

    def obey(self, reaction: Reaction) -> None:
        """Do what a reaction asks for, from the next sample on."""
        self.reaction = reaction
        following = self._hold if reaction == Reaction.HOLD else Mode.FOLLOW
        self._takeover.change(self._retract if reaction >= Reaction.RETRACT else following)
        self._skipped = self._takeover.skipped
        if reaction >= Reaction.FREEZE:
            self._forbid(math.inf)
        elif self._forbidden:
            # The errors of the way back are nothing to learn from; they come late.
            self._forbid(float(self._takeover.remaining + self._settled))

    def told(self, index: int) -> list[Sparse]:
        """What is to be said of what has just been obeyed, from sample ``index`` on."""
        if not self._skipped:
            return []
        action, self._skipped = f"{OUT_OF_REACH}: by {self._skipped:g}", 0.0
        return [Sparse(f"{self._name}/events", messages.EVENT, index, {"action": action})]

    def apply(self, command: Samples) -> None:
        """Make of what the controller wants what the drive gets; in place, in its unit."""
        self._takeover.apply(command)
