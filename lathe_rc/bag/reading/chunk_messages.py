# SPDX-License-Identifier: Apache-2.0
"""Compiled walk over the records in a section of an MCAP file, for the readers and for the writer's index."""

import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.bag.reading.limits import MOST_ANNOUNCED, TooMuchError
from lathe_rc.jit import kernel

HEAD = struct.Struct("<BQ")  #: opcode and length at the head of a record
_HEAD = HEAD.size
_MESSAGE = 5  # opcode
_BEFORE = 22  # length of the message fields before the data [B]: channel, sequence, log time, publish time
BEFORE_DATA = _HEAD + _BEFORE  #: length of a message record before its data, including opcode and length [B]

Bytes = npt.NDArray[np.uint8]
Places = npt.NDArray[np.uint64]


class FoundRecords(NamedTuple):
    """Records located in a section of a file.

    Attributes:
        messages: channel, log time [ns], and start and end of the data of each message, shape (messages, 4).
        others: opcode, and start and end of the content of each other record, shape (others, 3).
        end: offset of the end of the last complete record.
    """

    messages: Places
    others: Places
    end: int


@kernel
def _little(data: Bytes, place: int, size: int) -> Any:
    """Return an unsigned little-endian number of ``size`` bytes, as np.uint64."""
    value = np.uint64(0)
    for k in range(size):
        value |= np.uint64(data[place + k]) << np.uint64(8 * k)
    return value


@kernel
def _walk(data: Bytes, messages: Places, others: Places, alone: bool) -> tuple[int, int, int]:  # noqa: FBT001 - a kernel
    """Fill both tables up to their capacity; return the numbers of messages and other records, and the end."""
    # All comparisons use the remaining length, never a sum that includes a length: one near 2**64 would overflow.
    place, count, further, size = 0, 0, 0, data.size
    while place + _HEAD <= size:
        length = _little(data, place + 1, 8)
        begin = place + _HEAD
        if length > np.uint64(size - begin):
            break
        end = begin + np.int64(length)
        if data[place] == _MESSAGE:
            if length < _BEFORE:
                break
            if count < messages.shape[0]:
                messages[count, 0] = _little(data, begin, 2)
                messages[count, 1] = _little(data, begin + 6, 8)
                messages[count, 2] = begin + _BEFORE
                messages[count, 3] = end
            count += 1
        elif alone:
            break
        else:
            if further < others.shape[0]:
                others[further, 0] = data[place]
                others[further, 1] = begin
                others[further, 2] = end
            further += 1
        place = end
    return count, further, place


def walk(data: bytes | memoryview, *, alone: bool = False) -> FoundRecords:
    """Locate the records of a section; with ``alone``, only up to the first record that is not a message.

    Raises:
        TooMuchError: the section has more records other than messages than a whole file may have.
    """
    array = np.frombuffer(data, np.uint8)
    # Sizes stated in the section are not trusted: its records are counted before memory is allocated for them.
    count, further, _ = _walk(array, np.empty((0, 4), np.uint64), np.empty((0, 3), np.uint64), alone)
    if further > MOST_ANNOUNCED:
        raise TooMuchError(f"more than {MOST_ANNOUNCED} schemas and channels")
    messages, others = np.empty((count, 4), np.uint64), np.empty((further, 3), np.uint64)
    return FoundRecords(messages, others, _walk(array, messages, others, alone)[2])


def walk_whole(data: bytes) -> FoundRecords:
    """Locate the records of a chunk or of a section of a file; all of them must be complete.

    Raises:
        ValueError: a record is longer than the remaining bytes, or a message is shorter than its head.
    """
    found = walk(data)
    if found.end != len(data):
        raise ValueError("a record is longer than its chunk, or a message is shorter than its head")
    return found
