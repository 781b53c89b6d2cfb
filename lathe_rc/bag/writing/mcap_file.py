# SPDX-License-Identifier: Apache-2.0
"""Writer of MCAP files, chunk by chunk.

The records are those of the mcap library, but the library's own writer takes 14 µs per message, as long as a stage of
the cell takes per block: offline runs of piston and full_cell recorded with it ran at 0.3 times the speed. Here a
message costs a header and two appends, and a row of blocks costs one append; the index of a chunk is built when the
chunk is full, using the readers' compiled walk. The library's writer also keeps one object per chunk, however long the
run, and cannot flush.

Schemas and channels are repeated at the beginning of chunks 2, 3, 5, 9, 17 and so on, so that a damaged chunk does not
make other chunks unreadable, not even in a file that was cut off before its summary.
"""

import io
import os
import struct
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

import numpy as np
import zstandard
from isal.isal_zlib import crc32
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from lathe_rc.bag.reading import seal
from lathe_rc.bag.reading.chunk_messages import BEFORE_DATA, HEAD, walk

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
TIMES = (16, 8)  #: offsets of log time and publish time, backwards from a message's data [B]
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, length of the following pairs of log time and offset
_LENGTH = struct.Struct("<Q")
_FOOTER = struct.Struct("<BQQQ")
_ROOM, _ROOM_PER_CHUNK = 2**17, 1024  # disk space reserved for index and metadata [B]
_WAITING = 3  # largest number of chunks that the thread has to write
LEVEL = -20  #: zstd level, the quickest whose files are hardly larger (docs/bags.md)


class _Record(Protocol):
    """Record of the mcap library that can be serialized."""

    def write(self, stream: RecordBuilder, /) -> None:
        """Append the record to a stream."""


def message_head(channel: int, log_ns: int, length: int, publish_ns: int | None = None, sequence: int = 0) -> bytes:
    """Return the bytes that precede a message's ``length`` data bytes; publish time defaults to log time."""
    published = log_ns if publish_ns is None else publish_ns
    size = length + _MESSAGE.size - HEAD.size
    return _MESSAGE.pack(Opcode.MESSAGE, size, channel, sequence, log_ns, published)


def _record(opcode: int, *parts: bytes) -> bytes:
    """Return a serialized record with the given parts as its content."""
    return b"".join([HEAD.pack(opcode, sum(map(len, parts))), *parts])


def _encoded(*each: _Record) -> bytes:
    builder = RecordBuilder()
    for record in each:
        record.write(builder)
    return bytes(builder.end())


def schema_content(name: str, encoding: str, text: bytes) -> bytes:
    """Return the content of a schema record, with schema ID 0."""
    return _encoded(records.Schema(id=0, data=text, encoding=encoding, name=name))[HEAD.size :]


def channel_content(topic: str, encoding: str, metadata: Mapping[str, str]) -> bytes:
    """Return the content of a channel record, with channel ID 0."""
    channel = records.Channel(id=0, topic=topic, message_encoding=encoding, metadata=dict(metadata), schema_id=0)
    return _encoded(channel)[HEAD.size :]


