# SPDX-License-Identifier: Apache-2.0
"""Live view of running cells, fed with their messages; independent of ROS.

The view delays no member. Messages that arrive faster than they can be shown are dropped, counted and reported; each
new run, even of the same name, is a separate recording.
"""

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from lathe_rc import messages
from lathe_rc.cell.block import Block
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.wire import Decoder
from lathe_rc.errors import LatheError
from lathe_rc.messages import Signals
from lathe_rc.view.rerun_pieces import Pieces
from lathe_rc.view.rerun_scene import Scene
from lathe_rc.view.rerun_signals import drawn_fields

if TYPE_CHECKING:
    import rerun as rr

Message = tuple[str, str, bytes]  # fully qualified topic, message type, encoded message
Open = Callable[[str], tuple["rr.RecordingStream", Path | None]]  # a recording by name, and its file

PIECE = 0.1  #: approximate length of a chunk [s] of simulated time


class Backlog:
    """Queue of messages to be shown. When it is full, all of them are dropped, so that later chunks are complete again.

    If every second message were dropped instead, every chunk would have gaps.

    Args:
        limit: size of the queue [B].
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._size = 0
        self._messages: deque[Message | None] = deque()
        self._news = threading.Condition()
        self._closed = False

    def put(self, *added: Message | None) -> None:
        """Add messages; None means that no publisher is left."""
        with self._news:
            for message in added:
                size = len(message[2]) if message else 0
                if self._size + size > self._limit:
                    self._messages.clear()
                    self._size = 0
                self._size += size
                self._messages.append(message)
            self._news.notify()

    def close(self) -> None:
        """Close the queue; the reader ends after the last message."""
        with self._news:
            self._closed = True
            self._news.notify()

    def __iter__(self) -> Iterator[Message | None]:
        """Yield messages as they arrive, until the queue is closed and empty."""
        while True:
            with self._news:
                self._news.wait_for(lambda: self._messages or self._closed)
                if not self._messages:
                    return
                message = self._messages.popleft()
                self._size -= len(message[2]) if message else 0
            yield message


class RunOrder:
    """Assignment of samples of many topics to runs; samples arrive in order within each topic, but not across topics.

    Runs have run ids, but equal scenarios have equal ids, so a topic whose sample index decreases also starts a new
    run. Late samples of the previous run are recognised because they continue that topic.
    """

    def __init__(self) -> None:
        self._run: str | None = None
        self._before: str | None = None
        self._ends: dict[str, int] = {}  # sample after the newest of each topic, in this run
        self._old: dict[str, int] = {}  # likewise in the previous run

    def place(self, topic: str, run: str, first: int, end: int) -> Literal["same", "new", "old"]:
        """Return the run that a topic's samples belong to: the current one, a new one, or the previous one."""
        newest = max(self._ends.values(), default=0)
        if run == self._run and first >= self._ends.get(topic, 0):
            # The same run id twice in a row: the first samples of a topic may still belong to the previous run, if they
            # continue it there and are ahead of all topics of this run.
            again = run == self._before and topic not in self._ends
            if again and newest < first and first >= self._old.get(topic, first + 1):
                return "old"
            self._ends[topic] = end
            return "same"
        if run == self._before != self._run and first >= self._old.get(topic, 0):  # a late topic of the previous run
            return "old"
        self._run, self._before = run, self._run
        self._ends, self._old = {topic: end}, self._ends
        return "new"


@dataclass
class ShownRun:
    """Summary of a run that was shown.

    Attributes:
        run_id: run id.
        file: file of the recording; None if it was sent to a viewer.
        first: first sample shown; above 0 if the view was started late.
        end: sample after the last one received.
        revolutions: number of revolutions shown.
        left_out: number of chunks that lack some or all topics.
        complete: whether the last block of every topic was received.
    """

    run_id: str
    file: Path | None
    first: int = 0
    end: int = 0
    revolutions: int = 0
    left_out: int = 0
    complete: bool = False


class _RunView:
    """View of one run: passes chunks from `Pieces` to `Scene`.

    Args:
        block: first block received.
        types: message type by topic, for the topics known so far.
        open_recording: creates the recording of the run.
        rate: largest number of curve points per second.
        say: called with each line for the user.
    """

    def __init__(
        self, block: Block, types: Mapping[str, str], open_recording: Open, rate: float, say: Callable[[str], None]
    ) -> None:
        if not block.step_ns:
            raise LatheError(f"{block.source} sends a step of 0 ns")
        self._recording, file = open_recording(block.run_id or "run")
        self._step_ns = block.step_ns
        self._name, self._say = f"run {block.run_id or '(no id)'}", say
        self._scene = Scene(self._recording, types, block.step_ns, rate=rate, live=True)
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


class Live:
    """Live view of running cells, one run after the other.

    Args:
        open_recording: creates a recording of a given name, and returns it with its file.
        rate: largest number of curve points per second.
        say: called with each line for the user.

    Attributes:
        present: message type by topic, for all topics with publishers; a new run begins with these topics.
        shown: summaries of the finished runs.
    """

    def __init__(self, open_recording: Open, *, rate: float, say: Callable[[str], None]) -> None:
        self._open, self._rate, self._say = open_recording, rate, say
        self.present: Mapping[str, str] = {}
        self.shown: list[ShownRun] = []
        self._order = RunOrder()
        self._decoders: dict[str, Decoder] = {}
        self._run: _RunView | None = None
        self._over = False  # the current run has ended; further samples of it are ignored
        self._early: list[Sparse] = []  # messages before the first block

    def take(self, topic: str, msgtype: str, data: bytes) -> None:
        """Add an encoded message of a plotted topic.

        Raises:
            LatheError: the message is malformed, or the view cannot be written.
        """
        try:
            if msgtype in messages.block_types():
                if topic not in self._decoders:
                    self._decoders[topic] = Decoder(msgtype, sorted(drawn_fields(msgtype)))
                block = self._decoders[topic].decode(data)
                if self._belongs(topic, block.run_id, block.first_index, block.first_index + block.samples):
                    self._block(topic, msgtype, block)
            else:
                message = messages.decode(msgtype, data)
                index = int(message.sample_index)
                if self._belongs(topic, message.run_id, index, index):
                    take = self._run.message if self._run else self._early.append
                    take(Sparse(topic, msgtype, index, messages.values_of(msgtype, data)))
        except ValueError as error:
            raise LatheError(f"{topic}: {error}") from None

    def _block(self, topic: str, msgtype: str, block: Block) -> None:
        if self._run is None:
            self._run = _RunView(block, {**self.present, topic: msgtype}, self._open, self._rate, self._say)
            for message in self._early:
                self._run.message(message)
        if self._run.block(topic, msgtype, block):
            self.end()

    def _belongs(self, topic: str, run_id: str, first: int, end: int) -> bool:
        """Return True if samples belong to the current run, after starting a new one if necessary."""
        where = self._order.place(topic, run_id, first, end)
        if where == "new":
            self.end()
            self._early, self._over = [], False
        return where != "old" and not self._over

    def end(self) -> None:
        """Close the view of the current run once it has ended or no publishers remain.

        Raises:
            LatheError: the view cannot be written.
        """
        if self._run:
            run, self._run, self._over = self._run, None, True
            self.shown.append(run.close())
