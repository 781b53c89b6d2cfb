# SPDX-License-Identifier: Apache-2.0
"""The walk over the records of an MCAP file: those that are sound, found again behind each damaged place.

A record is sound if its checksum holds. Most records have none: then it must be what the mcap library would write of
its content, to the byte, which a wrong length never is. Messages outside of chunks have neither; a record must follow
them, and there must be no chunk in the file: an index of one whose kind is damaged would pass for a message.

What a reader does with damage is its own affair: reading a bag stops at it, recovery goes on behind it, a check tells
it. A file with a sound summary is read by that, see `lathe_rc.bag.reading.mcap_storage`.
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

from lathe_rc.bag.reading.chunk_messages import BEFORE_DATA, HEAD, Found, walk
from lathe_rc.bag.reading.limits import MOST_BYTES, MOST_METADATA, MOST_TEXT, TooMuchError
from lathe_rc.bag.reading.unpacking import CHUNK, Budget, read_chunk

Parsed = TypeVar("Parsed")
Told = Callable[[str, int], None]  #: a damage, and the bytes in which messages may have stood

MAGIC = len(MCAP0_MAGIC)  #: length of what a file begins and ends with [B]
_INDEX = struct.Struct("<HI")  # channel, length of the pairs of time and place
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
# Longest records that hold maps: as objects they take thirty times as much memory. [B]
_MOST = {Opcode.CHUNK_INDEX: MOST_TEXT, Opcode.STATISTICS: MOST_TEXT, Opcode.CHANNEL: MOST_METADATA}
# Where a record may begin: any opcode with a length below 4 GiB, or a chunk of whatever length.
_BEGINS = re.compile(rb"(?=[\x01-\x0f].{4}\0{4}|\x06.{28}\0{4}.{4}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd))", re.DOTALL)
_LONGEST_BEGIN = 49  # of that [B]
_WINDOW = 2**20  # of a file that is searched at once [B]
_PART = 2**22  # of messages outside of chunks that is looked at once, at most [B]
_PAGE = 2**12  # that is searched; a place where a record may begin takes as long [B]
_PAGES = 2**18  # that may be searched in vain, and as many more as the file has


class Record(NamedTuple):
    """A sound record, or messages outside of chunks that follow one another.

    Attributes:
        place: of its first byte in the file.
        end: place behind it.
        opcode: its kind.
        content: its bytes; of a chunk its records, unpacked; of messages their records, heads included.
        checked: whether a checksum vouches for the content.
    """

    place: int
    end: int
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
        summary_start: where the summary begins, once `find_summary` has found it; before that the size.
        ended: whether the newest iteration has come behind the end of all data.
        data_wrong, summary_wrong: whether the checksum of all data, or of the summary, does not hold.
    """

    def __init__(self, stream: BinaryIO, size: int, told: Told, effort: _Effort | None = None) -> None:
        self._stream, self._size, self.told = stream, size, told
        self._effort = effort or _Effort(size)
        self._last = Opcode.FOOTER if effort is None else 0
        self._chunked = False
        self._window = _PAGE
        self._checked_from = self.summary_start = self._data_end = size
        self.ended = self.data_wrong = self.summary_wrong = False

    def inside(self, record: Record) -> Iterator[tuple[bytes, Found]]:
        """The records of a chunk or of messages, in pieces; or a single one of another kind."""
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
            with suppress(ValueError):  # the next chunk tells it
                self._effort.budget.take(0, len(found.messages) + len(found.others))

    # ---- what stands at the end ---------------------------------------------------------------------

    def find_summary(self) -> bool:
        """Look for the summary of a file that is complete, and at its checksum; whether there is one to be read."""
        place = self._size - MAGIC - _FOOTER
        with suppress(ValueError):  # the walk tells it
            footer = self._sound(place)
            start, _, crc = struct.unpack("<QQI", footer.content) if footer.opcode == Opcode.FOOTER else (0, 0, 0)
            self._data_end = (start or place) - _DATA_END
            self.summary_start = start if MAGIC <= start < place else self._size
            self.summary_wrong = bool(start and crc) and self._sum(start, place + _FOOTER - 4) != crc
            self._checked_from = start if start and crc and not self.summary_wrong else self._size
        return self.summary_start < self._size and not self.summary_wrong

    def check_sums(self) -> None:
        """Look at the checksums of data and summary."""
        self.find_summary()
        try:
            end = self._sound(self._data_end)
        except ValueError:  # the walk tells it; the summary stands elsewhere, and may be right
            self.summary_start, self.summary_wrong = self._size, False
            return
        if self.summary_wrong:
            self.told("the checksum of the summary is wrong", 0)
        (crc,) = struct.unpack("<I", end.content) if end.opcode == Opcode.DATA_END else (0,)
        if crc and self._sum(0, self._data_end) != crc:
            self.data_wrong = True
            self.told("the checksum of the data section is wrong", 0)

    def _sum(self, start: int, stop: int) -> int:
        crc = 0
        for place in range(start, stop, _WINDOW):
            crc = crc32(self._at(place, min(_WINDOW, stop - place)), crc)
        return crc

    def summary(self) -> Iterator[Record]:
        """The sound records of the summary, once `find_summary` has found it."""
        return self._walk(self.summary_start) if self.summary_start < self._size else iter(())

    # ---- the walk -----------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Record]:
        """The sound records in the order of the file."""
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
            # A record may lack bytes at its end and have taken them from the next one: that is looked for within it.
            # Of several messages the last one begins within the last bytes; the others are followed by one.
            before = record.end if record.checked or opcode == Opcode.MESSAGE else place
            yield record
            place = record.end
        if self._last and opcode != self._last:
            self.told("ends without a footer", 0)

    def _at(self, place: int, length: int) -> bytes:
        self._stream.seek(max(place, 0))  # a file may be shorter than its last records
        return self._stream.read(length)

    def _with_following(self, record: Record) -> Record:
        """A message with those that follow it: files without chunks have millions."""
        whole = self._at(record.end, self._window)
        ends = walk(whole, alone=True).messages[:, 3].tolist()
        # More is read at once where messages follow messages: a file that has one here and there is not read anew each.
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
        """The record at a place, where ``head`` stands.

        Raises:
            _UnsoundError: it is not sound.
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
        """Whether the file ends at a place, or a record may begin."""
        head = self._at(place, HEAD.size)
        if place == self._size or head.startswith(MCAP0_MAGIC):
            return True
        opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
        return bool(0 < opcode <= Opcode.DATA_END and place + HEAD.size + length <= self._size)

    def _chunk(self, place: int, end: int) -> Record:
        """A chunk says its length twice: one of them may be wrong."""
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
            record = self._sound(place)
            if not record.checked and record.end < self._size and self._at(record.end, MAGIC) != MCAP0_MAGIC:
                self._sound(record.end)
        except _UnsoundError:
            return False
        return True


def parsed(kind: type[Parsed], content: bytes) -> Parsed:
    """A record as an object of the mcap library, which raises whatever broken bytes lead to."""
    return kind.read(ReadDataStream(BytesIO(content)))  # type: ignore[attr-defined, no-any-return]  # each has it


def _found(record: Record, *walked: int) -> Found:
    """The records in one; of one whose opcode is not among ``walked``, itself."""
    if record.opcode in walked:
        return walk(record.content)
    size = len(record.content)
    return Found(np.empty((0, 4), np.uint64), np.array([[record.opcode, 0, size]], np.uint64), size)


def _as_written(opcode: int, content: bytes) -> bool:
    """Whether a record is what the mcap library would write; an attachment may lack its checksum."""
    if opcode not in _PLAIN:
        return False
    builder = RecordBuilder()
    try:
        parsed(_PLAIN[opcode], content).write(builder)
    except MemoryError:
        raise
    except Exception:  # noqa: BLE001 - mcap raises whatever broken bytes lead to
        return False
    again = builder.end()[HEAD.size :]
    if opcode == Opcode.ATTACHMENT and not any(content[-4:]):
        return bool(again[:-4] == content[:-4])
    return bool(again == content)


def damage(file: Path) -> list[str]:
    """Damaged records of an MCAP file, one line each."""
    found: list[str] = []
    with file.open("rb") as stream:
        sound = SoundRecords(stream, file.stat().st_size, lambda why, _: found.append(f"{file.name}: {why}"))
        sound.check_sums()
        for _ in sound:
            pass
    return found
