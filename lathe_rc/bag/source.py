# SPDX-License-Identifier: Apache-2.0
"""Opening bags, whoever made them: rosbag2 folders of any storage and compression that rosbags reads, or an MCAP file.

Nothing in a bag is trusted: what it says of sizes is checked before anything of that size is made.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import Qos
from rosbags.rosbag2 import Reader, ReaderError

from lathe_rc.bag.walk import walk
from lathe_rc.cell.wire import Block, Decoder
from lathe_rc.errors import InputError, LatheError

Message = tuple[str, int, bytes]  #: topic, log time [ns] and bytes

MOST_BYTES = 2**28  #: longest chunk or record that is read into memory [B]
MOST_TOPICS = 4096  #: topics of a bag
MOST_TEXT = 2**20  #: longest text in its metadata [B]
MOST_UNPACKED = 2**36  #: of a file that is compressed as a whole [B]

_PIECE = 2**20  # of a file that is unpacked [B]
_NEVER = 2**63  # log time after all others [ns]
_CHANNELS = 2**16  # numbers that a channel may have
_RECORD = struct.Struct("<BQ")  # opcode, length
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, CRC, length of the compression's name
_BROKEN = (
    ReaderError,
    OSError,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    struct.error,
    EOFError,
    zstandard.ZstdError,
)


@dataclass(frozen=True)
class Topic:
    """What a bag says of a topic.

    Attributes:
        type: message type.
        qos: offered by the publishers.
        count: messages.
    """

    type: str
    qos: tuple[Qos, ...]
    count: int


def unpack(compression: str, data: bytes | memoryview, size: int) -> bytes:
    """The records of a chunk; never more than it says.

    Raises:
        ValueError: it does not unpack to ``size`` bytes, or not at all.
    """
    if not 0 <= size <= MOST_BYTES:
        raise ValueError(f"{size} B when unpacked; allowed: up to {MOST_BYTES}")
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
        raise ValueError(_line(error)) from None
    if len(whole) != size:
        raise ValueError(f"it does not unpack to the {size} B that it says")
    return whole


def unpacked_size(data: bytes) -> int:
    """Size that a zstd frame says it has [B], from its first 18 bytes; -1 if it says nothing or is none."""
    try:
        return int(zstandard.frame_content_size(data))
    except zstandard.ZstdError:
        return -1


def unpack_file(path: Path) -> Iterator[bytes]:
    """The content of a file that is compressed as a whole, piece by piece.

    Raises:
        ValueError: it is longer than allowed.
        ZstdError: it is broken.
    """
    size = 0
    with path.open("rb") as stream:
        reader = zstandard.ZstdDecompressor().stream_reader(stream, read_across_frames=True)
        while piece := reader.read(_PIECE):
            size += len(piece)
            if size > MOST_UNPACKED:
                raise ValueError(f"{path.name} unpacks to more than {MOST_UNPACKED} B, which is not allowed")
            yield piece


def read_record(stream: BinaryIO, limit: int) -> tuple[int, bytes] | None:
    """Opcode and content of the next record of an MCAP file.

    Args:
        stream: at a record.
        limit: where the file or the chunk ends.

    Returns:
        None at the end.

    Raises:
        ValueError: it is cut off, or longer than allowed.
    """
    place = stream.tell()
    if place == limit:
        return None
    head = stream.read(_RECORD.size)
    opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, limit)
    if place + _RECORD.size + length > limit:
        raise ValueError(f"cut off at byte {place}")
    if length > MOST_BYTES:
        raise ValueError(f"record of {length} B at byte {place}; allowed: up to {MOST_BYTES}")
    return opcode, stream.read(length)


def read_chunk(content: bytes, place: int) -> bytes:
    """The records of a chunk that stands at byte ``place``.

    Raises:
        ValueError: it is broken.
    """
    try:
        _, _, size, crc, name = _CHUNK.unpack_from(content)
        start = _CHUNK.size + name
        name_of = content[_CHUNK.size : start].decode("utf-8", "replace")
        whole = unpack(name_of, memoryview(content)[start + 8 :], size)
    except (ValueError, struct.error) as error:
        raise ValueError(f"chunk at byte {place}: {_line(error)}") from None
    if crc and crc32(whole) != crc:
        raise ValueError(f"chunk at byte {place}: its checksum is wrong")
    return whole


def _damage(path: Path) -> str:
    """What is longer than it says or than is allowed in an MCAP file, and where; empty if nothing is."""
    limit = path.stat().st_size - len(MCAP0_MAGIC)
    with path.open("rb") as stream:
        if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            return f"{path.name}: not an MCAP file"
        place = stream.tell()
        try:
            while record := read_record(stream, limit):
                if record[0] == Opcode.CHUNK:
                    read_chunk(record[1], place)
                place = stream.tell()
        except ValueError as error:
            return f"{path.name}: {error}; lathe bag recover saves the rest"
    return ""


def _messages(whole: bytes, topics: Mapping[int, str]) -> list[tuple[str, int, bytes]]:
    """Topic, log time and bytes of the wanted messages among the records of a chunk, by log time."""
    found = walk(whole)
    wanted = np.zeros(_CHANNELS, dtype=bool)
    wanted[list(topics)] = True
    found = found[wanted[found[:, 0]]]
    if np.any(found[1:, 1] < found[:-1, 1]):
        found = found[np.argsort(found[:, 1], kind="stable")]
    return [(topics[channel], log_ns, whole[begin:end]) for channel, log_ns, begin, end in found.tolist()]


class Source:
    """A bag that is read; a context manager.

    Args:
        path: a rosbag2 folder or an MCAP file.

    Attributes:
        path: see above.
        topics: by name.
        about: texts that the bag says of itself, see docs/bags.md.
        first_ns, last_ns: smallest and largest log time; 0 and 0 if it is empty.

    Raises:
        InputError: not a bag, or one that cannot be whole.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        files = [path] if path.is_file() else sorted(path.glob("*.mcap"))
        try:
            self._check_metadata()
            for file in path.glob("*.zstd"):
                for _ in unpack_file(file):  # rosbags would write it out, however long it is
                    pass
            self._reader = Reader(path)
            self._reader.open()
        except _BROKEN as error:
            why = _line(error)
            for file in files:
                why = _damage(file) or why
            raise InputError(f"{path}: not a readable bag ({why})") from None
        self._find_chunks()
        # Chunks in order are checked as they are read, the others by rosbags, which trusts what they say of sizes.
        why = next((text for file in files if (text := _damage(file))), "") if not self._in_order else ""
        if why:
            self._reader.close()
            raise InputError(f"{path}: not a readable bag ({why})")
        try:
            self._read_head()
        except _BROKEN as error:
            self._reader.close()
            raise InputError(f"{path}: not a readable bag ({_line(error)})") from None

    def _check_metadata(self) -> None:
        metadata = self.path / "metadata.yaml"
        if metadata.exists() and metadata.stat().st_size > MOST_TEXT * 16:
            raise InputError(f"{metadata}: {metadata.stat().st_size} B; allowed: up to {MOST_TEXT * 16}")

    def _read_head(self) -> None:
        connections = self._reader.connections
        if len(connections) > MOST_TOPICS:
            raise InputError(f"{self.path}: {len(connections)} topics; allowed: up to {MOST_TOPICS}")
        self.topics: dict[str, Topic] = {}
        for connection in connections:
            ext: Any = connection.ext
            known = self.topics.get(connection.topic)
            count = connection.msgcount + (known.count if known else 0)
            self.topics[connection.topic] = Topic(connection.msgtype, tuple(ext.offered_qos_profiles), count)
        custom: Any = getattr(self._reader.storage.metadata, "custom", None) or {}
        texts = {key: text for key, text in custom.items() if isinstance(key, str) and isinstance(text, str)}
        self.about: Mapping[str, str] = {key[:256]: text[:MOST_TEXT] for key, text in texts.items()}
        empty = not self._reader.message_count
        self.first_ns = 0 if empty else self._reader.start_time
        self.last_ns = 0 if empty else self._reader.end_time - 1

    def __enter__(self) -> "Source":
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self._reader.close()

    def _find_chunks(self) -> None:
        """See whether the file is chunks one after the other, which are read faster than messages one by one."""
        whole: Any = self._reader.storage
        storages = getattr(whole, "storages", [whole])
        self._storage: Any = storages[0]
        chunks = getattr(self._storage, "chunks", [])
        followed = all(a.message_end_time <= b.message_start_time for a, b in pairwise(chunks))
        mode = self._reader.compression_mode
        self._in_order = len(storages) == 1 and bool(chunks) and followed and not mode
        self._packed = mode == "message"
        if self._packed:
            # rosbags would unpack each message to whatever size it says.
            whole.metadata = whole.metadata._replace(compression_mode=None)

    def _chunks(self, topics: Mapping[int, str], start_ns: int, stop_ns: int) -> Iterator[list[Message]]:
        """Messages of the wanted connections, chunk by chunk."""
        with Path(str(self._storage.path)).open("rb") as stream:
            for chunk in self._storage.chunks:
                if chunk.message_end_time < start_ns or chunk.message_start_time >= stop_ns:
                    continue
                if not topics.keys() & chunk.message_index_offsets.keys():
                    continue
                stream.seek(chunk.chunk_start_offset)
                record = read_record(stream, chunk.chunk_start_offset + chunk.chunk_length)
                found = _messages(read_chunk(record[1] if record else b"", chunk.chunk_start_offset), topics)
                if start_ns or stop_ns < _NEVER:
                    found = [message for message in found if start_ns <= message[1] < stop_ns]
                yield found

    def blocks(self, topic: str, *, start_ns: int | None = None) -> Iterator[Block]:
        """The blocks of a dense topic, from a log time [ns] on.

        Raises:
            InputError: see `messages`.
            LatheError: a block is broken.
        """
        decoder = Decoder(self.topics[topic].type)
        for _, _, data in self.messages({topic}, start_ns=start_ns):
            try:
                yield decoder.decode(data)
            except ValueError as error:
                raise LatheError(f"{self.path}: {topic}: {error}") from None

    def step_ns(self, topic: str) -> int:
        """Sampling step of a dense topic [ns], as its first block says; 0 if it has none.

        Raises:
            InputError: see `messages`.
            LatheError: the block is broken.
        """
        return next((block.step_ns for block in self.blocks(topic)), 0)

    def messages(
        self, topics: set[str] | None = None, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Message]:
        """Topic, log time [ns] and bytes of each message, in the order of log times; see `batches`."""
        return chain.from_iterable(self.batches(topics, start_ns=start_ns, stop_ns=stop_ns))

    def batches(
        self, topics: set[str] | None = None, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[list[Message]]:
        """Topic, log time [ns] and bytes of each message, in the order of log times, as many at a time as come handy.

        Args:
            topics: those wanted; None: all.
            start_ns: log times from this on [ns].
            stop_ns: log times before this [ns].

        Raises:
            InputError: the bag is broken where the next message should be.
        """
        wanted = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        try:
            if self._in_order:
                names = {c.topic for c in wanted}
                channels = {c.id: c.topic for c in self._storage.connections if c.topic in names}
                yield from self._chunks(channels, start_ns or 0, stop_ns or _NEVER)
                return
            for connection, log_ns, data in self._reader.messages(wanted, start=start_ns, stop=stop_ns):
                whole = unpack("zstd", data, unpacked_size(data[:18])) if self._packed else bytes(data)
                yield [(connection.topic, log_ns, whole)]
        except _BROKEN as error:
            raise InputError(f"{self.path}: broken ({_line(error)}); lathe bag check says more") from None


def _line(error: BaseException) -> str:
    """The first line of what a library says, and not much of it."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
