# SPDX-License-Identifier: Apache-2.0
"""Order of the blocks of one topic: each block once, no gaps, from one source."""

from lathe_rc.protocol.messages import LONGEST, BadBlock, ForeignMessage, check_sender


class BlockOrder:
    """Sequence check of the blocks of one topic.

    Args:
        topic: fully qualified name.
        run_id: run id of the cell; empty: any.
        longest_gap: largest number of missing samples in a free-running cell; None: no gaps, the cell has a window.

    Attributes:
        topic: see the arguments.
        source: the only node whose blocks are accepted; while empty, no block is accepted if there is a run id;
            otherwise the first sender becomes the source.
        open: the first sample of the blocks is not known yet.
        end: index after the newest sample; the next block has to begin there unless the order is `open`.
        received: number of blocks so far, lost blocks included.
        lost: number of lost blocks; always 0 unless the cell is free-running.
        lossy: the source is a device that keeps no messages, so that the first blocks and the last ones may be lost.
        lost_from: first lost sample; None: none.
        ended: the last block has arrived.
        repeats: blocks may be repeated, since the source can be restarted in another process.
        held_from: sample from which the newest sample of a lost source is held; None: the source is not lost.
        rejected: further blocks are ignored: one was bad, or the source is lost.
        sender: node that has published the next block, as DDS knows it; empty: not known.
    """

    def __init__(self, topic: str, run_id: str, longest_gap: int | None = None) -> None:
        self.topic = topic
        self._run_id, self._longest_gap = run_id, longest_gap
        self.source = self.sender = ""
        self.open, self.ended, self.repeats, self.rejected = True, False, False, False
        self.received = self.lost = self.end = 0
        self.lossy = False
        self.lost_from: int | None = None
        self.held_from: int | None = None

    def expect(self, source: str, first: int | None = 0) -> None:
        """Accept blocks of one node only, starting at sample ``first``; None: at the first block that arrives."""
        self.source, self.open = source, first is None
        self.received = self.lost = 0
        self.end, self.ended, self.rejected = first or 0, False, False

    def reject(self, source: str, why: str) -> BadBlock:
        """Ignore the source's blocks from now on; return the error that names it."""
        self.rejected = True
        return BadBlock(self.topic, source, why)

    def admit(self, run_id: str, source: str) -> None:
        """Reject a block from outside the cell.

        Raises:
            ForeignMessage: the block has another run id, source or sender.
            BadBlock: the source's own block names another one.
        """
        if self._run_id and run_id != self._run_id:
            raise ForeignMessage(self.topic, source, run_id, f"expected run {self._run_id!r}")
        if source != self.source and self.source and self.sender == self.source:
            raise self.reject(self.source, f"{self.source} sends a block of {source[:LONGEST]!r}")
        if source != self.source and (self.source or self._run_id):
            raise ForeignMessage(self.topic, source, run_id, f"expected {self.source or 'nobody yet'}")
        check_sender(self.topic, source, run_id, self.sender)

    def missing(self, source: str, first: int, samples: int) -> int | None:
        """Return the number of samples missing before a block; None for a repeat, or if it is ignored.

        Raises:
            BadBlock: a gap or repeat that is not allowed.
        """
        if self.rejected:
            return None
        if self.repeats and first + samples <= self.end:
            return None
        if self.open:
            self.source, self.end, self.open = source, first, False
        missing = first - self.end
        if missing < 0 or (missing and (self._longest_gap is None or not (self.received or self.lossy))):
            what = f"{missing} samples are missing" if missing > 0 else "a block came twice"
            raise self.reject(source, f"{source} goes from sample {self.end} to {first}: {what}")
        if missing > (self._longest_gap or 0):
            raise self.reject(source, f"{source} jumps by {missing} samples")
        return missing

    def append(self, end: int, blocks: int = 1, *, last: bool) -> None:
        """Record the arrival of the next blocks, which end before sample ``end``."""
        self.end, self.ended = end, last
        self.received += blocks

    def hold(self, end: int) -> None:
        """Hold the newest sample of a lost source up to sample ``end``, where the run ends."""
        self.held_from = self.end
        self.end = max(end, self.held_from)
        self.open, self.ended, self.rejected = False, True, True

    def resume(self, source: str, end: int, received: int, *, ended: bool) -> None:
        """Resume from the state of another process; earlier blocks count as repeats."""
        self.source, self.end, self.received, self.ended = source, end, received, ended
        self.open, self.repeats = False, True
