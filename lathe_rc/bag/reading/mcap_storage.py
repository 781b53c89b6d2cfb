# SPDX-License-Identifier: Apache-2.0
"""Reader of MCAP files, using the index if there is one, otherwise a walk through the whole file.

Nothing that a file states about itself is trusted: offsets are verified, sizes are compared with the size of the file,
and records are counted before memory is allocated for them.
"""

import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import MetadataIndex, Schema, Statistics

from lathe_rc.bag.reading import seal
from lathe_rc.bag.reading.chunk_messages import HEAD, Places, walk_whole
from lathe_rc.bag.reading.limits import MOST_ANNOUNCED, MOST_BYTES, MOST_METADATA, TooMuchError
from lathe_rc.bag.reading.sound_records import MAGIC, Record, SoundRecords, parsed
from lathe_rc.bag.reading.storage import Batch, Channel, Span, Storage
from lathe_rc.bag.reading.unpacking import ReadingBudget, read_chunk
from lathe_rc.errors import shown

_INDEX = struct.Struct("<QQQQI")  # chunk entry: first and last time, start, length, size of the offset map
_PLACE = np.dtype([("channel", "<u2"), ("place", "<u8")])
_NUMBERS = 2**16  # number of possible channel IDs
_AT_ONCE = 2**14  # messages per batch
_WRONG = (ValueError, struct.error, EndOfFile)  # exceptions caused by damaged bytes


@dataclass(frozen=True)
class _Records(Span):
    """Records of a file from byte ``start`` on: a chunk, or a section without chunks."""

    path: Path
    start: int
    length: int
    in_chunk: bool

    def read(self, topics: Mapping[int, str], start_ns: int, stop_ns: int, budget: ReadingBudget) -> Iterator[Batch]:
        """Yield the messages in batches, in order of log time."""
        with self.path.open("rb") as stream:
            stream.seek(self.start)
            whole = stream.read(self.length)
        whole = self._unpacked(whole) if self.in_chunk else whole
        found = walk_whole(whole).messages
        budget.take(len(whole), len(found))
        wanted = np.zeros(_NUMBERS, dtype=bool)
        wanted[list(topics)] = True
        found = found[wanted[found[:, 0]]]
        if start_ns > self.first_ns or stop_ns <= self.last_ns:
            found = found[(found[:, 1] >= np.uint64(max(start_ns, 0))) & (found[:, 1] < stop_ns)]
        # The sort is stable, so messages with the same time keep their order in the file.
        if np.any(found[1:, 1] < found[:-1, 1]):
            found = found[np.argsort(found[:, 1], kind="stable")]
        for first in range(0, len(found), _AT_ONCE):
            yield Batch(whole, topics, found[first : first + _AT_ONCE])

    def _unpacked(self, record: bytes) -> bytes:
        opcode, length = HEAD.unpack_from(record) if len(record) >= HEAD.size else (0, 0)
        if opcode != Opcode.CHUNK or HEAD.size + length > len(record):
            raise ValueError(f"no chunk at byte {self.start}, where the index has one")
        whole = read_chunk(record[HEAD.size : HEAD.size + length], self.start)
        if len(whole) > self.size:
            raise ValueError(f"chunk at byte {self.start}: {len(whole)} B when unpacked, {self.size} by the index")
        return whole


