# SPDX-License-Identifier: Apache-2.0
"""Sound records of an MCAP file, found again behind each damaged place.

A record is sound if its checksum holds. Most records have none: then it must be what the mcap library would write of
its content, to the byte, which a wrong length never is. Messages outside of chunks have neither; a record must follow
them, and there must be no chunk in the file: an index of one whose kind is damaged would pass for a message.
"""

import re
import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from isal.isal_zlib import crc32
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from lathe_rc.bag.reading.limits import MOST_BYTES
from lathe_rc.bag.reading.unpacking import Budget, read_chunk

Told = Callable[[str, int], None]  #: a damage, and the bytes in which messages may have stood

_HEAD = struct.Struct("<BQ")  # opcode and length ahead of a record
_BEFORE_DATA = 22  # bytes of a message record ahead of its data
_INDEX = struct.Struct("<HI")  # channel, length of the pairs of time and place
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, CRC, length of the compression's name
_COMPRESSIONS = (b"", b"lz4", b"zstd")
_FOOTER, _DATA_END = 29, 13  # [B]
_PRIVATE = 0x80  # opcodes from here on are anybody's
_PLAIN: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.ATTACHMENT: records.Attachment,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.STATISTICS: records.Statistics,
    Opcode.METADATA: records.Metadata,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.DATA_END: records.DataEnd,
}
# Where a record may begin: any opcode with a length below 4 GiB, or a chunk of whatever length.
_BEGINS = re.compile(rb"(?=[\x01-\x0f].{4}\0{4}|\x06.{28}\0{4}.{4}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd))", re.DOTALL)
_LONGEST_BEGIN = 49  # of that [B]
_WINDOW = 2**20  # of a file that is searched at once [B]
_PAGE = 2**12  # that is searched; a place where a record may begin takes as long [B]
_PAGES = 2**18  # that may be searched in vain, and as many more as the file has


class Record(NamedTuple):
    """A sound record.

    Attributes:
        place: of its first byte in the file.
        opcode: its kind.
        content: its bytes; of a chunk its records, unpacked.
        checked: whether a checksum vouches for the content.
    """

    place: int
    opcode: int
    content: bytes
    checked: bool


class _UnsoundError(ValueError):
    """A record that is not sound.

    Attributes:
        chunk: whether it is a chunk.
        end: where the next record stands all the same, if that is beyond doubt.
    """

    def __init__(self, why: str, *, chunk: bool = False, end: int | None = None) -> None:
        super().__init__(why)
        self.chunk, self.end = chunk, end