class McapFile:
    """MCAP file that is open for writing.

    Args:
        path: path of the file; must not exist yet.
        chunk_size: size of the messages after which a chunk is written [B].
        compress: whether to compress the chunks with zstd.
        profile: profile of the file.

    Attributes:
        counts: number of messages by channel in the chunks written so far.
        first_ns, last_ns: smallest and largest log time so far [ns]; None before the first message.
        checksum: checksum of the bytes written so far; of a finished file, of its data.

    Raises:
        OSError: the file cannot be created; in any later method, writing to the disk fails.
    """

    def __init__(self, path: Path, *, chunk_size: int, compress: bool, profile: str = "ros2") -> None:
        # Unbuffered, so that flush() hands all bytes to the operating system and `_put` can truncate a failed write.
        self._stream = path.open("xb", buffering=0)
        self._chunk_size, self._compress, self._profile = chunk_size, compress, profile
        self._compressor = zstandard.ZstdCompressor(level=LEVEL) if compress else None
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._chunks = 0
        self._chunk_index = bytearray()  # encoded: for a long run, objects would take ten times as much memory
        self._metadata: list[records.MetadataIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self.counts: dict[int, int] = {}
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        # The messages of the chunk, followed by leftover bytes of earlier chunks. The thread compresses and writes it
        # without the interpreter lock, while others are filled: the engine fills several at once, then computes.
        self._chunk, self._spare = io.BytesIO(), list[io.BytesIO]()
        self._thread = ThreadPoolExecutor(1)
        self._at_work: deque[Future[io.BytesIO]] = deque()
        self._begun = 0  # number of chunks handed to the thread
        self._begin_chunk()
        self._offset = self.checksum = 0
        self._reserve = path.with_name(f"{path.name}.reserve")
        self._kept = self._described = 0
        self._refused: Exception | None = None
        self._put(MCAP0_MAGIC + _encoded(records.Header(profile, seal.LIBRARY)))

    def successor(self, path: Path) -> "McapFile":
        """Return a new file for further messages, with the same settings, schemas and channel numbers.

        Raises:
            OSError: the file cannot be created.
        """
        made = McapFile(path, chunk_size=self._chunk_size, compress=self._compress, profile=self._profile)
        made._schemas, made._channels = self._schemas.copy(), self._channels.copy()
        made.counts = dict.fromkeys(self.counts, 0)
        for record in (*made._schemas, *made._channels):
            made._append(record)
        return made

    def _begin_chunk(self) -> None:
        self._chunk.seek(0)  # its memory is reused
        self._size, self._filled = 0, False
        before = self._begun
        if before and before & (before - 1) == 0:  # see the module docstring
            self._size += self._chunk.write(b"".join([*self._schemas, *self._channels]))

    def _put(self, *parts: bytes | memoryview) -> None:
        """Append bytes to the file; after a failed write, truncate the file so that no partial record remains."""
        try:
            for part in parts:
                rest = memoryview(part)
                while rest:
                    rest = rest[self._stream.write(rest) :]
        except OSError:
            self._stream.truncate(self._offset)
            self._stream.seek(self._offset)
            raise
        for part in parts:
            self._offset += len(part)
            self.checksum = crc32(part, self.checksum)

    def _keep_room(self) -> None:
        """Reserve disk space for completing the file, so that a full disk cannot make the file unreadable."""
        needed = _ROOM + _ROOM_PER_CHUNK * (self._chunks + 1) + 4 * self._described
        if needed > self._kept:
            needed += _ROOM
            with self._reserve.open("ab") as stream:
                # A sparse file would not reserve any disk blocks.
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(stream.fileno(), 0, needed)
                else:  # macOS, Windows
                    stream.write(bytes(needed - self._kept))
            self._kept = needed

    def free_room(self) -> None:
        """Release the disk space reserved for completing the file."""
        self._reserve.unlink(missing_ok=True)

    def add_schema(self, content: bytes) -> int:
        """Add a schema with the content of its record, except for the ID, and return its ID in this file."""
        number = len(self._schemas) + 1
        self._schemas.append(_record(Opcode.SCHEMA, struct.pack("<H", number), content[2:]))
        self._append(self._schemas[-1])
        return number

    def add_channel(self, content: bytes, schema: int) -> int:
        """Add a channel.

        Args:
            content: content of the channel record, except for the IDs.
            schema: ID of the channel's schema in this file; 0: no schema.

        Returns:
            ID of the channel in this file.
        """
        number = len(self._channels) + 1
        self._channels.append(_record(Opcode.CHANNEL, struct.pack("<HH", number, schema), content[4:]))
        self.counts[number] = 0
        self._append(self._channels[-1])
        return number

    def _append(self, data: bytes) -> None:
        self._described += len(data)
        self._size += self._chunk.write(data)

    def add_message(
        self, channel: int, log_ns: int, data: bytes | memoryview, *, publish_ns: int | None = None, sequence: int = 0
    ) -> None:
        """Append a message; ``publish_ns`` defaults to the log time."""
        self._size += self._chunk.write(message_head(channel, log_ns, len(data), publish_ns, sequence))
        self._size += self._chunk.write(data)
        self._filled = True
        if self._size > self._chunk_size:
            self._hand_over()

    def add_rows(self, size: int, data: bytes | memoryview) -> None:
        """Append rows of ``size`` bytes, each consisting of complete message records."""
        rest = memoryview(data)
        while rest:
            # Add complete rows, at least one, until the chunk exceeds its size.
            fill = (max(self._chunk_size - self._size, 0) // size + 1) * size
            self._size += self._chunk.write(rest[:fill])
            self._filled, rest = True, rest[fill:]
            if self._size > self._chunk_size:
                self._hand_over()

    def flush(self) -> None:
        """Hand all messages added so far to the operating system as a chunk; they are lost if the write fails."""
        if self._filled:
            self._hand_over()
        self._wait()

    def _hand_over(self) -> None:
        """Let the thread write the chunk, and begin another one."""
        try:
            self._wait(_WAITING - 1)
            full, self._chunk = self._chunk, self._spare.pop() if self._spare else io.BytesIO()
            self._at_work.append(self._thread.submit(self._write, full, self._size))
            self._begun += 1
        finally:
            self._begin_chunk()

    def _wait(self, left: int = 0) -> None:
        """Wait until the thread has at most ``left`` chunks to write."""
        try:
            while len(self._at_work) > left:
                buffer = self._at_work[0].result()  # an interrupt here leaves the chunk among those to wait for
                self._at_work.popleft()
                self._spare.append(buffer)
        except Exception:
            self._at_work.clear()  # the thread refuses them
            raise

    def _write(self, buffer: io.BytesIO, size: int) -> io.BytesIO:
        """Write a chunk, as the thread, and return its buffer."""
        if self._refused:
            raise self._refused  # nothing is recorded after a gap
        try:
            self._write_chunk(buffer, size)
        except Exception as error:
            self._refused = error
            raise
        return buffer

    def _write_chunk(self, buffer: io.BytesIO, size: int) -> None:
        self._keep_room()
        with buffer.getbuffer() as memory, memory[:size] as whole:
            # Copies: views of the chunk, kept alive by the traceback of a full-disk error, would lock its buffer.
            messages = walk(whole.toreadonly()).messages
            crc = crc32(whole)
            data = self._compressor.compress(whole) if self._compressor else bytes(whole)
        first, last = int(messages[:, 1].min()), int(messages[:, 1].max())
        compression = "zstd" if self._compressor else ""
        # The record ends with the compressed bytes, which are not copied.
        empty = _encoded(records.Chunk(compression, b"", last, first, crc, size))[HEAD.size : -_LENGTH.size]
        head = HEAD.pack(Opcode.CHUNK, len(empty) + _LENGTH.size + len(data)) + empty + _LENGTH.pack(len(data))
        counts = np.bincount(messages[:, 0].astype(np.int64))
        by_channel = messages[np.argsort(messages[:, 0], kind="stable"), 1:3]
        by_channel[:, 1] -= np.uint64(BEFORE_DATA)
        start, length = self._offset, len(head) + len(data)
        index: list[bytes] = []
        offsets, done, end = {}, 0, start + length
        for channel in np.flatnonzero(counts).tolist():
            text = by_channel[done : (done := done + counts[channel])].tobytes()
            index += _INDEX.pack(Opcode.MESSAGE_INDEX, len(text) + _INDEX.size - HEAD.size, channel, len(text)), text
            offsets[channel] = end
            end += _INDEX.size + len(text)
        self._put(head, data, b"".join(index))
        for channel in offsets:
            self.counts[channel] += int(counts[channel])
        self.first_ns = first if self.first_ns is None else min(first, self.first_ns)
        self.last_ns = last if self.last_ns is None else max(last, self.last_ns)
        self._chunks += 1
        self._chunk_index += _encoded(
            records.ChunkIndex(
                message_start_time=first,
                message_end_time=last,
                chunk_start_offset=start,
                chunk_length=length,
                message_index_offsets=offsets,
                message_index_length=end - start - length,
                compression=compression,
                compressed_size=len(data),
                uncompressed_size=size,
            )
        )

    def add_metadata(self, name: str, values: Mapping[str, str], *, last: bool = False) -> None:
        """Append strings as a metadata record; with ``last``, use the disk space reserved for completing the file.

        The second and further records of a name are numbered, because some readers find a record by its name.
        """
        before = sum(each.name.partition(" ")[0] == name for each in self._metadata)
        name = f"{name} {before + 1}" if before else name
        content = _encoded(records.Metadata(name=name, metadata=dict(values)))[HEAD.size :]
        self.copy_record(Opcode.METADATA, content, last=last)

    def copy_record(self, opcode: int, content: bytes, *, last: bool = False) -> None:
        """Append an attachment or metadata record copied from another file; for ``last``, see `add_metadata`."""
        self.flush()
        record, stream = _record(opcode, content), ReadDataStream(io.BytesIO(content))
        if opcode == Opcode.METADATA and not last:  # metadata.yaml may repeat it, twice as long due to escapes
            self._described += len(record)
            self._keep_room()
        place = {"offset": self._offset, "length": len(record)}
        if opcode == Opcode.METADATA:
            name = records.Metadata.read(stream).name
            self._put(record)
            self._metadata.append(records.MetadataIndex(name=name, **place))
        else:
            found = records.Attachment.read(stream)
            place |= {"log_time": found.log_time, "create_time": found.create_time, "data_size": len(found.data)}
            self._put(record)
            self._attachments.append(records.AttachmentIndex(name=found.name, media_type=found.media_type, **place))

    def finish(self) -> None:
        """Write the summary and close the file."""
        try:
            self.flush()
            of_data = self.checksum
            self._put(_encoded(records.DataEnd(of_data)))
            self._put(self._summary())
            self.checksum = of_data
        finally:
            self.abort()

    def abort(self) -> None:
        """Close the file without writing a summary."""
        self._thread.shutdown()
        self.free_room()
        self._stream.close()

    def _summary(self) -> bytes:
        statistics = records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            # Channels without a message are left out, as readers that count messages expect.
            channel_message_counts={channel: count for channel, count in self.counts.items() if count},
            chunk_count=self._chunks,
            message_count=sum(self.counts.values()),
            metadata_count=len(self._metadata),
            message_start_time=self.first_ns or 0,
            message_end_time=self.last_ns or 0,
            schema_count=len(self._schemas),
        )
        groups = {
            Opcode.SCHEMA: b"".join(self._schemas),
            Opcode.CHANNEL: b"".join(self._channels),
            Opcode.STATISTICS: _encoded(statistics),
            Opcode.CHUNK_INDEX: bytes(self._chunk_index),
            Opcode.ATTACHMENT_INDEX: _encoded(*self._attachments),
            Opcode.METADATA_INDEX: _encoded(*self._metadata),
        }
        start = place = self._offset
        offsets = []
        for opcode, data in groups.items():
            if not data:
                continue
            offsets.append(records.SummaryOffset(group_opcode=opcode, group_start=place, group_length=len(data)))
            place += len(data)
        summary = b"".join(groups.values()) + _encoded(*offsets)
        crc = crc32(_FOOTER.pack(Opcode.FOOTER, 20, start, place), crc32(summary))
        footer = records.Footer(summary_start=start, summary_offset_start=place, summary_crc=crc)
        return summary + _encoded(footer) + MCAP0_MAGIC