def open_mcap(path: Path) -> Storage:
    """Open an MCAP file and return its channels and spans.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as stream:
        by_index = _Mcap(path)
        try:
            if by_index.read_summary(stream):
                return by_index.storage
        except _WRONG as error:
            by_index.damage(error)
        scanned = _Mcap(path)
        scanned.storage = Storage(damage=by_index.storage.damage, remarks=by_index.storage.remarks)
        scanned.scan(stream)
        return scanned.storage


class _Mcap:
    """Builder of a file's description, from the summary or from a walk through the whole file."""

    def __init__(self, path: Path) -> None:
        self._path, self._size = path, path.stat().st_size
        self.storage = Storage()
        self._budget = ReadingBudget(self._size)
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, ChannelRecord] = {}
        self._channel_sets: dict[bytes, frozenset[int]] = {}
        self._counts = np.zeros(_NUMBERS, np.int64)  # messages by channel
        self._announced: set[bytes] = set()
        self._announcements = self._described = 0
        self._metadata_at: list[int] = []  # offset of the record that may contain the seal, if there is one

    def damage(self, what: object) -> None:
        """Record an unreadable part."""
        self.storage.damage.append(f"{self._path.name}: {shown(what)}")

    # ---- announcements ------------------------------------------------------------------------------

    def _announce(self, opcode: int, content: bytes) -> None:
        """Add a schema or channel record; many writers repeat these in each chunk, and all writers in the summary."""
        self._announcements += 1
        if self._announcements > MOST_ANNOUNCED:
            raise ValueError(f"more than {MOST_ANNOUNCED} schemas and channels")
        if (key := bytes([opcode]) + content) in self._announced:
            return
        self._announced.add(key)
        self._described += len(content)
        if self._described > MOST_METADATA:
            raise ValueError(f"more than {MOST_METADATA} B of schemas and channels")
        if opcode == Opcode.SCHEMA:
            schema = parsed(Schema, content)
            self._schemas.setdefault(schema.id, schema.name)
            return
        channel = parsed(ChannelRecord, content)
        known = self._channels.setdefault(channel.id, channel)
        before, now = ((c.topic, c.schema_id, c.message_encoding) for c in (known, channel))
        if before != now:
            raise ValueError(f"channel {channel.id} is announced as {before[0]!r} and as {now[0]!r}")

    def _name_channels(self) -> None:
        """Assign message types to the channels; a file may announce a type after its channel."""
        for number, channel in self._channels.items():
            kind = self._schemas.get(channel.schema_id, "") if channel.schema_id else ""
            named = Channel(channel.topic, kind, channel.message_encoding, count=int(self._counts[number]))
            self.storage.announce(number, named, channel.metadata.get("offered_qos_profiles", ""))
        self._counts[list(self._channels)] = 0
        if lost := int(self._counts.sum()):
            self.damage(f"{lost} messages of channels that it does not announce")

    # ---- index --------------------------------------------------------------------------------------

    def read_summary(self, stream: BinaryIO) -> bool:
        """Read the summary and return whether it has everything that is needed.

        Raises:
            ValueError: the summary has impossible values; mcap and struct may raise other exceptions.
        """
        records = SoundRecords(stream, self._size, lambda why, _lost: self.damage(why))
        if not records.find_summary():
            if records.summary_wrong:
                self.storage.remarks.append(f"{self._path.name}: the checksum of its summary is wrong: read without it")
            return False
        stream.seek(MAGIC)
        if HEAD.unpack(stream.read(HEAD.size))[1] > records.summary_start:
            raise ValueError(f"cut off at byte {MAGIC}")  # the header is needed by other readers
        statistics, spans = self._indexed_records(records), self.storage.spans
        if statistics is None or statistics.chunk_count != len(spans) or bool(statistics.message_count) != bool(spans):
            return False
        counts = statistics.channel_message_counts
        if self.storage.damage or not set(counts).union(*(span.channels for span in spans)) <= self._channels.keys():
            return False
        for number, count in counts.items():
            self._counts[number] = min(count, 2**62)
        self.storage.first_ns, self.storage.last_ns = statistics.message_start_time, statistics.message_end_time
        self._name_channels()
        self._find_seal(records)
        return True

    def _find_seal(self, records: SoundRecords) -> None:
        for place in (MAGIC, *self._metadata_at, records.data_end):
            with suppress(ValueError):  # a file whose record is broken has no seal that holds
                record = records.at(place)
                self.storage.sealed.take(record.opcode, record.content)

    def _indexed_records(self, records: SoundRecords) -> Statistics | None:
        """Read the records of the summary; return its statistics, or None if it has none."""
        statistics, chunks = None, []
        for record in records.summary():
            if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._announce(record.opcode, record.content)
            elif record.opcode == Opcode.STATISTICS:
                statistics = parsed(Statistics, record.content)
            elif record.opcode == Opcode.CHUNK_INDEX:
                chunks.append(self._indexed(record.content, records.summary_start))
            elif record.opcode == Opcode.METADATA_INDEX and (told := parsed(MetadataIndex, record.content)):
                self._metadata_at = [told.offset] if told.name == seal.RECORD else self._metadata_at
        # Overlapping chunks would be unpacked once per index entry: a small file could cause hours of work.
        free = MAGIC
        for chunk in sorted(chunks, key=lambda chunk: chunk.start):
            if chunk.start < free:
                raise ValueError(f"the index has two chunks at byte {chunk.start}")
            free = chunk.start + chunk.length
        self.storage.spans += chunks
        return statistics

    def _indexed(self, content: bytes, end: int) -> _Records:
        """Return the chunk described by an index entry; it must lie before the summary."""
        first_ns, last_ns, start, length, places = _INDEX.unpack_from(content)
        if places > _NUMBERS * _PLACE.itemsize:
            raise ValueError(f"the index has a chunk of {places // _PLACE.itemsize} channels")
        (name,) = struct.unpack_from("<I", content, _INDEX.size + places + 8)
        packed, size = struct.unpack_from("<QQ", content, _INDEX.size + places + 12 + name)
        if start < MAGIC or start + length > end or max(length, size) > MOST_BYTES or packed > length:
            raise ValueError(f"the index has a chunk of {length} B ({size} unpacked) at byte {start}: none can be")
        self._budget.take(size)
        found = np.frombuffer(content, _PLACE, places // _PLACE.itemsize, _INDEX.size)["channel"]
        # Hours of a cell have tens of thousands of chunks, nearly all of the same channels: one set serves them all.
        channels = self._channel_sets.setdefault(found.tobytes(), frozenset(found.tolist()))
        return _Records(first_ns, last_ns, size, channels, self._path, start, length, in_chunk=True)

    # ---- whole file ----------------------------------------------------------------------------------

    def scan(self, stream: BinaryIO) -> None:
        """Walk through all records; damage after the end of the data section is ignored, as it affects no message."""

        def told(why: str, _lost: int) -> None:
            if not records.ended:
                self.damage(why)

        records = SoundRecords(stream, self._size, told)
        try:
            for record in records:
                if record.opcode == Opcode.FOOTER:
                    break
                self._take(record)
        except _WRONG as error:
            self.damage(error)
        self.storage.first_ns = min((span.first_ns for span in self.storage.spans), default=0)
        self.storage.last_ns = max((span.last_ns for span in self.storage.spans), default=0)
        try:
            self._name_channels()
        except ValueError as error:
            self.damage(error)

    def _take(self, record: Record) -> None:
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._announce(record.opcode, record.content)
        if record.opcode not in (Opcode.CHUNK, Opcode.MESSAGE):
            self.storage.sealed.take(record.opcode, record.content)
            return
        try:
            found = walk_whole(record.content)
        except TooMuchError:
            raise
        except ValueError as error:
            self.damage(f"chunk at byte {record.place}: {error}")
            return
        if np.any(found.others[:, 0] == Opcode.CHUNK):
            self.damage(f"chunk in the chunk at byte {record.place}")
            return
        for opcode, begin, end in found.others.tolist():
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._announce(opcode, record.content[begin:end])
        self._add(record, found.messages)

    def _add(self, record: Record, messages: Places) -> None:
        if not len(messages):
            return
        self._budget.take(0, len(messages))
        counts = np.bincount(messages[:, 0].astype(np.int64), minlength=_NUMBERS)
        self._counts += counts
        times, channels = messages[:, 1], frozenset(np.flatnonzero(counts).tolist())
        in_chunk, length = record.opcode == Opcode.CHUNK, record.end - record.place
        first_ns, last_ns, size = int(times.min()), int(times.max()), len(record.content)
        span = _Records(first_ns, last_ns, size, channels, self._path, record.place, length, in_chunk=in_chunk)
        self.storage.spans.append(span)
