# SPDX-License-Identifier: Apache-2.0
"""Walk over the valid records of an MCAP file, resynchronizing after each damaged place.

A record is valid if its checksum matches. Most records have no checksum; such a record is valid if its bytes are those
that the mcap library would write for its content, which excludes a wrong length. Messages outside chunks allow neither
test; they must be followed by a record, and the file must have no chunks, because a chunk index with a damaged opcode
would pass for a message.

The caller decides how to handle damage: reading a bag stops there, recovery continues after it, and a check reports it.
A file with a valid summary is read by its summary (see `lathe_rc.bag.reading.mcap_storage`).
"""

import re
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

import numpy as np
from isal.isal_zlib import crc32
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from lathe_rc.bag.reading.chunk_messages import BEFORE_DATA, HEAD, FoundRecords, walk
from lathe_rc.bag.reading.limits import MOST_BYTES, MOST_METADATA, MOST_TEXT, TooMuchError
from lathe_rc.bag.reading.unpacking import CHUNK, ReadingBudget, read_chunk

Parsed = TypeVar("Parsed")
Told = Callable[[str, int], None]  #: given a description of the damage, and the bytes in which messages may be lost

MAGIC = len(MCAP0_MAGIC)  #: length of the magic bytes at both ends of a file [B]
_INDEX = struct.Struct("<HI")  # channel, length of the array of pairs of time and offset
_COMPRESSIONS = (b"", b"lz4", b"zstd")
_FOOTER, _DATA_END = 29, 13  # [B]
_PRIVATE = 0x80  # opcodes from here on are reserved for private use
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
# Maximum length of records with maps, which take thirty times as much memory when parsed [B]
_MOST = {Opcode.CHUNK_INDEX: MOST_TEXT, Opcode.STATISTICS: MOST_TEXT, Opcode.CHANNEL: MOST_METADATA}
# Possible beginning of a record: any opcode with a length below 4 GiB, or a chunk of any length.
_BEGINS = re.compile(rb"(?=[\x01-\x0f].{4}\0{4}|\x06.{28}\0{4}.{4}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd))", re.DOTALL)
_LONGEST_BEGIN = 49  # maximum length of a match [B]
_WINDOW = 2**20  # bytes of a file searched at once
_PART = 2**22  # maximum size of the messages outside chunks that are examined at once [B]
_PAGE = 2**12  # unit of search effort; examining a possible record takes as long as searching a page [B]
_PAGES = 2**18  # search effort allowed in addition to twice the pages of the file [pages]


class Record(NamedTuple):
    """Valid record, or consecutive messages outside chunks.

    Attributes:
        place: file offset of the first byte.
        end: file offset after the last byte.
        opcode: kind of record.
        content: content of the record; for a chunk, the unpacked records; for messages, the records with their heads.
        checked: whether a checksum confirms the content.
    """

    place: int
    end: int
    opcode: int
    content: bytes
    checked: bool


class _UnsoundError(ValueError):
    """Error for a record that is not valid.

    Attributes:
        chunk: whether the record is a chunk.
        end: file offset of the next record, if known with certainty despite the damage.
    """

    def __init__(self, why: str, *, chunk: bool = False, end: int | None = None) -> None:
        super().__init__(why)
        self.chunk, self.end = chunk, end


