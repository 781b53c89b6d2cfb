# SPDX-License-Identifier: Apache-2.0
"""Runs as they are heard, shown while they go on; knows nothing of ROS.

The view delays no member. Messages that come faster than it can show are left out, counted and reported; a run that
begins anew, under whatever name, is a recording of its own.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lathe_rc import messages
from lathe_rc.cell.block import Block
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.wire import Decoder
from lathe_rc.errors import LatheError, shown
from lathe_rc.messages import Signals
from lathe_rc.view.rerun_blueprint import blueprint
from lathe_rc.view.rerun_heard import Order
from lathe_rc.view.rerun_pieces import Pieces
from lathe_rc.view.rerun_scene import Scene
from lathe_rc.view.rerun_signals import wanted

if TYPE_CHECKING:
    import rerun as rr

PIECE = 0.1  #: length of a piece, about [s] of simulated time
_FLUSH = 30.0  # [s] for a viewer to take the rest of a recording


@dataclass(frozen=True)
class Shown:
    """The view of a run.

    Attributes:
        run_id: of the run.
        file: that it was saved to; None if it went to a viewer.
        first: first sample that is shown; above 0 if the view came late.
        end: sample after the last that was heard.
        revolutions: shown, of the part.
        left_out: pieces that lack some topic, or everything.
        complete: the last block of every topic was heard.
    """

    run_id: str
    file: Path | None
    first: int
    end: int
    revolutions: int
    left_out: int
    complete: bool


class _Run:
    """One run, on its way to a recording; a sink between `Pieces` and `Scene`.

    Args:
        block: the first that was heard.
        types: message type by topic, of those that are known to be there.
        recording: where it goes.
        file: that the recording is saved to.
        rate: points of a curve in a second, at most.
        say: tells people.
    """

    def __init__(
        self,
        block: Block,
        types: Mapping[str, str],
        recording: "rr.RecordingStream",
        file: Path | None,
        rate: float,
        say: Callable[[str], None],
    ) -> None:
        if not block.step_ns:
            raise LatheError(f"{block.source} sends a step of 0 ns")
        self._types = dict(types)
        self._recording, self._file, self._say = recording, file, say
        self._name, self._step_ns = block.run_id or "(no id)", block.step_ns
        self._scene = Scene(recording, types, block.step_ns, rate=rate)
        size = math.ceil(PIECE * 1e9 / block.step_ns / self._scene.window) * self._scene.window
        self._pieces = Pieces(types, size, self)
        self._piece_s = size * block.step_ns * 1e-9
        self._told = 0  # pieces that are known to be left out
        self._end, self._begun = block.first_index, False
        self._run_id = block.run_id
        self._ended: dict[str, bool] = {topic: False for topic, kind in types.items() if wanted(kind)}
        recording.send_blueprint(blueprint(types, live=True))

    def block(self, topic: str, msgtype: str, block: Block) -> bool:
        """Take a block; tells whether the run is over with it."""
        if block.step_ns != self._step_ns:
            raise LatheError(f"{topic}: {block.source} has a step of {block.step_ns} ns; expected {self._step_ns}")
        if topic not in self._types:
            self._types[topic] = msgtype
            self._scene.learn(self._types)
            self._pieces.learn(self._types)
            self._recording.send_blueprint(blueprint(self._types, live=True))
        self._pieces.block(topic, block.first_index, block.signals)
        self._end = max(self._end, block.first_index + block.samples)
        self._ended[topic] = block.last
        return block.last and all(self._ended.values())

    def message(self, message: Sparse) -> None:
        """Take a message at a chosen sample."""
        self._pieces.message(message)

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        if not self._begun:
            self._begun = True
            late = f" from {self._pieces.first * self._step_ns * 1e-9:.2f} s on" if self._pieces.first else ""
            self._say(f"run {self._name} is shown{late}")
        self._tell(first)
        self._scene.chunk(first, samples, dense, sparse)

    def _tell(self, index: int) -> None:
        """Say what has been left out before a sample since this was last said."""
        missing = self._pieces.lost - self._told
        if missing:
            self._told += missing
            at = index * self._step_ns * 1e-9
            text = f"left out, wholly or in part: {missing} pieces of {self._piece_s:.3g} s, by {at:.2f} s"
            self._scene.note(index, text)
            self._say(f"run {self._name}: {text}")

    def close(self) -> Shown:
        """Show what is left, and end the recording."""
        self._pieces.close()
        self._tell(self._end)
        complete = all(self._ended.values())
        if not complete:
            self._scene.note(self._end, "the end of the run was not heard")
        self._scene.close()
        seen = Shown(
            self._run_id,
            self._file,
            self._pieces.first,
            self._end,
            self._scene.revolutions,
            self._pieces.lost,
            complete,
        )
        self._say(
            f"run {self._name}: {seen.revolutions} revolutions shown, {seen.left_out} pieces left out"
            + ("" if complete else "; its end was not heard")
        )
        try:
            self._recording.flush(timeout_sec=_FLUSH)
        except (RuntimeError, ValueError) as error:
            raise LatheError(f"the view cannot be written ({shown(error)})") from None
        finally:
            self._recording.disconnect()
        return seen


class Live:
    """Shows one run after the other.

    Args:
        open_recording: makes a recording of a name, and says what file it goes to.
        rate: points of a curve in a second, at most.
        say: tells people.

    Attributes:
        present: message type by topic, of all topics that can be heard; a run begins with these.
        shown: the runs that are over.
    """

    def __init__(
        self,
        open_recording: Callable[[str], tuple["rr.RecordingStream", Path | None]],
        *,
        rate: float,
        say: Callable[[str], None],
    ) -> None:
        self._open, self._rate, self._say = open_recording, rate, say
        self.present: Mapping[str, str] = {}
        self.shown: list[Shown] = []
        self._order = Order()
        self._decoders: dict[str, Decoder] = {}
        self._run: _Run | None = None
        self._over = False  # the run that goes on is; what still comes of it is passed over
        self._early: list[Sparse] = []  # before the first block

    def take(self, topic: str, msgtype: str, data: bytes) -> None:
        """Take an encoded message of a topic that is drawn.

        Raises:
            LatheError: it is broken, or the view cannot be written.
        """
        try:
            if msgtype in messages.block_types():
                self._block(topic, msgtype, data)
            else:
                self._message(topic, msgtype, data)
        except ValueError as error:
            raise LatheError(f"{topic}: {error}") from None

    def _block(self, topic: str, msgtype: str, data: bytes) -> None:
        decoder = self._decoders.get(topic)
        if decoder is None:
            decoder = self._decoders[topic] = Decoder(msgtype, sorted(wanted(msgtype)))
        block = decoder.decode(data)
        if not self._belongs(topic, block.run_id, block.first_index, block.first_index + block.samples):
            return
        if self._run is None:
            recording, file = self._open(block.run_id or "run")
            self._run = _Run(block, {**self.present, topic: msgtype}, recording, file, self._rate, self._say)
            for message in self._early:
                self._run.message(message)
        if self._run.block(topic, msgtype, block):
            self.end()

    def _message(self, topic: str, msgtype: str, data: bytes) -> None:
        message = messages.decode(msgtype, data)
        index = int(message.sample_index)
        if self._belongs(topic, message.run_id, index, index):
            sparse = Sparse(topic, msgtype, index, messages.values_of(msgtype, data))
            if self._run:
                self._run.message(sparse)
            else:
                self._early.append(sparse)

    def _belongs(self, topic: str, run_id: str, first: int, end: int) -> bool:
        """Whether samples belong to the run that is shown; one that begins with them is from now on."""
        where = self._order.place(topic, run_id, first, end)
        if where == "new":
            self.end()
            self._early, self._over = [], False
        return where != "old" and not self._over

    def end(self) -> None:
        """The run is over, or nobody is there any more to send the rest of it.

        Raises:
            LatheError: the view cannot be written.
        """
        if self._run:
            run, self._run, self._over = self._run, None, True
            self.shown.append(run.close())
