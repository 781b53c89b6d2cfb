# SPDX-License-Identifier: Apache-2.0
"""Running cells in the panel, fed with their messages; independent of ROS."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from lathe_live.live_runs import LiveRuns, RunOrder, RunView, ShownRun
from lathe_live.panel_view import View
from lathe_rc import messages
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.ports import Sparse
from lathe_rc.blocks.wire import Decoder
from lathe_rc.event_log import LOGGED
from lathe_rc.messages import Signals
from lathe_rc.protocol.messages import Phase

PIECE = 0.04  #: approximate length of a chunk [s] of simulated time


class _Heard(RunView):
    """One run in the view of the panel, which begins anew; ``told`` returns the panel's status, given the run's."""

    def __init__(
        self, view: View, block: Block, types: Mapping[str, str], told: Callable[[str], Mapping[str, Any]]
    ) -> None:
        self._panel, self._told = view, told
        view.begin(types, block.step_ns)
        super().__init__(block, types, view, math.ceil(PIECE * 1e9 / block.step_ns))

    def note(self, index: int, text: str) -> None:
        """Add a line to the log."""
        self._panel.say(index, "panel", text)

    def leave_out(self, index: int, count: int) -> None:
        """Mark dropped chunks, and count them in one line beside the log."""
        self._panel.timeline.mark(index, "lost", self.left_out(index, count))
        self._panel.know_lost(self.left_out(index, self.pieces.lost))

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Show consecutive samples, and tell the page."""
        super().chunk(first, samples, dense, sparse)
        self._panel.publish(self._told("running"))

    def close(self) -> ShownRun:
        """Show the remaining samples."""
        shown = super().close()
        self._panel.finish()
        self._panel.publish(self._told("ended"), at_once=True)
        return shown


class LivePanel(LiveRuns):
    """Running cells in the panel, one run after the other.

    Attributes:
        view: see `View`.
    """

    urgent = frozenset({*LOGGED, messages.SAFETY, messages.ENCODER, messages.CELL_STATE})

    def __init__(self) -> None:
        self._state, self._held = "waiting", False
        self._known: dict[str, Any] = {"pace": None, "bag": "", "failure": ""}
        super().__init__(self._heard)
        self.view = View({}, 0, live=True)
        fields = {messages.SAFETY: ["state", "reaction"], messages.ENCODER: []}
        self._signs, self._urgent = RunOrder(), {kind: Decoder(kind, names) for kind, names in fields.items()}
        self.know()

    def hear(self, topic: str, msgtype: str, data: bytes) -> None:
        """Set lamp, age and failure of the cell at once: the samples may wait, or be left out."""
        lamp = self.view.lamp
        if msgtype == messages.CELL_STATE:
            state = messages.decode(msgtype, data)
            self.know(failure=str(state.message) if state.state in (Phase.FAILED, Phase.SAFE) else "")
        elif msgtype in self._urgent:
            block = self._urgent[msgtype].decode(data)
            end = block.first_index + block.samples
            if self._goes_on(topic, block.run_id, block.first_index, end):
                self.view.age.heard(end)
                if msgtype == messages.SAFETY:
                    lamp.hear(end - 1, *(int(block.signals[name][-1]) for name in ("state", "reaction")))
        else:
            message = messages.decode(msgtype, data)
            index = int(message.sample_index)
            if self._goes_on(topic, message.run_id, index, index):
                lamp.take(Sparse(topic, msgtype, index, messages.signals_of(message)))

    def _goes_on(self, topic: str, run_id: str, first: int, end: int) -> bool:
        """Return True if samples belong to the run of lamp and age, which begin anew if necessary."""
        where = self._signs.place(topic, run_id, first, end)
        if where == "new":
            self.view.lamp.clear()
            self.view.age.begin()
        return where != "old"

    def _heard(self, block: Block, types: Mapping[str, str]) -> _Heard:
        self._held, self._known["pace"] = False, None
        return _Heard(self.view, block, types, self._status)

    def know(self, *, held: bool | None = None, **known: float | str) -> None:
        """Show what the messages of a run do not tell: whether it is ``held``, its ``pace``, the ``bag``."""
        self._held = self._held if held is None else held
        self._known |= known
        self.view.publish(self._status(self._state), at_once=True)

    def _status(self, state: str) -> Mapping[str, Any]:
        self._state = state
        told = {"factor": 0.0, "samples": 0, "events": "", "begun": 0, **self._known}
        if state == "running":
            state = "failed" if self._known["failure"] else "paused" if self._held else state
        return {"state": state, **told, "version": self.view.run}
