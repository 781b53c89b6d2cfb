# SPDX-License-Identifier: Apache-2.0
"""Damage to MCAP files, and the messages that must be left of them."""

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from random import Random
from typing import NamedTuple

from bags import QOS, mcap_writer
from mcap.opcode import Opcode
from mcap.records import Message
from mcap.stream_reader import StreamReader, breakup_chunk

from lathe_rc import messages
from lathe_rc.bag.repairing.salvage import Salvage
from lathe_rc.bag.writing.writer import BagWriter

PER_CHUNK = 40  #: messages in a chunk of a small bag
HEAD = struct.Struct("<BQ")
MAGIC = 8


class Damaged(NamedTuple):
    """A damaged file.

    Attributes:
        what: the damage.
        data: all bytes.
        hit: numbers of the chunks that were changed.
    """

    what: str
    data: bytes
    hit: frozenset[int]


def records_of(data: bytes, start: int = MAGIC, end: int = -MAGIC) -> list[tuple[int, int, int]]:
    """Opcode, begin and end of each record; outside of chunks, unless ``data`` are those of one.

    Raises:
        ValueError, struct.error: one is cut off.
    """
    place, stop, found = start, end if end >= 0 else len(data) + end, []
    while place < stop:
        opcode, length = HEAD.unpack_from(data, place)
        if place + HEAD.size + length > len(data):
            raise ValueError(f"cut off at {place}")
        found.append((opcode, place, place + HEAD.size + length))
        place = found[-1][2]
    return found


def chunks_of(data: bytes) -> list[tuple[int, int]]:
    """Begin and end of each chunk."""
    return [(begin, end) for opcode, begin, end in records_of(data) if opcode == Opcode.CHUNK]


def chunk_ends(data: bytes) -> list[tuple[int, int]]:
    """End of each chunk, and the messages up to there."""
    ends, count = [], 0
    for begin, end in chunks_of(data):
        chunk = next(StreamReader(BytesIO(data[begin:end]), skip_magic=True, emit_chunks=True).records)
        count += sum(isinstance(record, Message) for record in breakup_chunk(chunk))  # type: ignore[arg-type]
        ends.append((end, count))
    return ends


def plain_file(file: Path, count: int) -> bytes:
    """A file of messages outside of chunks."""
    with mcap_writer(file, use_chunking=False, enable_data_crcs=True) as writer:
        channel = writer.register_channel("/x", "json", writer.register_schema("x", "jsonschema", b"{}"))
        for number in range(count):
            writer.add_message(channel, number, b"%020d" % number, number)
    return file.read_bytes()


def _hit(data: bytes, first: int, last: int) -> frozenset[int]:
    """Chunks with a byte from ``first`` to ``last``."""
    return frozenset(k for k, (begin, end) in enumerate(chunks_of(data)) if begin <= last and first < end)


def flipped(data: bytes, place: int, bits: int = 1) -> bytes:
    """The bytes with some bits of one of them flipped."""
    return data[:place] + bytes([data[place] ^ bits]) + data[place + 1 :]


def _changed(data: bytes, what: str, place: int, new: bytes) -> Damaged:
    whole = data[:place] + new + data[place + len(new) :]
    return Damaged(f"{what} at {place}", whole, _hit(data, place, place + len(new) - 1))


def flips(data: bytes, count: int, random: Random) -> Iterator[Damaged]:
    """Single flipped bits, anywhere."""
    for _ in range(count):
        place = random.randrange(len(data))
        yield _changed(data, "flip", place, bytes([data[place] ^ 1 << random.randrange(8)]))


def structured(data: bytes, count: int, random: Random) -> Iterator[Damaged]:
    """Damage to records: lengths, kinds, checksums; holes, cuts, bytes that are missing or too many."""
    records, chunks = records_of(data), chunks_of(data)
    for number in range(count):
        opcode, begin, _ = random.choice(records)
        chunk = random.choice(chunks)[0]
        match number % 8:
            case 0:
                (length,) = struct.unpack_from("<Q", data, begin + 1)
                new = struct.pack("<Q", length ^ 1 << random.randrange(random.choice((8, 24, 64))))
                yield _changed(data, f"length of a record of kind {opcode}", begin + 1, new)
            case 1:
                new = bytes([random.choice([*range(16), 0x80, 0xFF])])
                yield _changed(data, f"kind {opcode} to {new[0]}", begin, new)
            case 2:
                yield _changed(data, "checksum of a chunk", chunk + 9 + 24, random.randbytes(4))
            case 3:
                place = random.choice((chunk + 9 + 16, chunk + 9 + 28, chunk + 9 + 36))
                yield _changed(data, "size in a chunk", place, random.randbytes(4))
            case 4:
                place = random.randrange(len(data))
                new = random.choice((bytes, random.randbytes))(min(512, len(data) - place))
                yield _changed(data, "hole", place, new)
            case 5:
                length = random.randrange(len(data))
                yield Damaged(f"cut at {length}", data[:length], _hit(data, length, len(data)))
            case 6:
                place, length = random.randrange(MAGIC, len(data)), random.choice((1, 9, 100))
                yield Damaged(f"{length} B missing at {place}", data[:place] + data[place + length :],
                              _hit(data, place, place + length - 1))  # fmt: skip
            case 7:
                place = random.randrange(MAGIC, len(data))
                whole = data[:place] + random.randbytes(random.choice((1, 9, 100))) + data[place:]
                inside = _hit(data, place, place) - {k for k, (start, _) in enumerate(chunks) if start == place}
                yield Damaged(f"bytes too many at {place}", whole, inside)


def small_bag(path: Path, compression: str = "zstd", chunks: int = 10) -> bytes:
    """The file of a bag of two topics in small chunks."""
    writer = BagWriter(path, compression=compression, chunk_size=2**20, about={"text": "of the bag"})  # type: ignore[arg-type]
    for topic in ("/a", "/b"):
        writer.add_topic(topic, messages.EVENT, QOS)
    for number in range(PER_CHUNK * chunks):
        writer.write(("/a", "/b")[number % 2], number, bytes([number % 251]) * 50)
        if number % PER_CHUNK == PER_CHUNK - 1:
            writer.flush()
    writer.close()
    return (path / f"{path.name}.mcap").read_bytes()


Saved = tuple[str, bytes, int, bytes]  #: topic, schema, log time and bytes of a message


def saved_of(file: Path, data: bytes) -> tuple[Salvage, list[Saved]]:
    """Salvage of a file with these bytes, and the messages that it saves."""
    file.write_bytes(data)
    salvage = Salvage(file)
    return salvage, [(m.topic.name, (m.topic.schema or b"")[2:], m.log_ns, m.data) for m in salvage]


def check_damage(file: Path, whole: list[Saved], damaged: Damaged) -> None:
    """All messages of the other chunks are saved, nothing else is, and what is missing is told."""
    salvage, saved = saved_of(file, damaged.data)
    wanted = [message for number, message in enumerate(whole) if number // PER_CHUNK not in damaged.hit]
    rest = set(whole) - set(saved)
    assert not rest.intersection(wanted), damaged.what
    assert len(saved) + len(rest) == len(whole), damaged.what
    assert salvage.lossy or not rest, (damaged.what, salvage.damage)
    assert rest or not salvage.lossy or "cut" in damaged.what, (damaged.what, salvage.damage)  # no false alarm
