# SPDX-License-Identifier: Apache-2.0
"""Signal topics over DDS: quality of service, and the check of every block that comes in."""

from collections import deque
from typing import Any

import numpy as np
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from lathe_rc.bag.record import SPARE_DEPTH
from lathe_rc.cell import messages
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.errors import LatheError


def signal_qos(parameters: NodeParameters, topic: str = "") -> QoSProfile:
    """Reliable, and deep enough for all blocks in flight, which a late match then still receives."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=parameters.window + SPARE_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE
        if topic in parameters.volatile_inputs
        else DurabilityPolicy.TRANSIENT_LOCAL,
    )


def latched_qos(depth: int) -> QoSProfile:
    """Reliable; the newest message of each publisher reaches those who come late."""
    return QoSProfile(
        depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
    )


class BlockQueue:
    """Blocks of one topic, checked and in order.

    Args:
        topic: fully qualified name.
        msgtype: message type.
        parameters: of the node that reads.

    Attributes:
        blocks: checked messages that wait to be used.
        source: the only node whose blocks are accepted; empty until the first block of a node alone.
        lost: blocks that never came; always 0 unless the cell is free-running.
    """

    def __init__(self, topic: str, msgtype: str, parameters: NodeParameters) -> None:
        self.topic, self.type = topic, msgtype
        self.blocks: deque[Any] = deque()
        self.source = ""
        self.lost = 0
        self._parameters = parameters
        self._expected: int | None = None
        self._newest: Any = None
        self._limit = 8 * (parameters.window + SPARE_DEPTH)

    def expect(self, source: str) -> None:
        """Accept blocks of this node alone, from sample 0 on."""
        self.source, self._expected = source, 0

    def add(self, data: bytes) -> Any:
        """Check a block and queue it.

        Returns:
            The message.

        Raises:
            LatheError: a stranger, another run or step, a gap, a repeat, arrays of different lengths, or far more
                blocks waiting than the window allows.
        """
        message = messages.decode(self.type, data)
        info = message.block
        own = self._parameters
        lengths = {getattr(message, name).size for name in messages.sample_fields(self.type)}
        if own.run_id and info.run_id != own.run_id:
            raise LatheError(f"{self.topic}: block of run {info.run_id!r} from {info.source}; expected {own.run_id!r}")
        if self.source and info.source != self.source:
            raise LatheError(f"{self.topic}: block from {info.source}; expected {self.source}")
        if info.step_ns != own.step_ns:
            raise LatheError(f"{self.topic}: {info.source} has a step of {info.step_ns} ns; expected {own.step_ns}")
        if len(lengths) != 1 or 0 in lengths:
            raise LatheError(f"{self.topic}: {info.source} sends arrays of {sorted(lengths)} samples in one block")
        if self._expected is None:
            self.source, self._expected = info.source, info.first_index
        if info.first_index != self._expected and self._newest is None:
            raise LatheError(f"{self.topic}: {info.source} begins at sample {info.first_index}; expected 0")
        if info.first_index != self._expected:
            self._gap(info)
        (samples,) = lengths
        self._expected = info.first_index + samples
        self._newest = message
        self.blocks.append(message)
        if len(self.blocks) > self._limit:
            raise LatheError(f"{self.topic}: {len(self.blocks)} blocks wait; the node cannot keep up")
        return message

    def _gap(self, info: messages.BlockInfo) -> None:
        """Refuse a gap or a repeat; a free-running cell goes on over a gap with the last sample held, and counts."""
        assert self._expected is not None
        missing = info.first_index - self._expected
        if missing < 0 or self._parameters.window:
            what = f"{missing} samples are missing" if missing > 0 else "a block came twice"
            raise LatheError(
                f"{self.topic}: {info.source} goes from sample {self._expected} to {info.first_index}: {what}"
            )
        if missing > self._limit * self._parameters.block_size:
            raise LatheError(f"{self.topic}: {info.source} jumps by {missing} samples")
        for first in range(self._expected, info.first_index, self._parameters.block_size):
            samples = min(self._parameters.block_size, info.first_index - first)
            held = {
                name: np.repeat(getattr(self._newest, name)[-1:], samples)
                for name in messages.sample_fields(self.type)
            }
            own = messages.block_info(
                info.run_id, info.source, first, info.step_ns, last=False, companions=info.companions
            )
            self.blocks.append(messages.block_message(self.type, own, held))
            self.lost += 1
