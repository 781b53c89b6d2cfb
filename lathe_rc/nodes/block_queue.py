# SPDX-License-Identifier: Apache-2.0
"""Queue of the blocks of one topic that a node reads: checked, and in order."""

from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import astuple, replace
from typing import Any

import numpy as np

from lathe_rc import messages
from lathe_rc.cell.block import Block
from lathe_rc.cell.host_topics import signal_depth
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.wire import Decoder, NoBlockError
from lathe_rc.errors import LatheError
from lathe_rc.messages import Signals
from lathe_rc.nodes.exchange import Run
from lathe_rc.protocol import BlockOrder, ForeignMessage

_QUIET = 1.0  # [s] after which the last blocks of a device that loses blocks count as lost


class BlockQueue(BlockOrder):
    """Queue of the blocks of one topic, checked and in order.

    Args:
        topic: fully qualified name.
        msgtype: message type.
        parameters: parameters of the reading node.
        fields: fields that the node reads.

    Attributes:
        blocks: checked blocks, not used yet.
        inside: the blocks come from a node of this process.
    """

    def __init__(self, topic: str, msgtype: str, parameters: NodeParameters, fields: list[str]) -> None:
        self._limit, self._size = 8 * signal_depth(parameters), parameters.block_size
        super().__init__(topic, parameters.run_id, None if parameters.window else self._limit * self._size)
        self.type, self.lossy = msgtype, not parameters.window and topic in parameters.volatile_inputs
        self._quiet = (0, 0.0)  # end of the newest block, and the monotonic time at which it was first seen
        self.blocks: deque[Block] = deque()
        self.inside = False
        self._decoder = Decoder(msgtype, fields, self.admit)
        self._decoder.prepare()
        self._step_ns = parameters.step_ns
        self._newest: Block | None = None

    def expect(self, source: str, first: int | None = 0) -> None:
        """Accept blocks of one source only (extends `BlockOrder`); queued blocks are dropped."""
        super().expect(source, first)
        self.blocks.clear()
        self._newest = None

    def add(self, data: bytes) -> Block | None:
        """Check and queue an encoded block; return None for a repeat, or if a held block (see `hold`) replaces it.

        Raises:
            ForeignMessage: the block has another source or run id, or the message is not a block.
            LatheError: wrong step, time stamp that does not match the samples, gap, repeat, arrays of different
                lengths, or far more waiting blocks than the window allows.
        """
        if self.held_from is not None:
            return None
        try:
            block = self._decoder.decode(data)
        except NoBlockError as error:
            raise ForeignMessage(self.topic, "", "", str(error)) from None
        except ValueError as error:
            raise LatheError(f"{self.topic}: {error}") from None
        return self.accept(block)

    def take(self, run: Run) -> None:
        """Queue blocks that a node of this process has handed over.

        Raises:
            LatheError: see `add`.
        """
        if self.open or run.block.first_index != self.end:
            for each in run.blocks(self._size):
                self.accept(each)
            return
        # The other checked fields cannot differ between blocks of a node in this process.
        self._append(run.block, len(run.companions))

    @property
    def message(self) -> bytes:
        """Return the last block taken by `add`, encoded as lathe_rc's own nodes do."""
        return self._decoder.message

    def accept(self, block: Block) -> Block | None:
        """Check a decoded block and queue it (see `add`)."""
        self.admit(block.run_id, block.source)
        if block.step_ns != self._step_ns:
            raise LatheError(f"{self.topic}: {block.source} has a step of {block.step_ns} ns; expected {self._step_ns}")
        if block.samples > self._size:
            raise LatheError(
                f"{self.topic}: {block.source} sends {block.samples} samples in a block; expected {self._size} at most"
            )
        stamp = messages.START_NS + (block.first_index + block.samples - 1) * self._step_ns
        if block.log_ns != stamp:
            raise LatheError(
                f"{self.topic}: {block.source} stamps the block from sample {block.first_index} on with "
                f"{block.log_ns} ns; expected {stamp} ns, the time of its last sample"
            )
        missing = self.missing(block.source, block.first_index, block.samples)
        if missing is None:
            return None
        if missing:  # a free-running cell holds the last sample, and counts the lost blocks
            self._lose(block.first_index)
        return self._append(block)

    def _lose(self, end: int, *, last: bool = False) -> None:
        """Hold and count the lost blocks of a free-running cell, which end before sample ``end``."""
        self.lost_from = self.end if self.lost_from is None else self.lost_from
        for held in self._held(self._last(), self.end, end):
            held.last = last and held.first_index + held.samples == end
            self.blocks.append(held)
            self.received += 1
            self.lost += 1

    def end_with(self, others: Collection["BlockQueue"], now: float) -> None:
        """Hold the newest sample of a quiet device that loses blocks up to the end of other topics; ``now`` [s]."""
        end = next((queue.end for queue in others if queue.ended), None)
        if end is None or not self.lossy or self.ended:
            return
        if self._quiet[0] != self.end or not self._quiet[1]:
            self._quiet = (self.end, now)
        elif now - self._quiet[1] > _QUIET:
            self._lose(end, last=True)
            self.hold(end)

    def until(self, end: int) -> Iterator[Block]:
        """Remove and yield the queued samples before ``end``."""
        while self.blocks and self.blocks[0].first_index < end:
            block = self.blocks.popleft()
            if (samples := end - block.first_index) < block.samples:
                self.blocks.appendleft(block.part(samples, block.samples))
                block = block.part(0, samples)
            yield block

    def pop(self, samples: int) -> Signals:
        """Remove and return the next samples of blocks of this process; no copy if they are one block."""
        if self.blocks[0].samples == samples:
            return self.blocks.popleft().signals
        pieces = [block.signals for block in self.until(self.blocks[0].first_index + samples)]
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}

    def state(self) -> list[Any]:
        """Return the state for a restart: next sample, number of blocks received, newest block and queued blocks."""
        newest = [] if self._newest is None else [self._newest]
        return [self.end, self.received, *([astuple(block) for block in part] for part in (newest, self.blocks))]

    def go_on(self, source: str, state: list[Any]) -> None:
        """Resume from the `state` of another process."""
        end, received, *parts = state
        newest, waiting = ([Block(*told) for told in part] for part in parts)
        self._newest, self.blocks = newest[0] if newest else None, deque(waiting)
        self.resume(source, end, received, ended=bool(newest) and newest[0].last)

    def hold_newest(self, end: int, newest: Block | None = None) -> None:
        """Hold the newest sample of a lost source up to the end of the run (see `hold`).

        Args:
            end: end of the run [sample].
            newest: the newest block with all its fields; None: only the fields that are read.
        """
        first = self.end
        self.hold(end)
        for block in self._held(newest or self._last(), first, end):
            block.last = block.first_index + block.samples == end
            self.blocks.append(block)
            self.received += 1

    def _last(self) -> Block:
        """Return the newest block; before the first, a block of one sample of zeros."""
        if self._newest is not None:
            return self._newest
        zeros = {name: np.zeros(1, dtype) for name, dtype in messages.sample_fields(self.type).items()}
        return Block(self._run_id, self.source, 0, self._step_ns, False, 0, 0, 0, zeros)  # noqa: FBT003

    def _held(self, newest: Block, first: int, end: int) -> Iterator[Block]:
        """Yield blocks that repeat the last sample of the newest block from ``first`` to ``end``."""
        for start in range(first, end, self._size):
            samples = min(self._size, end - start)
            yield replace(
                newest,
                first_index=start,
                samples=samples,
                log_ns=messages.START_NS + (start + samples - 1) * self._step_ns,
                signals={name: np.repeat(array[-1:], samples) for name, array in newest.signals.items()},
                whole=None,
                last=False,
            )

    def _append(self, block: Block, count: int = 1) -> Block:
        """Queue one piece that holds ``count`` blocks."""
        self.append(block.first_index + block.samples, count, last=block.last)
        self._newest = block
        self.blocks.append(block)
        if len(self.blocks) > self._limit:
            raise LatheError(f"{self.topic}: {len(self.blocks)} blocks wait; the node cannot keep up")
        return block


def explain_losses(node: str, queues: Collection[BlockQueue]) -> str:
    """Say how many blocks of a free-running cell a node has lost, and from which sample on; empty if none."""
    lost = [f"{queue.lost} of {queue.topic} from sample {queue.lost_from} on" for queue in queues if queue.lost]
    total = sum(queue.lost for queue in queues)
    return f"{node}: lost {total} blocks of a free-running cell: {', '.join(lost)}" if lost else ""
