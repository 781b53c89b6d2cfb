# SPDX-License-Identifier: Apache-2.0
"""Signal topics over DDS: quality of service, and the check of every block that comes in."""

import importlib
import importlib.util
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from lathe_rc import messages
from lathe_rc.cell.block import Block
from lathe_rc.cell.host_topics import signal_depth
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.wire import Decoder, NoBlockError
from lathe_rc.errors import LatheError
from lathe_rc.nodes.exchange import Run
from lathe_rc.nodes.refused_messages import ForeignMessage


def message_class(msgtype: str) -> Any:
    """The rclpy class of a message type. A bag or a topic names it: no package is imported but those of interfaces.

    Raises:
        ImportError: there is no such package of interfaces here.
        AttributeError: it has no such message.
        ValueError: that is no name of a type.
    """
    package, kind, name = msgtype.split("/")
    if package != messages.PACKAGE and not _holds_interfaces(package):
        raise ImportError(f"{package} is no package of interfaces here")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def _holds_interfaces(package: str) -> bool:
    """Tell whether a package was made of message definitions: only those have this type support beside them.

    ROS's own index of resources is not asked: in an environment of wheels nothing says where it is.
    """
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    folders = (spec.submodule_search_locations or ()) if spec else ()
    return any(any(Path(folder).glob(f"{package}_s__rosidl_typesupport_c*")) for folder in folders)


def signal_qos(parameters: NodeParameters, topic: str = "") -> QoSProfile:
    """Reliable, and deep enough for all blocks in flight, which a late match then still receives.

    A reader of a cell with a window keeps all until it takes them: a flood from outside would push out what belongs.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if topic and parameters.window else HistoryPolicy.KEEP_LAST,
        depth=signal_depth(parameters),
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE
        if topic in parameters.volatile_inputs
        else DurabilityPolicy.TRANSIENT_LOCAL,
    )


def latched_qos(depth: int = 0) -> QoSProfile:
    """Reliable; the newest message of each publisher reaches those who come late.

    Without a depth, for readers: all are kept until they are taken, a flood from outside pushes none out.
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST if depth else HistoryPolicy.KEEP_ALL,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


