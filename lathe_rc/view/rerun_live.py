# SPDX-License-Identifier: Apache-2.0
"""Live view of running cells in Rerun, each run in a recording of its own; independent of ROS.

Chunks that were dropped are counted and reported.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lathe_rc.cell.block import Block
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stage import Sparse
from lathe_rc.errors import LatheError
from lathe_rc.loops import loops
from lathe_rc.messages import Signals
from lathe_rc.view.live_runs import LiveRuns, ShownRun
from lathe_rc.view.rerun_part import Outlook
from lathe_rc.view.rerun_pieces import Pieces
from lathe_rc.view.rerun_scene import Scene
from lathe_rc.view.rerun_signals import drawn_fields

if TYPE_CHECKING:
    import rerun as rr

Open = Callable[[str], tuple["rr.RecordingStream", Path | None]]  # a recording by name, and its file

PIECE = 0.1  #: approximate length of a chunk [s] of simulated time


class _RunView:
    """View of one run: passes chunks from `Pieces` to `Scene`.

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
        if not block.step_ns:
            raise LatheError(f"{block.source} sends a step of 0 ns")
        self._recording, file = open_recording(block.run_id or "run")
        self._step_ns = block.step_ns
        self._name, self._say = f"run {block.run_id or '(no id)'}", say
        known: dict[str, Any] = {}
        if scenario:
            known = {"outlook": Outlook.of(scenario), "loops": loops(scenario.nodes)}
        self._scene = Scene(self._recording, types, block.step_ns, rate=rate, live=True, **known)
        self._size = math.ceil(PIECE * 1e9 / block.step_ns / self._scene.window) * self._scene.window
        self._pieces = Pieces(types, self._size, self)
        self._shown = ShownRun(block.run_id, file, end=block.first_index)
        self._begun = False
        self._types = dict(types)
        self._ended = {topic: False for topic, kind in types.items() if drawn_fields(kind)}
        self.message = self._pieces.message

    def block(self, topic: str, msgtype: str, block: Block) -> bool:
        """Add a block; return True if the run ends with it."""
        if block.step_ns != self._step_ns:
            raise LatheError(f"{topic}: {block.source} has a step of {block.step_ns} ns; expected {self._step_ns}")
        if topic not in self._types:
            self._types[topic] = msgtype
            self._scene.learn(self._types)
            self._pieces.learn(self._types)
        self._pieces.block(topic, block.first_index, block.signals)
        self._shown.end = max(self._shown.end, block.first_index + block.samples)
        self._ended[topic] = block.last
        return block.last and all(self._ended.values())

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Pass consecutive samples on to the scene, after a note about dropped chunks before them."""
        if not self._begun:
            self._begun = True
            late = f" from {self._pieces.first * self._step_ns * 1e-9:.2f} s on" if self._pieces.first else ""
            self._say(f"{self._name} is shown{late}")
        self._report_losses(first)
        self._scene.chunk(first, samples, dense, sparse)

    def _report_losses(self, index: int) -> None:
        """Report the chunks dropped before a sample since the last report."""
        if missing := self._pieces.lost - self._shown.left_out:
            self._shown.left_out = self._pieces.lost
            piece, at = (samples * self._step_ns * 1e-9 for samples in (self._size, index))
            text = f"left out, wholly or in part: {missing} pieces of {piece:.3g} s, by {at:.2f} s"
            self._scene.note(index, text)
            self._say(f"{self._name}: {text}")

    def close(self) -> ShownRun:
        """Show the remaining samples, and end the recording."""
        shown = self._shown
        self._pieces.close()
        self._report_losses(shown.end)
        shown.first, shown.complete = self._pieces.first, all(self._ended.values())
        if not shown.complete:
            self._scene.note(shown.end, "the end of the run was not heard")
        try:
            self._scene.close()
        finally:
            self._recording.disconnect()
        shown.revolutions = self._scene.revolutions
        unheard = "" if shown.complete else "; its end was not heard"
        self._say(f"{self._name}: {shown.revolutions} revolutions shown, {shown.left_out} pieces left out{unheard}")
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
        self, open_recording: Open, *, rate: float, say: Callable[[str], None], scenario: Scenario | None = None
    ) -> None:
        super().__init__(lambda block, types: _RunView(block, types, open_recording, rate, say, scenario))
