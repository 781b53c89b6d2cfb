# SPDX-License-Identifier: Apache-2.0
"""What a learning controller does when the supervisor asks for a reaction."""

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from lathe_rc.cell.messages import Samples
from lathe_rc.cell.stages.learning_parameters import LearningControllerParameters
from lathe_rc.control.bounded import Bounds, Mode, Takeover
from lathe_rc.control.repetitive import RepetitiveController
from lathe_rc.safety.state_machine import Reaction

_SETTLED = 4.0  # lead times until a drive has followed


class Obedience:
    """Stops learning, falls back, holds or retracts the command, and gives it back when the reaction is over.

    Args:
        controller: that obeys.
        parameters: of its stage.

    Attributes:
        lost: the controller cannot go on: the angle is none that it could read its memory at.
        constant_lead: whether the lead angle shall be that of the nominal speed.
    """

    def __init__(self, controller: RepetitiveController, parameters: LearningControllerParameters) -> None:
        self._controller, self._parameters = controller, parameters
        bounds = Bounds(parameters.retract_velocity, parameters.retract_acceleration, parameters.retract_jerk)
        self._takeover = Takeover(bounds, parameters.retract_position, parameters.step)
        self._reaction = Reaction.NONE
        self._wants_to_learn = controller.learning
        self._forbidden = 0.0  # samples until learning is no longer forbidden
        self.lost = self.constant_lead = False

    @property
    def newest(self) -> float:
        """The command of the last sample [m]."""
        return self._takeover.newest

    def idle(self, reaction: Samples) -> bool:
        """Whether a block is one piece without a reaction, and nothing of an earlier one is left to wait for."""
        return not (self._reaction or self._forbidden or np.count_nonzero(reaction))

    def pieces(self, reaction: Samples) -> Iterator[tuple[int, int]]:
        """Pieces of a block in which the reaction stays the same; it is obeyed when its piece is handed out."""
        changes = np.flatnonzero(np.diff(reaction, prepend=reaction.dtype.type(self._reaction))).tolist()
        for start, stop in pairwise([0, *(change for change in changes if change), reaction.size]):
            if start in changes:
                self._obey(Reaction(reaction[start]))
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
        self._controller.learning = wanted and not self._forbidden

    def _forbid(self, samples: float) -> None:
        """Let nobody learn for so many samples."""
        self._forbidden = samples
        self.learn(wanted=self._wants_to_learn)

    def _obey(self, reaction: Reaction) -> None:
        self._reaction = reaction
        self.constant_lead = reaction >= Reaction.FALL_BACK and self._parameters.fall_back == "constant_lead"
        following = Mode.HOLD if reaction == Reaction.HOLD else Mode.FOLLOW
        self._takeover.change(Mode.RETRACT if reaction >= Reaction.RETRACT else following)
        if reaction >= Reaction.FREEZE:
            self._forbid(math.inf)
        elif self._forbidden:
            # The errors of the way back are nothing to learn from; they come late.
            table = self._parameters
            settled = round(_SETTLED * table.lead_time / table.step)
            self._forbid(float(self._takeover.remaining + settled + table.feedback_delay))

    def apply(self, command: Samples) -> None:
        """Make of what the controller wants what the drive gets; in place [m]."""
        self._takeover.apply(command)
