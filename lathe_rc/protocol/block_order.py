# SPDX-License-Identifier: Apache-2.0
"""Order of the blocks of one topic: each once, none missing, from one source."""

from lathe_rc.errors import LatheError
from lathe_rc.protocol.messages import ForeignMessage


class BlockOrder:
    """Which block may come next.

    Args:
        topic: fully qualified name.
        run_id: of the cell; empty: any.
        longest_gap: samples that may be missing in a free-running cell; None: none may, the cell has a window.

    Attributes:
        topic: see the arguments.
        source: the only node whose blocks are accepted; empty: until a source is expected, none if there is a run, and
            the first to come if there is none.
        open: it is not known yet with which sample the blocks begin.
        end: index after the newest sample, with which the next block has to begin unless it is `open`.
        received: blocks so far, those that were lost included.
        lost: blocks that never came; always 0 unless the cell is free-running.
        ended: the last block has come.
        repeats: blocks may come twice: their source may be another process that goes on in its place.
        held_from: sample from which on the newest sample is held, since the source is lost; None: it is not.
    """

    def __init__(self, topic: str, run_id: str, longest_gap: int | None = None) -> None:
        self.topic = topic
        self._run_id, self._longest_gap = run_id, longest_gap
        self.source = ""
        self.open, self.ended, self.repeats = True, False, False
        self.received = self.lost = self.end = 0
        self.held_from: int | None = None

    def expect(self, source: str, first: int | None = 0) -> None:
        """Accept blocks of this node alone, from a sample on; None: the first to come."""
        self.source, self.open = source, first is None
        self.received = self.lost = 0
        self.end, self.ended = first or 0, False

    def admit(self, run_id: str, source: str) -> None:
        """Refuse a stranger.

        Raises:
            ForeignMessage: another run or source.
        """
        if self._run_id and run_id != self._run_id:
            raise ForeignMessage(self.topic, source, run_id, f"expected run {self._run_id!r}")
        if source != self.source and (self.source or self._run_id):
            raise ForeignMessage(self.topic, source, run_id, f"expected {self.source or 'nobody yet'}")

    def missing(self, source: str, first: int, samples: int) -> int | None:
        """Samples that are missing before a block; None: it is a repeat, or another one already stands for it.

        Raises:
            LatheError: a gap or a repeat that may not be.
        """
        if self.held_from is not None:
            return None
        if self.open:
            self.source, self.end, self.open = source, first, False
        if self.repeats and first + samples <= self.end:
            return None
        missing = first - self.end
        if missing < 0 or (missing and (self._longest_gap is None or not self.received)):
            what = f"{missing} samples are missing" if missing > 0 else "a block came twice"
            raise LatheError(f"{self.topic}: {source} goes from sample {self.end} to {first}: {what}")
        if missing > (self._longest_gap or 0):
            raise LatheError(f"{self.topic}: {source} jumps by {missing} samples")
        return missing

    def append(self, end: int, blocks: int = 1, *, last: bool) -> None:
        """The next blocks, which end before a sample, are there."""
        self.end, self.ended = end, last
        self.received += blocks

    def hold(self, end: int) -> None:
        """The source is lost: its newest sample stands for all that follow up to sample ``end``, where the run ends."""
        self.held_from = self.end
        self.end = max(end, self.held_from)
        self.open, self.ended = False, True

    def resume(self, source: str, end: int, received: int, *, ended: bool) -> None:
        """Go on from the state of another process; blocks from before it are repeats."""
        self.source, self.end, self.received, self.ended = source, end, received, ended
        self.open, self.repeats = False, True
