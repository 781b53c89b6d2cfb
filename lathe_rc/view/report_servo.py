# SPDX-License-Identifier: Apache-2.0
"""Force and position loops of a bag, gathered for pages: result by revolution, and courses over time."""

from collections.abc import Mapping

import numpy as np

from lathe_rc.blocks.ports import Sparse
from lathe_rc.errors import InputError
from lathe_rc.judge.loops import LoopResult, LoopWatch
from lathe_rc.messages import Signals
from lathe_rc.view.report_series import Envelope


class Servo:
    """Force or position loop of a bag; a sink (see `lathe_rc.cell.engine.Sink`).

    Args:
        watch: evaluates the loop.

    Attributes:
        loop: the loop.
        set_point, measured, command: envelopes over the samples; measured as the controller sees it.
        refused: reason why the loop, or the rest of it, is not evaluated; empty if it is.
    """

    def __init__(self, watch: LoopWatch) -> None:
        self._watch, self.loop = watch, watch.loop
        self.set_point, self.measured, self.command = Envelope(), Envelope(), Envelope()
        self.refused = ""

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Add consecutive samples."""
        servo = dense[self._watch.topics[1]]
        with np.errstate(over="ignore", invalid="ignore"):  # a bag may hold absurd numbers, which are shown unchanged
            self.set_point.add(servo["set_point"])
            self.measured.add(servo["set_point"] - servo["error"])
            self.command.add(servo["command"])
            if not self.refused:
                try:
                    self._watch.chunk(first, samples, dense, sparse)
                except InputError as error:
                    self.refused = str(error)

    @property
    def result(self) -> LoopResult:
        """Return the result of the loop in the samples so far."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._watch.result()
