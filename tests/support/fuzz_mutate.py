# SPDX-License-Identifier: Apache-2.0
"""Damage that gets behind the first check: valid files are taken apart, changed, and put together again.

All take a ``random.Random`` (or what Hypothesis offers in its place) and are functions of it alone.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from random import Random

import zstandard
from bags import record
from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from mcap_damage import HEAD, flipped, records_of

from lathe_rc.bag.reading.unpacking import read_chunk

WORDS = (
    *(b"", b"\n", b"\0", b"nan", b"inf", b"-1", b"1e999", b"9223372036854775808", b"true", b"null", b"[1, 2]", b"{}"),
    *(b"*a", b"&a [x]", b"<<: *a", b"[" * 50, b"\xff\xfe", b"\xed\xa0\x80", b"\xe2\x80\xa8", b"\xef\xbb\xbf", b"\x85"),
    *(b"!!python/object/apply:os.system ['true']", b"<script>alert(1)</script>", b"\x1b[2J", b"../../x", b"x" * 300),
    *(b"/dev/zero", b"0x10", b"ros__parameters", b":=", b"# ", b'"', b"'", b",", b";", b"$x_{$", b"-0.0", b"1e-320"),
)
NUMBERS = (0, 1, 2, 3, 7, 8, 31, 32, 255, 256, 4095, 65535, 2**16, 2**20, 2**28 + 1)
NUMBERS += (2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, CRC, length of the compression's name
_INDEX = struct.Struct("<QQQQI")  # of a chunk: first and last time, start, length, bytes of places by channel


def some_bytes(data: bytes, random: Random) -> bytes:  # noqa: PLR0911
    """One change somewhere: bits, numbers, words, pieces that are gone, doubled or elsewhere."""
    place = random.randrange(len(data) + 1)
    length = random.choice((1, 2, 4, 8, 16, 100, 5000))
    kind = random.randrange(8)
    if kind == 0 and data:
        return flipped(data, min(place, len(data) - 1), 1 << random.randrange(8))
    if kind <= 2:
        width = random.choice((1, 2, 4, 8))
        number = (random.choice(NUMBERS) % 2 ** (8 * width)).to_bytes(width, "little")
        return data[:place] + number + data[place + width :]
    if kind == 3:
        return data[:place] + random.choice(WORDS) + data[place:]
    if kind == 4:
        return data[:place] + data[place + length :]
    if kind == 5:
        return data[:place] + data[place : place + length] + data[place:]
    if kind == 6:
        return data[:place]
    other = random.randrange(len(data) + 1)
    return data[:place] + data[other : other + length] + data[place + length :]


def some_lines(data: bytes, random: Random) -> bytes:
    """One change to a text: lines and the words in them; at times to its bytes."""
    lines = data.split(b"\n")
    kind, place = random.randrange(6), random.randrange(len(lines))
    if kind == 0:
        return some_bytes(data, random)
    if kind == 1:
        del lines[place]
    elif kind == 2:
        lines.insert(place, random.choice(lines))
    elif kind == 3:
        lines[place] = random.choice(WORDS) + lines[place]
    else:
        splitter = random.choice((b" ", b",", b":", b"="))
        words = lines[place].split(splitter)
        words[random.randrange(len(words))] = random.choice((*WORDS, *lines[random.randrange(len(lines))].split()))
        lines[place] = splitter.join(words)
    return b"\n".join(lines)


@dataclass(frozen=True)
class _Record:
    """A record and where it stood."""

    opcode: int
    content: bytes
    place: int

    def whole(self) -> bytes:
        """As it stands in a file."""
        return record(self.opcode, self.content)


def _records(data: bytes, start: int = 0, end: int | None = None) -> list[_Record]:
    return [_Record(kind, data[a + HEAD.size : b], a) for kind, a, b in records_of(data, start, end or len(data))]


def _changed(records: list[_Record], random: Random) -> list[_Record]:
    """One record gone, doubled, moved, or changed inside; each kind of record is as likely."""
    if not records:
        return records
    kind = random.choice(sorted({record.opcode for record in records}))
    place = random.choice([k for k, record in enumerate(records) if record.opcode == kind])
    chosen, what = records[place], random.randrange(8)
    if what == 0:
        return records[:place] + records[place + 1 :]
    if what == 1:
        return records[:place] + [chosen] * random.choice((2, 5)) + records[place + 1 :]
    if what == 2:
        other = random.randrange(len(records))
        return [*records[:place], records[other], *records[place + 1 :]]
    content = some_bytes(chosen.content, random)
    if kind == Opcode.CHUNK and what > 4:
        content = _changed_chunk(chosen.content, random)
    return [*records[:place], replace(chosen, content=content), *records[place + 1 :]]


def _changed_chunk(content: bytes, random: Random) -> bytes:
    """A chunk of changed records with the right size and checksum."""
    first, last, _, _, length = _CHUNK.unpack_from(content)
    name = content[_CHUNK.size : _CHUNK.size + length]
    inner = _changed(_records(read_chunk(content, 0)), random)
    whole = b"".join(record.whole() for record in inner)
    packed = zstandard.compress(whole) if name == b"zstd" else whole
    return _CHUNK.pack(first, last, len(whole), crc32(whole), length) + name + struct.pack("<Q", len(packed)) + packed


def _index(record: _Record, moved: dict[int, tuple[int, int, bytes]]) -> _Record:
    """A chunk's entry in the index, made right for where the chunk is now."""
    first, last, start, length, count = _INDEX.unpack_from(record.content)
    if start not in moved:
        return record
    new, size, chunk = moved[start]
    shift = new + size - start - length
    entries = [
        struct.pack("<HQ", channel, (place + shift) % 2**64)
        for channel, place in struct.iter_unpack("<HQ", record.content[_INDEX.size :][: count // 10 * 10])
    ]
    rest = record.content[_INDEX.size + len(entries) * 10 : -16]
    name = _CHUNK.unpack_from(chunk)[4]
    sizes = struct.pack("<QQ", max(len(chunk) - _CHUNK.size - name - 8, 0), _CHUNK.unpack_from(chunk)[2])
    return replace(record, content=_INDEX.pack(first, last, new, size, count) + b"".join(entries) + rest + sizes)


def some_records(data: bytes, random: Random) -> bytes:
    """One change to the records of an MCAP file, with an index that is right again, at times not."""
    try:
        records = _changed(_records(data, len(MCAP0_MAGIC), len(data) - len(MCAP0_MAGIC)), random)
        if random.randrange(8) == 0:
            return MCAP0_MAGIC + b"".join(record.whole() for record in records) + MCAP0_MAGIC
        place, moved, new_places = len(MCAP0_MAGIC), {}, {}
        for record in records:
            size = len(record.content) + 9
            new_places.setdefault(record.place, place)
            if record.opcode == Opcode.CHUNK:
                moved.setdefault(record.place, (place, size, record.content))
            place += size
        fixed = []
        for record in records:
            if record.opcode == Opcode.CHUNK_INDEX:
                fixed.append(_index(record, moved))
            elif record.opcode == Opcode.FOOTER and len(record.content) == 20:
                start, rest = struct.unpack("<Q12s", record.content)
                fixed.append(replace(record, content=struct.pack("<Q12s", new_places.get(start, start), rest)))
            else:
                fixed.append(record)
        return MCAP0_MAGIC + b"".join(record.whole() for record in fixed) + MCAP0_MAGIC
    except (ValueError, struct.error):
        return some_bytes(data, random)


def damaged(data: bytes, random: Random, ways: Sequence[object], most: int = 6) -> bytes:
    """Up to ``most`` changes, each in one of some ways."""
    for _ in range(random.randrange(1, most + 1)):
        data = random.choice(ways)(data, random)  # type: ignore[operator]
    return data