class _Effort:
    """Work that may still be spent on a file: bytes to unpack, and pages to search for records."""

    def __init__(self, size: int) -> None:
        self.budget = Budget(size)
        self.left = _PAGES + 2 * (size // _PAGE)

    def spend(self, size: int) -> bool:
        """Count ``size`` bytes and a little more; whether that was still allowed."""
        self.left -= 1 + size // _PAGE
        return self.left >= 0


class SoundRecords:
    """The sound records of a file; may be iterated over again and again.

    Args:
        stream: of the file; at any place.
        size: of the file [B].
        told: gets each damage; may be exchanged between two iterations.
        effort: what may be spent, given for records of a chunk; None: in proportion to the size.

    Attributes:
        ended: whether the newest iteration has come behind the end of all data.
        data_wrong, summary_wrong: whether the checksum of all data, or of the summary, does not hold.
    """

    def __init__(self, stream: BinaryIO, size: int, told: Told, effort: _Effort | None = None) -> None:
        self._stream, self._size, self.told = stream, size, told
        self._effort = effort or _Effort(size)
        self._last = Opcode.FOOTER if effort is None else 0
        self._chunked = False
        self._checked_from = self._summary = size
        self.ended = self.data_wrong = self.summary_wrong = False

    def inside(self, record: Record) -> Iterator[tuple[int, bytes]]:
        """Opcode and content of each record of a chunk, or of the record itself if it is none."""
        if record.opcode != Opcode.CHUNK:
            yield record.opcode, record.content
            return
        if not record.checked:
            sound = SoundRecords(BytesIO(record.content), len(record.content), self.told, self._effort)
            yield from ((inner.opcode, inner.content) for inner in sound)
            return
        whole, place = record.content, 0
        while place < len(whole):
            begin = place + _HEAD.size
            opcode, length = _HEAD.unpack_from(whole, place) if begin <= len(whole) else (0, len(whole))
            if begin + length > len(whole):
                self.told(f"chunk at byte {record.place}: a record is longer than the chunk", len(whole) - place)
                return
            place = begin + length
            yield opcode, whole[begin:place]

    def check_sums(self) -> None:
        """Look at the checksums of data and summary, which stand at the end of a file that is complete."""
        try:
            place = self._size - len(MCAP0_MAGIC) - _FOOTER
            footer = self._sound(place)[0]
            start, _, crc = struct.unpack("<QQI", footer.content) if footer.opcode == Opcode.FOOTER else (0, 0, 0)
            end = (start or place) - _DATA_END
            data_end = self._sound(end)[0]
        except ValueError:
            return  # the walk tells it
        self._summary = start or self._size
        if start and crc:
            if self._sum(start, place + _FOOTER - 4) == crc:
                self._checked_from = start
            else:
                self.summary_wrong = True
                self.told("the checksum of the summary is wrong", 0)
        (crc,) = struct.unpack("<I", data_end.content) if data_end.opcode == Opcode.DATA_END else (0,)
        if crc and self._sum(0, end) != crc:
            self.data_wrong = True
            self.told("the checksum of the data section is wrong", 0)

    def _sum(self, start: int, stop: int) -> int:
        crc = 0
        for place in range(start, stop, _WINDOW):
            crc = crc32(self._at(place, min(_WINDOW, stop - place)), crc)
        return crc

    def summary(self) -> Iterator[Record]:
        """The sound records of the summary, once `check_sums` has found it."""
        return self._walk(self._summary) if self._summary < self._size else iter(())

    def __iter__(self) -> Iterator[Record]:
        """The sound records in the order of the file."""
        return self._walk(0)

    def _walk(self, place: int) -> Iterator[Record]:
        opcode, before = 0, place
        self.ended = False
        if self._last:
            self._effort = _Effort(self._size)
        while place < self._size:
            if self._at(place, len(MCAP0_MAGIC)) == MCAP0_MAGIC:
                place += len(MCAP0_MAGIC)
                continue
            try:
                record, end = self._sound(place)
            except _UnsoundError as error:
                self._chunked |= error.chunk
                end = error.end or self._search(before + 1)
                self.told(str(error), 0 if self.ended else max(0, end - place))
                place = before = end
                continue
            opcode = record.opcode
            self._chunked |= opcode in (Opcode.CHUNK, Opcode.CHUNK_INDEX)
            self.ended = opcode == Opcode.DATA_END or (self.ended and opcode not in (Opcode.CHUNK, Opcode.MESSAGE))
            # A record may lack bytes at its end and have taken them from the next one: that is looked for within it.
            before = end if record.checked or opcode == Opcode.MESSAGE else place
            yield record
            place = end
        if self._last and opcode != self._last:
            self.told("ends without a footer", 0)

    def _at(self, place: int, length: int) -> bytes:
        self._stream.seek(max(place, 0))  # a file may be shorter than its last records
        return self._stream.read(length)

    def _sound(self, place: int) -> tuple[Record, int]:
        """The record at a place, and the place behind it.

        Raises:
            _UnsoundError: it is not sound.
        """
        head = self._at(place, _HEAD.size)
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, self._size)
        end = place + _HEAD.size + length
        if opcode == Opcode.CHUNK:
            return self._chunk(place, end)
        if end > self._size:
            raise _UnsoundError(f"cut off at byte {place}")
        if length > MOST_BYTES:
            raise _UnsoundError(f"record of {length} B at byte {place}; allowed: up to {MOST_BYTES}")
        content = self._at(place + _HEAD.size, length)
        if opcode == Opcode.MESSAGE:
            sound = length >= _BEFORE_DATA and not self._chunked and self._begins(end)
        elif opcode >= _PRIVATE:
            sound = self._begins(end)
        elif opcode == Opcode.MESSAGE_INDEX:
            pairs = _INDEX.unpack_from(content)[1] if length >= _INDEX.size else -1
            sound = pairs == length - _INDEX.size and pairs % 16 == 0
        else:
            sound = _as_written(opcode, content)
        if opcode == Opcode.FOOTER:
            sound = sound and self._at(end, len(MCAP0_MAGIC)) == MCAP0_MAGIC
        if not sound:
            raise _UnsoundError(f"record of kind {opcode} at byte {place} is broken")
        checked = place >= self._checked_from or (opcode == Opcode.ATTACHMENT and any(content[-4:]))
        return Record(place, opcode, content, checked), end

    def _begins(self, place: int) -> bool:
        """Whether the file ends at a place, or a record may begin."""
        head = self._at(place, _HEAD.size)
        if place == self._size or head == MCAP0_MAGIC:
            return True
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
        return bool(0 < opcode <= Opcode.DATA_END and place + _HEAD.size + length <= self._size)

    def _chunk(self, place: int, end: int) -> tuple[Record, int]:
        """A chunk says its length twice: one of them may be wrong."""
        begin = place + _HEAD.size
        head = self._at(begin, _CHUNK.size + 4 + 8)
        if len(head) < _CHUNK.size + 8:
            raise _UnsoundError(f"cut off at byte {place}")
        _, _, size, crc, length = _CHUNK.unpack_from(head)
        if head[_CHUNK.size : _CHUNK.size + length] not in _COMPRESSIONS:
            raise _UnsoundError(f"chunk at byte {place}: its compression is none of zstd, lz4, none")
        start = begin + _CHUNK.size + length + 8
        said = start + int.from_bytes(self._at(start - 8, 8), "little")
        try:
            self._effort.budget.take(min(size, MOST_BYTES))
        except ValueError as error:
            raise _UnsoundError(f"chunk at byte {place}: {error}", chunk=True) from None
        why = f"cut off at byte {place}"
        for stop in dict.fromkeys((said, end)):
            if stop > self._size:
                continue
            if stop - begin > MOST_BYTES:
                why = f"record of {stop - begin} B at byte {place}; allowed: up to {MOST_BYTES}"
                continue
            try:
                whole = read_chunk(self._at(begin, stop - begin), place)
            except ValueError as error:
                why = str(error)
                continue
            if said != end:
                self.told(f"chunk at byte {place}: a length of it is wrong", 0)
            return Record(place, Opcode.CHUNK, whole, checked=bool(crc)), stop
        raise _UnsoundError(why, chunk=True, end=end if said == end <= self._size else None)

    def _search(self, place: int) -> int:
        """Where the next sound record stands; the size of the file if there is none."""
        length = _PAGE
        while place < self._size and self._effort.left >= 0:
            window = self._at(place, length + _LONGEST_BEGIN)
            for begin in _BEGINS.finditer(window):
                if begin.start() >= length:
                    break
                if not self._effort.spend(0):
                    return self._size
                if self._is_anchor(place + begin.start()):
                    return place + begin.start()
            self._effort.spend(len(window))
            place, length = place + length, min(2 * length, _WINDOW)
        return self._size

    def _is_anchor(self, place: int) -> bool:
        """Whether a sound record stands there, and another one behind it if no checksum vouches for it."""
        try:
            record, end = self._sound(place)
            if not record.checked and end < self._size and self._at(end, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                self._sound(end)
        except _UnsoundError:
            return False
        return True


def _as_written(opcode: int, content: bytes) -> bool:
    """Whether a record is what the mcap library would write; an attachment may lack its checksum."""
    if opcode not in _PLAIN:
        return False
    builder = RecordBuilder()
    try:
        _PLAIN[opcode].read(ReadDataStream(BytesIO(content))).write(builder)
    except MemoryError:
        raise
    except Exception:  # noqa: BLE001 - mcap raises whatever broken bytes lead to
        return False
    again = builder.end()[_HEAD.size :]
    if opcode == Opcode.ATTACHMENT and not any(content[-4:]):
        return bool(again[:-4] == content[:-4])
    return bool(again == content)


def damage(file: Path) -> list[str]:
    """What is wrong with the records of an MCAP file, one line each."""
    found: list[str] = []
    with file.open("rb") as stream:
        sound = SoundRecords(stream, file.stat().st_size, lambda why, _: found.append(f"{file.name}: {why}"))
        sound.check_sums()
        for _ in sound:
            pass
    return found
