# SPDX-License-Identifier: Apache-2.0
"""The messages among the records of an MCAP chunk, found by compiled code."""

from typing import Any

import numpy as np
import numpy.typing as npt

from lathe_rc.jit import kernel

_MESSAGE = 5  # opcode
_HEAD = 9  # bytes of opcode and length ahead of a record
_BEFORE = 22  # bytes of a message record ahead of its data: channel, sequence, log time, publish time

Bytes = npt.NDArray[np.uint8]
Places = npt.NDArray[np.uint64]


@kernel
def _little(data: Bytes, place: int, size: int) -> Any:
    """An unsigned number of ``size`` bytes; np.uint64."""
    value = np.uint64(0)
    for k in range(size):
        value |= np.uint64(data[place + k]) << np.uint64(8 * k)
    return value


@kernel
def _walk(data: Bytes, found: Places) -> int:
    """Fill channel, log time, begin and end of each message; returns their number, -1 if a record is broken."""
    place, count, size = 0, 0, data.size
    while place < size:
        if place + _HEAD > size:
            return -1
        length = _little(data, place + 1, 8)
        begin = place + _HEAD
        if length > np.uint64(size - begin):
            return -1
        place = begin + np.int64(length)
        if data[begin - _HEAD] == _MESSAGE:
            if length < _BEFORE:
                return -1
            if count < found.shape[0]:
                found[count, 0] = _little(data, begin, 2)
                found[count, 1] = _little(data, begin + 6, 8)
                found[count, 2] = begin + _BEFORE
                found[count, 3] = place
            count += 1
    return count


def walk(whole: bytes) -> Places:
    """Where the messages stand among the records of a chunk.

    Returns:
        Channel, log time [ns], begin and end of the data of each message, shape (messages, 4).

    Raises:
        ValueError: a record is longer than the chunk, or shorter than its own head.
    """
    data = np.frombuffer(whole, np.uint8)
    count = _walk(data, np.empty((0, 4), np.uint64))  # what a chunk says of itself is not believed: it is counted
    if count < 0:
        raise ValueError("a record is longer than its chunk, or too short")
    found = np.empty((count, 4), np.uint64)
    _walk(data, found)
    return found
