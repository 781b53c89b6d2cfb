# SPDX-License-Identifier: Apache-2.0
"""Running cells in the panel, fed with their messages; independent of ROS."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from lathe_rc.cell.block import Block
from lathe_rc.cell.stage import Sparse
from lathe_rc.errors import LatheError
from lathe_rc.messages import Signals
from lathe_rc.view.live_runs import LiveRuns, ShownRun
from lathe_rc.view.panel_view import View
from lathe_rc.view.rerun_pieces import Pieces
from lathe_rc.view.rerun_signals import drawn_fields

PIECE = 0.04  #: approximate length of a chunk [s] of simulated time


class _Heard:
    """One run in the view of the panel (implements `lathe_rc.view.live_runs.RunView`).

    Args:
        view: view of the panel, which begins anew.
        block: first block received.
        types: message type by topic, for the topics known so far.
        told: returns the status of the panel, given that of the run.
    """

    def __init__(
        self, view: View, block: Block, types: Mapping[str, str], told: Callable[[str], Mapping[str, Any]]
    ) -> None:
        if not block.step_ns:
            raise LatheError(f"{block.source} sends a step of 0 ns")
        self._view, self._told, self._types = view, told, dict(types)
        view.begin(types, block.step_ns)
        self._pieces = Pieces(types, math.ceil(PIECE * 1e9 / block.step_ns), self)
        self._run = ShownRun(block.run_id, None, first=block.first_index, end=block.first_index)
        self._ended = {topic: False for topic, kind in types.items() if drawn_fields(kind)}
        self.message = self._pieces.message

    def block(self, topic: str, msgtype: str, block: Block) -> bool:
        """Add a block; return True if the run ends with it."""
        if topic not in self._types:
            self._types[topic] = msgtype
            self._view.learn(self._types)
            self._pieces.learn(self._types)
        self._pieces.block(topic, block.first_index, block.signals)
        self._run.end = max(self._run.end, block.first_index + block.samples)
        self._ended[topic] = block.last
        return block.last and all(self._ended.values())

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Show consecutive samples, after a note about dropped ones before them."""
        if missing := self._pieces.lost - self._run.left_out:
            self._run.left_out = self._pieces.lost
            self._view.say(first, "panel", f"left out, wholly or in part: {missing} pieces of {PIECE:g} s")
        self._view.chunk(first, samples, dense, sparse)
        self._view.publish(self._told("running"))

    def close(self) -> ShownRun:
        """Show the remaining samples."""
        self._pieces.close()
        self._view.finish()
        self._run.complete = all(self._ended.values())
        if not self._run.complete:
            self._view.say(self._run.end, "panel", "the end of the run was not heard")
        self._view.publish(self._told("ended"), at_once=True)
        return self._run


class LivePanel(LiveRuns):
    """Running cells in the panel, one run after the other.

    Attributes:
        view: see `View`.
    """

    def __init__(self) -> None:
        self._state, self._held = "waiting", False
        self._known: dict[str, Any] = {"pace": None, "bag": ""}
        super().__init__(self._heard)
        self.view = View({}, 0)
        self.know()

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
        told = {"failure": "", "factor": 0.0, "samples": 0, "events": "", "begun": 0, **self._known}
        return {"state": "paused" if self._held and state == "running" else state, **told, "version": self.view.run}