class _Effort:
    """Remaining work allowed for a file: bytes to unpack, and pages to search for records."""

    def __init__(self, size: int) -> None:
        self.budget = ReadingBudget(size)
        self.left = _PAGES + 2 * (size // _PAGE)

    def spend(self, size: int) -> bool:
        """Charge the search of ``size`` bytes plus a fixed cost; return whether the limit allows the search."""
        self.left -= 1 + size // _PAGE
        return self.left >= 0


class SoundRecords:
    """Iterable over the valid records of a file; can be iterated repeatedly.

    Args:
        stream: stream of the file, at any position.
        size: size of the file [B].
        told: callback for each damaged place; may be replaced between two iterations.
        effort: remaining work, given for the records of a chunk; None: proportional to the size of the file.

    Attributes:
        summary_start: offset of the summary, once `find_summary` has found it; before that, the size of the file.
        data_end: offset of the record at the end of the data section, found in the same way.
        ended: whether the latest iteration has passed the end of the data section.
        data_wrong, summary_wrong: whether the checksum of the data section, or of the summary, does not match.
    """

    def __init__(self, stream: BinaryIO, size: int, told: Told, effort: _Effort | None = None) -> None:
        self._stream, self._size, self.told = stream, size, told
        self._effort = effort or _Effort(size)
        self._last = Opcode.FOOTER if effort is None else 0
        self._chunked = False
        self._window = _PAGE
        self._checked_from = self.summary_start = self.data_end = size
        self.ended = self.data_wrong = self.summary_wrong = False

    def inside(self, record: Record) -> Iterator[tuple[bytes, FoundRecords]]:
        """Yield the bytes and located records of a chunk or of messages; any other record is yielded as a whole."""
        if record.opcode == Opcode.CHUNK and not record.checked:
            inner = SoundRecords(BytesIO(record.content), len(record.content), self.told, self._effort)
            yield from ((each.content, _found(each, Opcode.MESSAGE)) for each in inner)
            return
        try:
            found = _found(record, Opcode.MESSAGE, Opcode.CHUNK)
        except TooMuchError as error:
            self.told(f"chunk at byte {record.place}: {error}", len(record.content))
            return
        yield record.content, found
        if left := len(record.content) - found.end:
            self.told(f"chunk at byte {record.place}: a record is longer than the chunk", left)
        if record.opcode == Opcode.CHUNK:
            with suppress(ValueError):  # the walk over the next chunk reports it
                self._effort.budget.take(0, len(found.messages) + len(found.others))

    # ---- end of the file -----------------------------------------------------------------------------

    def find_summary(self) -> bool:
        """Locate the summary of a complete file and verify its checksum; return whether it is readable."""
        place = self._size - MAGIC - _FOOTER
        with suppress(ValueError):  # the walk reports it
            footer = self._sound(place)
            start, _, crc = struct.unpack("<QQI", footer.content) if footer.opcode == Opcode.FOOTER else (0, 0, 0)
            self.data_end = (start or place) - _DATA_END
            self.summary_start = start if MAGIC <= start < place else self._size
            self.summary_wrong = bool(start and crc) and self._sum(start, place + _FOOTER - 4) != crc
            self._checked_from = start if start and crc and not self.summary_wrong else self._size
        return self.summary_start < self._size and not self.summary_wrong

    def check_sums(self) -> None:
        """Verify the checksums of the data section and of the summary."""
        self.find_summary()
        try:
            end = self.at(self.data_end)
        except ValueError:  # the walk reports it; the summary is elsewhere, and may be valid
            self.summary_start, self.summary_wrong = self._size, False
            return
        if self.summary_wrong:
            self.told("the checksum of the summary is wrong", 0)
        (crc,) = struct.unpack("<I", end.content) if end.opcode == Opcode.DATA_END else (0,)
        if crc and self._sum(0, self.data_end) != crc:
            self.data_wrong = True
            self.told("the checksum of the data section is wrong", 0)

    def _sum(self, start: int, stop: int) -> int:
        crc = 0
        for place in range(start, stop, _WINDOW):
            crc = crc32(self._at(place, min(_WINDOW, stop - place)), crc)
        return crc

    def at(self, place: int) -> Record:
        """Return the record at a file offset.

        Raises:
            ValueError: there is no valid record.
        """
        return self._sound(place)

    def summary(self) -> Iterator[Record]:
        """Yield the valid records of the summary, once `find_summary` has found it."""
        return self._walk(self.summary_start) if self.summary_start < self._size else iter(())

    # ---- the walk -----------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Record]:
        """Yield the valid records in the order of the file."""
        return self._walk(0)

    def _walk(self, place: int) -> Iterator[Record]:
        opcode, before = 0, place
        self.ended = False
        if self._last:
            self._effort = _Effort(self._size)
        while place < self._size:
            head = self._at(place, HEAD.size)
            if head.startswith(MCAP0_MAGIC):
                place += MAGIC
                continue
            try:
                record = self._sound(place, head)
            except _UnsoundError as error:
                self._chunked |= error.chunk
                end = error.end or self._search(before + 1)
                self.told(str(error), 0 if self.ended else max(0, end - place))
                place = before = end
                continue
            opcode = record.opcode
            if opcode == Opcode.MESSAGE:
                record = self._with_following(record)
            self._chunked |= opcode in (Opcode.CHUNK, Opcode.CHUNK_INDEX)
            self.ended = opcode == Opcode.DATA_END or (self.ended and opcode not in (Opcode.CHUNK, Opcode.MESSAGE))
            # A record may have lost bytes at its end and extend into the next one, so a search begins within it.
            # A message is accepted only if another record may begin after it.
            before = record.end if record.checked or opcode == Opcode.MESSAGE else place
            yield record
            place = record.end
        if self._last and opcode != self._last:
            self.told("ends without a footer", 0)

    def _at(self, place: int, length: int) -> bytes:
        self._stream.seek(max(place, 0))  # a file may be shorter than its last records
        return self._stream.read(length)

    def _with_following(self, record: Record) -> Record:
        """Extend a message record by the messages that follow it, since files without chunks have millions of them."""
        whole = self._at(record.end, self._window)
        ends = walk(whole, alone=True).messages[:, 3].tolist()
        # The window grows only while messages are consecutive, so scattered messages do not cause repeated reading.
        self._window = min(2 * self._window, _PART) if 2 * (ends or [0])[-1] > self._window else _PAGE
        if ends and not self._begins(record.end + ends[-1]):
            ends.pop()
        if not ends:
            return record
        with suppress(TooMuchError):
            self._effort.budget.take(0, len(ends))
            return record._replace(end=record.end + ends[-1], content=record.content + whole[: ends[-1]])
        return record

    def _sound(self, place: int, head: bytes | None = None) -> Record:
        """Return the record at a file offset; ``head``, if given, contains the record's first bytes.

        Raises:
            _UnsoundError: the record is not valid.
        """
        head = self._at(place, HEAD.size) if head is None else head
        opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, self._size)
        end = place + HEAD.size + length
        if opcode == Opcode.CHUNK:
            return self._chunk(place, end)
        if end > self._size:
            raise _UnsoundError(f"cut off at byte {place}")
        if length > (most := _MOST.get(opcode, MOST_BYTES)):
            raise _UnsoundError(f"record of {length} B at byte {place}; allowed: up to {most}")
        content = self._at(place + HEAD.size, length)
        vouched = place >= self._checked_from
        if opcode == Opcode.MESSAGE:
            sound = HEAD.size + length >= BEFORE_DATA and not self._chunked and self._begins(end)
            content = head + content
            try:
                self._effort.budget.take(0, 1)
            except TooMuchError as error:
                raise _UnsoundError(f"message at byte {place}: {error}") from None
        elif opcode >= _PRIVATE:
            sound = self._begins(end)
        elif opcode == Opcode.MESSAGE_INDEX:
            pairs = _INDEX.unpack_from(content)[1] if length >= _INDEX.size else -1
            sound = pairs == length - _INDEX.size and pairs % 16 == 0
        else:
            sound = vouched or (self._effort.spend(0) and _as_written(opcode, content))
        if opcode == Opcode.FOOTER:
            sound = sound and self._at(end, MAGIC) == MCAP0_MAGIC
        if not sound:
            raise _UnsoundError(f"record of kind {opcode} at byte {place} is broken")
        checked = vouched or (opcode == Opcode.ATTACHMENT and any(content[-4:]))
        return Record(place, end, opcode, content, checked)

    def _begins(self, place: int) -> bool:
        """Return whether the file ends at an offset, or a record may begin there."""
        head = self._at(place, HEAD.size)
        if place == self._size or head.startswith(MCAP0_MAGIC):
            return True
        opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
        return bool(0 < opcode <= Opcode.DATA_END and place + HEAD.size + length <= self._size)

    def _chunk(self, place: int, end: int) -> Record:
        """Return the chunk at a file offset; one of its two stated lengths may be wrong."""
        begin = place + HEAD.size
        head = self._at(begin, CHUNK.size + 4 + 8)
        if len(head) < CHUNK.size + 8:
            raise _UnsoundError(f"cut off at byte {place}")
        _, _, size, crc, length = CHUNK.unpack_from(head)
        if head[CHUNK.size : CHUNK.size + length] not in _COMPRESSIONS:
            raise _UnsoundError(f"chunk at byte {place}: its compression is none of zstd, lz4, none")
        start = begin + CHUNK.size + length + 8
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
            return Record(place, stop, Opcode.CHUNK, whole, checked=bool(crc))
        raise _UnsoundError(why, chunk=True, end=end if said == end <= self._size else None)

    def _search(self, place: int) -> int:
        """Return the file offset of the next valid record; the size of the file if there is none."""
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
        """Return whether a valid record is at an offset, confirmed by a checksum or by a valid record after it."""
        try:
            record = self._sound(place)
            if not record.checked and record.end < self._size and self._at(record.end, MAGIC) != MCAP0_MAGIC:
                self._sound(record.end)
        except _UnsoundError:
            return False
        return True


