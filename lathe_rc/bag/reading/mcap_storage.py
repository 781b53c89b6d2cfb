# SPDX-License-Identifier: Apache-2.0
"""MCAP files, by their index where they have one, else by one pass through them.

Nothing is believed that a file says of itself: places are looked up where they must be, sizes are compared with the
file's, records are counted before there is memory for them.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Footer, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from lathe_rc.bag.reading.chunk_messages import Found, Places, walk, walk_part
from lathe_rc.bag.reading.limits import MOST_ANNOUNCED, MOST_BYTES, MOST_METADATA, MOST_TEXT, TooMuchError
from lathe_rc.bag.reading.precheck import read_record
from lathe_rc.bag.reading.storage import Batch, Channel, Span, Storage
from lathe_rc.bag.reading.unpacking import Budget, read_chunk
from lathe_rc.errors import shown

_MAGIC = len(MCAP0_MAGIC)
_RECORD = struct.Struct("<BQ")  # opcode, length
_FOOTER = 29 + _MAGIC  # [B] at the end of a file
_FOOTER_HEAD = _RECORD.pack(Opcode.FOOTER, _FOOTER - _MAGIC - _RECORD.size)
_CHECKED = 25  # [B] of the footer that the summary's checksum covers
_INDEX = struct.Struct("<QQQQI")  # of a chunk: first and last time, start, length, bytes of places by channel
_PLACE = np.dtype([("channel", "<u2"), ("place", "<u8")])
_NUMBERS = 2**16  # that a channel may have
_AT_ONCE = 2**14  # messages of a batch
_PART = 2**22  # of a file without index that is read at once [B]
_WRONG = (ValueError, struct.error, EndOfFile)  # what broken bytes lead to


@dataclass(frozen=True)
class _Records(Span):
    """Records of a file from byte ``start`` on: of a chunk, or a part without chunks."""

    path: Path
    start: int
    length: int
    in_chunk: bool

    def read(self, topics: Mapping[int, str], start_ns: int, stop_ns: int, budget: Budget) -> Iterator[Batch]:
        """See `Span`."""
        with self.path.open("rb") as stream:
            stream.seek(self.start)
            whole = self._chunk(stream) if self.in_chunk else stream.read(self.length)
        found = (walk if self.in_chunk else walk_part)(whole).messages
        budget.take(len(whole), len(found))
        wanted = np.zeros(_NUMBERS, dtype=bool)
        wanted[list(topics)] = True
        found = found[wanted[found[:, 0]]]
        if start_ns > self.first_ns or stop_ns <= self.last_ns:
            found = found[(found[:, 1] >= np.uint64(max(start_ns, 0))) & (found[:, 1] < stop_ns)]
        if np.any(found[1:, 1] < found[:-1, 1]):
            found = found[np.argsort(found[:, 1], kind="stable")]
        for first in range(0, len(found), _AT_ONCE):
            yield Batch(whole, topics, found[first : first + _AT_ONCE])

    def _chunk(self, stream: BinaryIO) -> bytes:
        record = read_record(stream, self.start + self.length)
        if record is None or record[0] != Opcode.CHUNK:
            raise ValueError(f"no chunk at byte {self.start}, where the index has one")
        whole = read_chunk(record[1], self.start)
        if len(whole) > self.size:
            raise ValueError(f"chunk at byte {self.start}: {len(whole)} B when unpacked, {self.size} by the index")
        return whole


def open_mcap(path: Path) -> Storage:
    """The channels and spans of an MCAP file.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as stream:
        by_index = _Mcap(path)
        try:
            if by_index.read_summary(stream):
                return by_index.storage
        except _WRONG as error:
            by_index.damage(error)
        scanned = _Mcap(path)
        scanned.storage.damage, scanned.storage.remarks = by_index.storage.damage, by_index.storage.remarks
        scanned.scan(stream)
        return scanned.storage


