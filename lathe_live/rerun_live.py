# SPDX-License-Identifier: Apache-2.0
"""Live view of running cells in Rerun, each run in a recording of its own; independent of ROS.

Chunks that were dropped are counted and reported.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lathe_live.live_runs import LiveRuns, RunView, ShownRun
from lathe_live.rerun_part import Outlook
from lathe_live.rerun_scene import Scene
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.parameters import judged
from lathe_rc.cell.scenario import Scenario
from lathe_rc.judge.loops import loops
from lathe_rc.messages import Signals

if TYPE_CHECKING:
    import rerun as rr

Open = Callable[[str], tuple["rr.RecordingStream", Path | None]]  # a recording by name, and its file

PIECE = 0.1  #: approximate length of a chunk [s] of simulated time


class _RunView(RunView):
    """View of one run in a recording of its own.

    Args:
        block: first block received.
        types: message type by topic, for the topics known so far.
        open_recording: creates the recording of the run.
        rate: largest number of curve points per second.
        say: called with each line for the user.
        scenario: scenario of the cell; None if unknown.
    """

    def __init__(
        self,
        block: Block,
        types: Mapping[str, str],
        open_recording: Open,
        rate: float,
        say: Callable[[str], None],
        scenario: Scenario | None,
    ) -> None:
        self._recording, file = open_recording(block.run_id or "run")
        self._name, self._say, self._begun = f"run {block.run_id or '(no id)'}", say, False
        known: dict[str, Any] = {}
        if scenario:
            known = {"outlook": Outlook.of(scenario), "loops": loops(judged(scenario.nodes))}
        self._scene = Scene(self._recording, types, block.step_ns, rate=rate, live=True, **known)
        size = math.ceil(PIECE * 1e9 / block.step_ns / self._scene.window) * self._scene.window
        super().__init__(block, types, self._scene, size, file)

    def note(self, index: int, text: str) -> None:
        """Log a line among the events, and say it to the user."""
        self._scene.note(index, text)
        self._say(f"{self._name}: {text}")

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Log consecutive samples; say that the run is shown before the first ones."""
        if not self._begun:
            self._begun = True
            late = f" from {self.pieces.first * self._step_ns * 1e-9:.2f} s on" if self.pieces.first else ""
            self._say(f"{self._name} is shown{late}")
        super().chunk(first, samples, dense, sparse)

    def close(self) -> ShownRun:
        """Log the remaining samples, and end the recording."""
        shown = super().close()
        try:
            self._scene.close()
        finally:
            self._recording.disconnect()
        shown.revolutions = self._scene.revolutions
        self._say(f"{self._name}: {shown.revolutions} revolutions shown, {shown.left_out} pieces left out")
        return shown


class Live(LiveRuns):
    """Live view of running cells in Rerun, one run after the other.

    Args:
        open_recording: creates a recording of a given name, and returns it with its file.
        rate: largest number of curve points per second.
        say: called with each line for the user.
        scenario: scenario of the cell, for the extent of the part and the results of loops; None if unknown.
    """

    def __init__(
        self, open_recording: Open, *, rate: float, say: Callable[[str], None], scenario: Scenario | None
    ) -> None:
        super().__init__(lambda block, types: _RunView(block, types, open_recording, rate, say, scenario))