class BlockQueue:
    """Blocks of one topic, checked and in order.

    Args:
        topic: fully qualified name.
        msgtype: message type.
        parameters: of the node that reads.
        fields: those that it reads.

    Attributes:
        blocks: checked blocks that wait to be used.
        source: the only node whose blocks are accepted; empty: until somebody is expected, nobody if there is a run,
            and the first to come if there is none.
        inside: its blocks are handed over in this process.
        received: blocks so far, those that were lost included.
        end: index after the newest sample, with which the next block has to begin unless it is `open`.
        open: it is not known yet with which sample its blocks begin.
        ended: the last block has come.
        lost: blocks that never came; always 0 unless the cell is free-running.
        repeats: blocks may come twice: their source may be another process that goes on in its place.
        held_from: sample from which on its newest sample is held, since its source is lost; None: it is not.
    """

    def __init__(self, topic: str, msgtype: str, parameters: NodeParameters, fields: list[str]) -> None:
        self.topic, self.type = topic, msgtype
        self.blocks: deque[Block] = deque()
        self.source = ""
        self.open, self.inside, self.ended = True, False, False
        self.received = self.lost = self.end = 0
        self.held_from: int | None = None
        self._decoder = Decoder(msgtype, fields, self._admit)
        self._decoder.prepare()
        self._run_id, self._step_ns, self._size = parameters.run_id, parameters.step_ns, parameters.block_size
        self._free_running = not parameters.window
        self.repeats = False
        self._limit = 8 * signal_depth(parameters)
        self._newest: Block | None = None

    def expect(self, source: str, first: int | None = 0) -> None:
        """Accept blocks of this node alone, from a sample on; None: whichever comes first."""
        self.source, self.open = source, first is None
        self.blocks.clear()
        self.received = self.lost = 0
        self.end, self.ended, self._newest = first or 0, False, None

    def _admit(self, run_id: str, source: str) -> None:
        """Refuse who does not belong."""
        if self._run_id and run_id != self._run_id:
            raise ForeignMessage(self.topic, source, run_id, f"expected run {self._run_id!r}")
        if source != self.source and (self.source or self._run_id):
            raise ForeignMessage(self.topic, source, run_id, f"expected {self.source or 'nobody yet'}")

    def add(self, data: bytes) -> Block | None:
        """Check a block and queue it; None if another already stands for it, see `hold`, or if it is a repeat.

        Raises:
            ForeignMessage: another source or run, or no block at all.
            LatheError: another step, another time than that of its samples, a gap, a repeat, arrays of different
                lengths, or far more blocks waiting than the window allows.
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
        """Queue blocks that were handed over in this process.

        Raises:
            LatheError: see `add`.
        """
        if self.open or run.block.first_index != self.end:
            for each in run.blocks(self._size):
                self.accept(each)
            return
        # What else is checked cannot differ from block to block of a node in this process.
        self._append(run.block, len(run.companions))

    @property
    def message(self) -> bytes:
        """The block that `add` has taken last, as our nodes encode it."""
        return self._decoder.message

    def accept(self, block: Block) -> Block | None:
        """Check a block and queue it; see `add`."""
        self._admit(block.run_id, block.source)
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
        if self.open:
            self.source, self.end, self.open = block.source, block.first_index, False
        if self.repeats and block.first_index + block.samples <= self.end:
            return None
        if block.first_index != self.end:
            self._gap(block, self.end)
        return self._append(block)

    def until(self, end: int) -> Iterator[Block]:
        """Take out what waits of the samples before ``end``."""
        while self.blocks and self.blocks[0].first_index < end:
            block = self.blocks.popleft()
            if (samples := end - block.first_index) < block.samples:
                self.blocks.appendleft(block.part(samples, block.samples))
                block = block.part(0, samples)
            yield block

    def state(self) -> tuple[int, int, list[Block], Block | None]:
        """The state that another process needs to go on: next sample, blocks received, waiting and newest."""
        return self.end, self.received, list(self.blocks), self._newest

    def resume(self, source: str, state: tuple[int, int, list[Block], Block | None]) -> None:
        """Go on from the state of another process; what comes from before it is a repeat."""
        self.end, self.received, waiting, self._newest = state
        self.open, self.blocks = False, deque(waiting)
        self.ended = self._newest is not None and self._newest.last
        self.source, self.repeats = source, True

    def hold(self, end: int, newest: Block | None = None) -> None:
        """Let the newest sample stand for those of a source that is lost, up to sample ``end``, where the run ends.

        Args:
            end: of the run.
            newest: the newest block with all its fields; None: with those that are read.
        """
        newest = newest or self._newest or self._zero()
        self.held_from = self.end
        for block in self._held(newest, self.held_from, end):
            block.last = block.first_index + block.samples == end
            self.blocks.append(block)
            self.received += 1
        self.end = max(end, self.held_from)
        self.open, self.ended = False, True

    def _zero(self) -> Block:
        """A block that stands for those before the first."""
        zeros = {name: np.zeros(1, dtype) for name, dtype in messages.sample_fields(self.type).items()}
        return Block(self._run_id, self.source, 0, self._step_ns, False, 0, 0, 0, zeros)  # noqa: FBT003

    def _held(self, newest: Block, first: int, end: int) -> Iterator[Block]:
        """Blocks with the last sample of another."""
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
        """Queue a block, or so many in one piece."""
        self.end = block.first_index + block.samples
        self._newest, self.ended = block, block.last
        self.received += count
        self.blocks.append(block)
        if len(self.blocks) > self._limit:
            raise LatheError(f"{self.topic}: {len(self.blocks)} blocks wait; the node cannot keep up")
        return block

    def _gap(self, block: Block, expected: int) -> None:
        """Refuse a gap or a repeat; a free-running cell goes on over a gap with the last sample held, and counts."""
        missing = block.first_index - expected
        if missing < 0 or not self._free_running or self._newest is None:
            what = f"{missing} samples are missing" if missing > 0 else "a block came twice"
            raise LatheError(f"{self.topic}: {block.source} goes from sample {expected} to {block.first_index}: {what}")
        if missing > self._limit * self._size:
            raise LatheError(f"{self.topic}: {block.source} jumps by {missing} samples")
        for held in self._held(self._newest, expected, block.first_index):
            self.blocks.append(held)
            self.received += 1
            self.lost += 1