def parsed(kind: type[Parsed], content: bytes) -> Parsed:
    """Parse a record into an object of the mcap library; damaged bytes may raise any exception."""
    return kind.read(ReadDataStream(BytesIO(content)))  # type: ignore[attr-defined, no-any-return]  # each has it


def _found(record: Record, *walked: int) -> FoundRecords:
    """Return the records inside a record, or the record itself if its opcode is not in ``walked``."""
    if record.opcode in walked:
        return walk(record.content)
    size = len(record.content)
    return FoundRecords(np.empty((0, 4), np.uint64), np.array([[record.opcode, 0, size]], np.uint64), size)


def _as_written(opcode: int, content: bytes) -> bool:
    """Return whether a record is as the mcap library would write it; an attachment may lack its checksum."""
    if opcode not in _PLAIN:
        return False
    builder = RecordBuilder()
    try:
        parsed(_PLAIN[opcode], content).write(builder)
    except MemoryError:
        raise
    except Exception:  # noqa: BLE001 - mcap can raise any exception on damaged bytes
        return False
    again = builder.end()[HEAD.size :]
    if opcode == Opcode.ATTACHMENT and not any(content[-4:]):
        return bool(again[:-4] == content[:-4])
    return bool(again == content)


def damage(file: Path) -> list[str]:
    """Return the damaged records of an MCAP file, one line each."""
    found: list[str] = []
    with file.open("rb") as stream:
        sound = SoundRecords(stream, file.stat().st_size, lambda why, _: found.append(f"{file.name}: {why}"))
        sound.check_sums()
        for _ in sound:
            pass
    return found