class _Mcap:
    """Fills the description of a file, from its summary or from all of it."""

    def __init__(self, path: Path) -> None:
        self._path, self._size = path, path.stat().st_size
        self.storage = Storage()
        self._budget = Budget(self._size)
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, ChannelRecord] = {}
        self._counts = np.zeros(_NUMBERS, np.int64)  # messages by channel
        self._announced: set[bytes] = set()
        self._announcements = self._described = 0

    def damage(self, what: object) -> None:
        """Take note of what cannot be read."""
        self.storage.damage.append(f"{self._path.name}: {shown(what)}")

    # ---- announcements ------------------------------------------------------------------------------

    def _announce(self, opcode: int, content: bytes) -> None:
        """Take a schema or channel; many writers repeat them in each chunk, all in the summary."""
        self._announcements += 1
        if self._announcements > MOST_ANNOUNCED:
            raise ValueError(f"more than {MOST_ANNOUNCED} schemas and channels")
        if (key := bytes([opcode]) + content) in self._announced:
            return
        self._announced.add(key)
        self._described += len(content)
        if self._described > MOST_METADATA:
            raise ValueError(f"more than {MOST_METADATA} B of schemas and channels")
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas.setdefault(schema.id, schema.name)
            return
        channel = ChannelRecord.read(stream)
        known = self._channels.setdefault(channel.id, channel)
        before, now = ((c.topic, c.schema_id, c.message_encoding) for c in (known, channel))
        if before != now:
            raise ValueError(f"channel {channel.id} is announced as {before[0]!r} and as {now[0]!r}")

    def _name_channels(self) -> None:
        """Give the channels their types, which may be announced behind them."""
        for number, channel in self._channels.items():
            kind = self._schemas.get(channel.schema_id, "") if channel.schema_id else ""
            named = Channel(channel.topic, kind, channel.message_encoding, count=int(self._counts[number]))
            self.storage.announce(number, named, channel.metadata.get("offered_qos_profiles", ""))
        self._counts[list(self._channels)] = 0
        if lost := int(self._counts.sum()):
            self.damage(f"{lost} messages of channels that it does not announce")

    # ---- index --------------------------------------------------------------------------------------

    def read_summary(self, stream: BinaryIO) -> bool:  # noqa: PLR0911 - one for each thing that may lack
        """Read the summary; whether it has all that is needed.

        Raises:
            ValueError: it has what cannot be right; mcap and struct raise others.
        """
        end = self._size - _FOOTER
        if stream.read(_MAGIC) != MCAP0_MAGIC or end < _MAGIC:
            return False
        read_record(stream, end)  # the header, which other readers need
        stream.seek(end)
        footer = stream.read(_FOOTER)
        if not footer.startswith(_FOOTER_HEAD) or not footer.endswith(MCAP0_MAGIC):
            return False
        ends = Footer.read(ReadDataStream(BytesIO(footer[_RECORD.size :])))
        start = ends.summary_start
        if not _MAGIC <= start < end:
            return False
        if ends.summary_crc and ends.summary_crc != _checksum(stream, start, end + _CHECKED):
            self.storage.remarks.append(f"{self._path.name}: the checksum of its summary is wrong: read without it")
            return False
        statistics, spans = self._indexed_records(stream, start, end), self.storage.spans
        if statistics is None or statistics.chunk_count != len(spans) or bool(statistics.message_count) != bool(spans):
            return False
        counts = statistics.channel_message_counts
        if not set(counts).union(*(span.channels for span in spans)) <= self._channels.keys():
            return False
        for number, count in counts.items():
            self._counts[number] = min(count, 2**62)
        self.storage.first_ns, self.storage.last_ns = statistics.message_start_time, statistics.message_end_time
        self._name_channels()
        return True

    def _indexed_records(self, stream: BinaryIO, start: int, end: int) -> Statistics | None:
        """Take the records of the summary, up to the offsets of their groups."""
        statistics, chunks = None, []
        stream.seek(start)
        while (record := read_record(stream, end)) and record[0] != Opcode.SUMMARY_OFFSET:
            opcode, content = record
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._announce(opcode, content)
            elif opcode == Opcode.STATISTICS:
                if len(content) > MOST_TEXT:
                    raise ValueError(f"statistics of {len(content)} B; allowed: up to {MOST_TEXT}")
                statistics = Statistics.read(ReadDataStream(BytesIO(content)))
            elif opcode == Opcode.CHUNK_INDEX:
                chunks.append(self._indexed(content, start))
        free = _MAGIC
        for chunk in sorted(chunks, key=lambda chunk: chunk.start):
            if chunk.start < free:
                raise ValueError(f"the index has two chunks at byte {chunk.start}")
            free = chunk.start + chunk.length
        self.storage.spans += chunks
        return statistics

    def _indexed(self, content: bytes, end: int) -> _Records:
        """A chunk by its entry in the index, which must be in the file before the summary."""
        first_ns, last_ns, start, length, places = _INDEX.unpack_from(content)
        if places > _NUMBERS * _PLACE.itemsize:
            raise ValueError(f"the index has a chunk of {places // _PLACE.itemsize} channels")
        (name,) = struct.unpack_from("<I", content, _INDEX.size + places + 8)
        packed, size = struct.unpack_from("<QQ", content, _INDEX.size + places + 12 + name)
        if start < _MAGIC or start + length > end or max(length, size) > MOST_BYTES or packed > length:
            raise ValueError(f"the index has a chunk of {length} B ({size} unpacked) at byte {start}: none can be")
        self._budget.take(size)
        channels = np.frombuffer(content, _PLACE, places // _PLACE.itemsize, _INDEX.size)["channel"]
        return _Records(first_ns, last_ns, size, frozenset(channels.tolist()), self._path, start, length, in_chunk=True)

    # ---- the whole file -----------------------------------------------------------------------------

    def scan(self, stream: BinaryIO) -> None:
        """Look at all records, up to what cannot be read; chunks that are broken are left out."""
        stream.seek(0)
        try:
            if stream.read(_MAGIC) != MCAP0_MAGIC:
                raise ValueError("not an MCAP file")
            for place, part, found in self._parts(stream):
                self._add(place, found.end, found.messages, in_chunk=False)
                if self._take(place, part, found.others):
                    break
        except _WRONG as error:
            self.damage(error)
        self.storage.first_ns = min((span.first_ns for span in self.storage.spans), default=0)
        self.storage.last_ns = max((span.last_ns for span in self.storage.spans), default=0)
        try:
            self._name_channels()
        except ValueError as error:
            self.damage(error)

    def _parts(self, stream: BinaryIO) -> Iterator[tuple[int, bytes, Found]]:
        """Place, bytes and records of each part."""
        place = _MAGIC
        while True:
            stream.seek(place)
            part = stream.read(_PART)
            found = walk_part(part)
            if not found.end:
                opcode, length = _RECORD.unpack_from(part) if len(part) >= _RECORD.size else (0, self._size)
                after = place + _RECORD.size + length
                if after > self._size:
                    self.damage(f"cut off at byte {place}")
                    return
                if opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
                    place = after
                    continue
                if length > MOST_BYTES:
                    raise ValueError(f"record of {length} B at byte {place}; allowed: up to {MOST_BYTES}")
                part += stream.read(after - place - len(part))
                found = walk_part(part)
            yield place, part, found
            place += found.end

    def _take(self, place: int, part: bytes, others: Places) -> bool:
        """Take the records of a part that are no messages; whether the file ends with one of them."""
        for opcode, begin, end in others.tolist():
            if opcode == Opcode.FOOTER:
                return True
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._announce(opcode, part[begin:end])
            elif opcode == Opcode.CHUNK:
                start = place + begin - _RECORD.size
                try:
                    whole = read_chunk(part[begin:end], start)
                    self._budget.take(len(whole))
                    found = walk(whole)
                except TooMuchError:
                    raise
                except ValueError as error:
                    self.damage(error)
                    continue
                if np.any(found.others[:, 0] == Opcode.CHUNK):
                    self.damage(f"chunk in the chunk at byte {start}")
                    continue
                for inner, first, last in found.others.tolist():
                    if inner in (Opcode.SCHEMA, Opcode.CHANNEL):
                        self._announce(inner, whole[first:last])
                self._add(start, end - begin + _RECORD.size, found.messages, in_chunk=True, size=len(whole))
        return False

    def _add(self, start: int, length: int, messages: Places, *, in_chunk: bool, size: int = 0) -> None:
        if not len(messages):
            return
        self._budget.take(0, len(messages))
        counts = np.bincount(messages[:, 0].astype(np.int64), minlength=_NUMBERS)
        self._counts += counts
        times = messages[:, 1]
        self.storage.spans.append(
            _Records(
                int(times.min()), int(times.max()), size or length, frozenset(np.flatnonzero(counts).tolist()),
                self._path, start, length, in_chunk=in_chunk,
            )
        )  # fmt: skip


def _checksum(stream: BinaryIO, start: int, end: int) -> int:
    """CRC-32 of a part of a file."""
    stream.seek(start)
    value = 0
    while (left := end - stream.tell()) > 0 and (piece := stream.read(min(left, _PART))):
        value = crc32(piece, value)
    return int(value)
