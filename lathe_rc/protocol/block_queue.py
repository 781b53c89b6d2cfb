# SPDX-License-Identifier: Apache-2.0
"""Queue of the blocks of one topic that a node reads: checked, and in order."""

from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import astuple, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lathe_rc import messages
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.ports import signal_depth
from lathe_rc.blocks.wire import Decoder, NoBlockError
from lathe_rc.errors import LatheError
from lathe_rc.messages import Signals
from lathe_rc.protocol.block_order import BlockOrder
from lathe_rc.protocol.exchange import JoinedBlocks
from lathe_rc.protocol.messages import ForeignMessage

if TYPE_CHECKING:
    from lathe_rc.cell.parameters import NodeParameters

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
        run_end: returns the end of the run [sample]; None while it is not known.
    """

    def __init__(self, topic: str, msgtype: str, parameters: "NodeParameters", fields: list[str]) -> None:
        self._limit, self._size = 8 * signal_depth(parameters.window), parameters.block_size
        super().__init__(topic, parameters.run_id, None if parameters.window else self._limit * self._size)
        self.type, self.lossy = msgtype, not parameters.window and topic in parameters.volatile_inputs
        self._quiet = (0, 0.0)  # end of the newest block, and the monotonic time at which it was first seen
        self.blocks: deque[Block] = deque()
        self.inside = False
        self.run_end: Callable[[], int | None] = lambda: None
        self._decoder = Decoder(msgtype, fields, self.admit)
        self._decoder.prepare()
        self._step_ns, self._window = parameters.step_ns, parameters.window
        self._newest: Block | None = None

    def expect(self, source: str, first: int | None = 0) -> None:
        """Accept blocks of one source only (extends `BlockOrder`); queued blocks are dropped."""
        super().expect(source, first)
        self.blocks.clear()
        self._newest = None

    def add(self, data: bytes, sender: str = "") -> Block | None:
        """Check and queue an encoded block; return None for a repeat, or if a held block (see `hold`) replaces it.

        Args:
            data: the encoded block.
            sender: node that has published it, as DDS knows it; empty: not known.

        Raises:
            ForeignMessage: the block has another source, sender or run id, or the message is not a block.
            BadBlock: wrong step or length, time stamp that does not match the samples, numbers that are not finite,
                gap, repeat, wrong end of the run, or far more waiting blocks than the window allows.
            LatheError: far more waiting blocks in a free-running cell.
        """
        if self.rejected:
            return None
        self.sender = sender
        try:
            block = self._decoder.decode(data)
            self.admit(block.run_id, block.source)
            self._decoder.check()
        except NoBlockError as error:
            if sender and sender == self.source:
                raise self.reject(sender, f"{sender} sends bytes that are no block: {error}") from None
            raise ForeignMessage(self.topic, "", "", str(error)) from None
        except ValueError as error:
            raise self.reject(self.source, str(error)) from None
        return self._queue(block)

    def take(self, run: JoinedBlocks) -> None:
        """Queue blocks that a node of this process has handed over, which has checked their numbers.

        Raises:
            BadBlock, LatheError: see `add`.
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

    def accept(self, block: Block, sender: str = "") -> Block | None:
        """Check a decoded block of finite numbers and queue it (see `add`)."""
        self.sender = sender
        self.admit(block.run_id, block.source)
        return self._queue(block)

    def _queue(self, block: Block) -> Block | None:
        if self.rejected:
            return None
        if why := self._fault(block):
            raise self.reject(block.source, f"{block.source} {why}")
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

    def _fault(self, block: Block) -> str:
        """Return what is wrong with a block by itself; empty if nothing is."""
        if block.step_ns != self._step_ns:
            return f"has a step of {block.step_ns} ns; expected {self._step_ns}"
        if block.samples > self._size or (block.samples < self._size and not block.last):
            return f"sends {block.samples} samples in a block; expected {self._size}, fewer only at the end of the run"
        end = block.first_index + block.samples
        stamp = messages.START_NS + (end - 1) * self._step_ns
        if block.log_ns != stamp:
            return (
                f"stamps the block from sample {block.first_index} on with {block.log_ns} ns; expected {stamp} ns, the "
                "time of its last sample"
            )
        run_end = self.run_end()
        if run_end is not None and (block.last != (end >= run_end) or end > run_end):
            return f"{'ends the run at' if block.last else 'goes on after'} sample {end}; it ends at {run_end}"
        return ""

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
            why = f"{len(self.blocks)} blocks wait; the node cannot keep up"
            raise self.reject(block.source, why) if self._window else LatheError(f"{self.topic}: {why}")
        return block


def explain_losses(node: str, queues: Collection[BlockQueue]) -> str:
    """Say how many blocks of a free-running cell a node has lost, and from which sample on; empty if none."""
    lost = [f"{queue.lost} of {queue.topic} from sample {queue.lost_from} on" for queue in queues if queue.lost]
    total = sum(queue.lost for queue in queues)
    return f"{node}: lost {total} blocks of a free-running cell: {', '.join(lost)}" if lost else ""
