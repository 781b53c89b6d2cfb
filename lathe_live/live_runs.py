# SPDX-License-Identifier: Apache-2.0
"""Runs of cells as a listener receives them: queue of messages, order of runs, one view after the other.

A view delays no member. Messages that arrive faster than they can be shown are dropped, and each new run, even of the
same name, has a view of its own. Independent of ROS.
"""

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from lathe_live.rerun_pieces import Pieces
from lathe_live.rerun_signals import drawn_fields
from lathe_rc import messages
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.ports import Sparse
from lathe_rc.blocks.wire import Decoder
from lathe_rc.errors import LatheError
from lathe_rc.messages import Signals
from lathe_rc.protocol.messages import Phase

Message = tuple[str, str, bytes]  # fully qualified topic, message type, encoded message
#: types of the topics whose figures rest on the samples of other nodes
_RESULTS = {messages.TOOL, messages.SERVO, messages.LEARNING, messages.PERIODIC, messages.MARGIN}


def _bulk(message: Message | None) -> int:
    """Return the size of a block [B]; 0 for other messages."""
    return len(message[2]) if message and message[1] in messages.block_types() else 0


class Backlog:
    """Queue of messages to be shown. When it is full, all blocks are dropped, so that later chunks are complete again.

    If every second block were dropped instead, every chunk would have gaps. Messages at chosen samples, which are few,
    are never dropped.

    Args:
        limit: size of the blocks in the queue [B].
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
                size = _bulk(message)
                if self._size + size > self._limit:
                    self._messages = deque(each for each in self._messages if not _bulk(each))
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
                self._size -= _bulk(message)
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


class Shown(Protocol):
    """Destination of a run; also a sink of the engine."""

    def learn(self, types: Mapping[str, str]) -> None:
        """Add topics."""

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Show consecutive samples."""


class RunView(ABC):
    """View of one run, whose blocks it assembles to chunks.

    Args:
        block: first block received.
        types: message type by topic, for the topics known so far.
        view: shows the chunks.
        size: length of a chunk [sample].
        file: file of the recording, if there is one.

    Attributes:
        pieces: assembler of the chunks.
        shown: summary of the run so far.
    """

    def __init__(
        self, block: Block, types: Mapping[str, str], view: Shown, size: int, file: Path | None = None
    ) -> None:
        self._view, self._step_ns, self._size, self._types = view, block.step_ns, size, dict(types)
        self.pieces = Pieces(types, size, self)
        self.shown = ShownRun(block.run_id, file, end=block.first_index)
        self._ended = {topic: False for topic, kind in types.items() if drawn_fields(kind)}
        self._unsound = False  # members of the cell were lost

    @abstractmethod
    def note(self, index: int, text: str) -> None:
        """Show a line of text about what was received, at a sample."""

    def block(self, topic: str, msgtype: str, block: Block) -> bool:
        """Add a block; return True if the run ends with it."""
        if block.step_ns != self._step_ns:
            raise LatheError(f"{topic}: {block.source} has a step of {block.step_ns} ns; expected {self._step_ns}")
        if topic not in self._types:
            self._types[topic] = msgtype
            self._view.learn(self._types)
            self.pieces.learn(self._types)
        self.pieces.block(topic, block.first_index, block.signals)
        self.shown.end = max(self.shown.end, block.first_index + block.samples)
        self._ended[topic] = block.last
        return block.last and all(self._ended.values())

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Show consecutive samples, after a note about dropped chunks before them."""
        self._report_losses(first)
        if self._unsound:
            dense = {topic: signals for topic, signals in dense.items() if self._types[topic] not in _RESULTS}
            sparse = {topic: found for topic, found in sparse.items() if found and found[0].type not in _RESULTS}
        self._view.chunk(first, samples, dense, sparse)

    def lose(self, index: int, why: str) -> None:
        """Show no more results from here on, since they may rest on held samples of lost members."""
        if not self._unsound:
            self.note(index, f"no results from here on: {why}")
        self._unsound = True

    def leave_out(self, index: int, count: int) -> None:
        """Report chunks dropped before a sample since the last report."""
        self.note(index, self.left_out(index, count))

    def left_out(self, index: int, count: int) -> str:
        """Return a text about a number of chunks that were dropped before a sample."""
        piece, at = (samples * self._step_ns * 1e-9 for samples in (self._size, index))
        return f"left out, wholly or in part: {count} pieces of {piece:.3g} s, by {at:.2f} s"

    def _report_losses(self, index: int) -> None:
        if missing := self.pieces.lost - self.shown.left_out:
            self.shown.left_out = self.pieces.lost
            self.leave_out(index, missing)

    def close(self) -> ShownRun:
        """Show the remaining samples, and end the view."""
        self.pieces.close()
        self._report_losses(self.shown.end)
        self.shown.first, self.shown.complete = self.pieces.first, all(self._ended.values())
        if not self.shown.complete:
            self.note(self.shown.end, "the end of the run was not heard")
        return self.shown


class LiveRuns:
    """Live view of running cells, one run after the other.

    Args:
        begin: returns the view of a run, given its first block received and the message types of its topics.

    Attributes:
        urgent: message types that `hear` takes.
        present: message type by topic, for all topics with publishers; a new run begins with these topics.
        shown: summaries of the finished runs.
    """

    urgent: frozenset[str] = frozenset()

    def __init__(self, begin: Callable[[Block, Mapping[str, str]], RunView]) -> None:
        self._begin = begin
        self.present: Mapping[str, str] = {}
        self.shown: list[ShownRun] = []
        self._order = RunOrder()
        self._decoders: dict[str, Decoder] = {}
        self._run: RunView | None = None
        self._over = False  # the current run has ended; further samples of it are ignored
        self._early: list[Sparse] = []  # messages before the first block

    def hear(self, topic: str, msgtype: str, data: bytes) -> None:
        """Take an encoded message of an urgent type as it arrives, in the thread that listens.

        Raises:
            ValueError: the message is malformed.
        """

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
            elif msgtype == messages.CELL_STATE:
                state = messages.decode(msgtype, data)
                if self._run and state.state == Phase.SAFE and state.run_id == self._run.shown.run_id:
                    self._run.lose(int(state.first_index), str(state.message))
            else:
                message = messages.decode(msgtype, data)
                index = int(message.sample_index)
                if self._belongs(topic, message.run_id, index, index):
                    take = self._run.pieces.message if self._run else self._early.append
                    take(Sparse(topic, msgtype, index, messages.values_of(msgtype, data)))
        except ValueError as error:
            raise LatheError(f"{topic}: {error}") from None

    def _block(self, topic: str, msgtype: str, block: Block) -> None:
        if not block.step_ns:
            raise LatheError(f"{block.source} sends a step of 0 ns")
        if self._run is None:
            self._run = self._begin(block, {**self.present, topic: msgtype})
            for message in self._early:
                self._run.pieces.message(message)
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
