# SPDX-License-Identifier: Apache-2.0
"""The records of a piece of an MCAP file that matter to a reader, found by compiled code."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.bag.reading.limits import MOST_ANNOUNCED, TooMuchError
from lathe_rc.jit import kernel

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 2, 3, 4, 5, 6, 15  # opcodes
_HEAD = 9  # bytes of opcode and length ahead of a record
_BEFORE = 22  # bytes of a message record ahead of its data: channel, sequence, log time, publish time

Bytes = npt.NDArray[np.uint8]
Places = npt.NDArray[np.uint64]


class Found(NamedTuple):
    """The records of a piece.

    Attributes:
        messages: channel, log time [ns], begin and end of the data of each message, shape (messages, 4).
        others: opcode, begin and end of the content of each schema, channel, chunk and end mark, shape (others, 3).
        end: where the last record that is whole ends.
    """

    messages: Places
    others: Places
    end: int


@kernel
def _little(data: Bytes, place: int, size: int) -> Any:
    """An unsigned number of ``size`` bytes; np.uint64."""
    value = np.uint64(0)
    for k in range(size):
        value |= np.uint64(data[place + k]) << np.uint64(8 * k)
    return value


@kernel
def _walk(data: Bytes, messages: Places, others: Places) -> tuple[int, int, int]:
    """Fill both tables as far as they go; returns the numbers of messages, or -1, and of others, and the end."""
    place, count, further, size = 0, 0, 0, data.size
    while place + _HEAD <= size:
        length = _little(data, place + 1, 8)
        begin = place + _HEAD
        if length > np.uint64(size - begin):
            break
        opcode, place = data[place], begin + np.int64(length)
        if opcode == _MESSAGE:
            if length < _BEFORE:
                return -1, further, begin - _HEAD
            if count < messages.shape[0]:
                messages[count, 0] = _little(data, begin, 2)
                messages[count, 1] = _little(data, begin + 6, 8)
                messages[count, 2] = begin + _BEFORE
                messages[count, 3] = place
            count += 1
        elif _FOOTER <= opcode <= _CHUNK or opcode == _DATA_END:
            if further < others.shape[0]:
                others[further, 0] = opcode
                others[further, 1] = begin
                others[further, 2] = place
            further += 1
    return count, further, place


def walk_part(part: bytes) -> Found:
    """The records of a part of a file, of which the last may be cut off.

    Raises:
        ValueError: a message is shorter than its own head.
        TooMuchError: there are more schemas and channels than a whole file may have.
    """
    data = np.frombuffer(part, np.uint8)
    # What a chunk says of itself is not believed: its records are counted.
    count, further, end = _walk(data, np.empty((0, 4), np.uint64), np.empty((0, 3), np.uint64))
    if count < 0:
        raise ValueError("a message is shorter than its head")
    if further > MOST_ANNOUNCED:
        raise TooMuchError(f"more than {MOST_ANNOUNCED} schemas and channels")
    messages, others = np.empty((count, 4), np.uint64), np.empty((further, 3), np.uint64)
    _walk(data, messages, others)
    return Found(messages, others, end)


def walk(whole: bytes) -> Found:
    """The records of a chunk.

    Raises:
        ValueError: a record is longer than the chunk, or shorter than its own head.
    """
    found = walk_part(whole)
    if found.end != len(whole):
        raise ValueError("a record is longer than its chunk")
    return found
