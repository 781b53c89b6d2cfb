# SPDX-License-Identifier: Apache-2.0
"""Decompression of a bag's chunks, messages and files, limited to their stated size and to the allowed size."""

import struct
from collections.abc import Iterator
from pathlib import Path

import lz4.frame
import zstandard
from isal.isal_zlib import crc32

from lathe_rc.bag.reading.limits import EXPANSION, MOST_BYTES, MOST_SMALL, MOST_SMALL_MESSAGES, TooMuchError
from lathe_rc.errors import shown

_OVERHEAD = 2**16  # compression overhead beyond 1/128 of incompressible data [B]
_PIECE = 2**20  # size of the pieces in which a file is unpacked [B]
CHUNK = struct.Struct("<QQQII")  #: first and last time, size, CRC, length of the compression's name


class ReadingBudget:
    """Budget of bytes and messages that files may still yield (see `limits`).

    Args:
        size: size of the files [B].
    """

    def __init__(self, size: int) -> None:
        self._bytes = MOST_SMALL + EXPANSION * size
        self._messages = MOST_SMALL_MESSAGES + size

    def take(self, size: int, messages: int = 0) -> None:
        """Charge bytes, and the messages in them, to the budget.

        Raises:
            TooMuchError: the bytes or messages exceed the limit for files of this size.
        """
        self._bytes -= size
        self._messages -= messages
        if self._bytes < 0 or self._messages < 0:
            what = f"{EXPANSION} times its size" if self._bytes < 0 else "a message for each of its bytes"
            raise TooMuchError(f"it unpacks to more than {what}; no recording does")


def unpack(compression: str, data: bytes | memoryview, size: int) -> bytes:
    """Return the unpacked records of a chunk, never more than its stated size.

    Raises:
        ValueError: the data do not unpack to ``size`` bytes, or are damaged.
    """
    if not 0 <= size <= MOST_BYTES:
        raise ValueError(f"{size} B when unpacked; allowed: up to {MOST_BYTES}")
    if compression and len(data) > size + size // 128 + _OVERHEAD:  # a million empty frames would take a second to read
        raise ValueError(f"{len(data)} B that unpack to {size}; no compression does")
    try:
        if compression == "zstd":
            unpacker = zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True)
            whole = unpacker.read(size + 1)
        elif compression == "lz4":
            whole = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif compression == "":
            whole = bytes(data)
        else:
            raise ValueError(f"compression {compression[:64]!r} is not known; allowed: zstd, lz4, none")
    except (zstandard.ZstdError, RuntimeError) as error:
        raise ValueError(shown(error)) from None
    if len(whole) != size:
        raise ValueError(f"it does not unpack to the {size} B that it says")
    return whole


def unpacked_size(data: bytes) -> int:
    """Return the size stated in the first 18 bytes of a zstd frame [B]; -1 if there is no frame or no stated size."""
    try:
        return int(zstandard.frame_content_size(data))
    except zstandard.ZstdError:
        return -1


def is_packed(head: bytes) -> bool:
    """Return whether a file with this head is compressed as a whole, or begins with a skippable zstd frame."""
    return head.startswith(b"\x28\xb5\x2f\xfd") or (head[1:4] == b"\x2a\x4d\x18" and head[0] >> 4 == 5)


def unpack_file(path: Path) -> Iterator[bytes]:
    """Yield the content of a file that is compressed as a whole, in chunks.

    Raises:
        ValueError: the content is longer than allowed.
        ZstdError: the file is damaged.
    """
    budget = ReadingBudget(path.stat().st_size)
    with path.open("rb") as stream:
        reader = zstandard.ZstdDecompressor().stream_reader(stream, read_across_frames=True)
        while piece := reader.read(_PIECE):
            budget.take(len(piece))
            yield piece


def read_chunk(content: bytes, place: int) -> bytes:
    """Return the unpacked records of the chunk at byte ``place``.

    Raises:
        ValueError: the chunk is damaged.
    """
    try:
        # The checksum is that of the unpacked records; 0 means that there is none.
        _, _, size, crc, name = CHUNK.unpack_from(content)
        start = CHUNK.size + name
        name_of = content[CHUNK.size : start].decode("utf-8", "replace")
        whole = unpack(name_of, memoryview(content)[start + 8 :], size)
    except (ValueError, struct.error) as error:
        raise ValueError(f"chunk at byte {place}: {shown(error)}") from None
    if crc and crc32(whole) != crc:
        raise ValueError(f"chunk at byte {place}: its checksum is wrong")
    return whole
