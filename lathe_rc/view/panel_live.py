# SPDX-License-Identifier: Apache-2.0
"""Running cells in the panel, fed with their messages; independent of ROS."""

import math
from collections.abc import Callable, Mapping
from typing import Any

from lathe_rc.cell.block import Block
from lathe_rc.cell.stage import Sparse
from lathe_rc.messages import Signals
from lathe_rc.view.live_runs import LiveRuns, RunView, ShownRun
from lathe_rc.view.panel_view import View

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
