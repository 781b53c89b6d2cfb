# SPDX-License-Identifier: Apache-2.0
"""Checks before a library opens a bag, which refuse a file that would cost it unlimited memory or time.

rosbags believes what a file says of sizes, expands what YAML repeats, and asks SQLite for what the schema defines.
"""

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import yaml
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer
from mcap.writer import MCAP0_MAGIC

MOST_BYTES = 2**28  #: longest chunk, record or message that is read into memory [B]
MOST_TOPICS = 4096  #: topics of a bag
MOST_TEXT = 2**20  #: longest text in its metadata, and of all quality of service together [B]

_LONGEST_NAME = 1024  # characters
_MOST_EVENTS = 2**19  # of a YAML text
_MOST_DEPTH = 32  # of its collections
_MOST_OPEN = 2**29  # unpacked, of chunks that overlap in time [B]
_RECORD = struct.Struct("<BQ")  # opcode, length
_FOOTER = 29 + len(MCAP0_MAGIC)  # [B] at the end of a file
_YAML = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


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


def check_yaml(text: str, what: str) -> None:
    """Refuse a text that would grow when it is read, or take too long.

    Raises:
        ValueError: it has aliases, is nested too deep or too long, or is no YAML.
    """
    depth = 0
    try:
        for count, event in enumerate(yaml.parse(text, Loader=_YAML)):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"{what}: YAML aliases; ROS 2 writes none")  # noqa: TRY004 - the file's fault
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _MOST_DEPTH or count > _MOST_EVENTS:
                raise ValueError(f"{what}: nested deeper than {_MOST_DEPTH} or of more than {_MOST_EVENTS} parts")
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise ValueError(f"{what}: not YAML{f' in line {mark.line + 1}' if mark else ''}") from None
    except OverflowError:
        raise ValueError(f"{what}: not YAML (a character beyond Unicode)") from None


def check_name(name: object) -> None:
    """Refuse the name of a topic or type that could not be shown in a line.

    Raises:
        ValueError: it is no text, too long, or has characters that do not print.
    """
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= _LONGEST_NAME:
        raise ValueError(f"name {str(name)[:80]!r}; allowed: up to {_LONGEST_NAME} characters that print")


def number(given: object) -> int:
    """A whole number.

    Raises:
        ValueError: it is something else.
    """
    if not isinstance(given, int):
        raise ValueError(f"{str(given)[:80]!r} where a whole number belongs")  # noqa: TRY004 - the file's fault
    return given


def is_packed(head: bytes) -> bool:
    """Whether a file that begins like this is compressed as a whole, or what comes first is skipped by zstd."""
    return head.startswith(b"\x28\xb5\x2f\xfd") or (head[1:4] == b"\x2a\x4d\x18" and head[0] >> 4 == 5)


class Qos:
    """Counts the texts of quality of service, which rosbags reads one by one."""

    def __init__(self) -> None:
        self._bytes = self._topics = 0

    def add(self, channel: Channel) -> None:
        """Take the next.

        Raises:
            ValueError: there are too many, or one would grow when it is read.
        """
        text = channel.metadata.get("offered_qos_profiles", "")
        self._bytes += len(text)
        self._topics += 1
        if self._topics > MOST_TOPICS:
            raise ValueError(f"more than {MOST_TOPICS} topics")
        if self._bytes > MOST_TEXT:
            raise ValueError(f"more than {MOST_TEXT} characters of quality of service")
        check_yaml(text, "offered_qos_profiles")


def summary_of(path: Path) -> bool:
    """Look at the summary of an MCAP file; whether it has all that rosbags asks for, which reads the whole file if not.

    Raises:
        ValueError: it has no index that could be right; mcap raises others.
    """
    size, chunks = path.stat().st_size, []
    with path.open("rb") as stream:
        stream.seek(max(0, size - _FOOTER))
        footer = read_record(stream, size - len(MCAP0_MAGIC))
        if footer is None or footer[0] != Opcode.FOOTER:
            raise ValueError(f"{path.name}: no footer")
        stream.seek(len(MCAP0_MAGIC))
        read_record(stream, size - len(MCAP0_MAGIC))  # the header, which rosbags reads however long it says it is
        start, end = Footer.read(ReadDataStream(BytesIO(footer[1]))).summary_start, size - _FOOTER
        if not start:
            return False
        stream.seek(min(start, end))
        schemas = statistics = False
        for opcode, data in _indexed(stream, end):
            schemas |= opcode == Opcode.SCHEMA
            statistics |= opcode == Opcode.STATISTICS
            if opcode == Opcode.CHUNK_INDEX:
                chunks.append(ChunkIndex.read(ReadDataStream(BytesIO(data))))
    _check_places(chunks, start)
    return schemas if statistics else bool(chunks)


def _indexed(stream: BinaryIO, end: int) -> Iterator[tuple[int, bytes]]:
    """Records of the summary, up to the offsets of their groups."""
    qos = Qos()
    while (record := read_record(stream, end)) and record[0] != Opcode.SUMMARY_OFFSET:
        if record[0] == Opcode.CHANNEL:
            qos.add(Channel.read(ReadDataStream(BytesIO(record[1]))))
        yield record


def _check_places(chunks: list[ChunkIndex], end: int) -> None:
    """Refuse chunks that are not in the file, not apart, or too many at a time."""
    free = len(MCAP0_MAGIC)
    for chunk in sorted(chunks, key=lambda chunk: chunk.chunk_start_offset):
        start, length = chunk.chunk_start_offset, chunk.chunk_length
        if start < free or start + length > end or max(length, chunk.uncompressed_size) > MOST_BYTES:
            raise ValueError(f"the index has a chunk of {length} B at byte {start}; that is not where one can be")
        if chunk.compressed_size > length:
            raise ValueError(f"the index has a chunk of {length} B with {chunk.compressed_size} B in it")
        free = start + length
    at_a_time = 0
    edges = [(chunk.message_start_time, chunk.uncompressed_size) for chunk in chunks]
    edges += [(chunk.message_end_time + 1, -chunk.uncompressed_size) for chunk in chunks]
    for _, size in sorted(edges):
        at_a_time += size
        if at_a_time > _MOST_OPEN:
            raise ValueError(f"chunks of the same time take more than {_MOST_OPEN} B; record them in order of time")


def check_database(path: Path) -> None:
    """Refuse a SQLite file whose answers are more than what it holds: views, triggers, columns that are computed.

    Raises:
        ValueError: it has some, or a message that is too long.
        sqlite3.Error: it is none.
    """
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
        check_tables(base)


def check_tables(base: sqlite3.Connection) -> None:
    """See `check_database`."""
    made = base.execute("SELECT name, type, coalesce(sql, '') FROM sqlite_master").fetchmany(MOST_TOPICS)
    for name, kind, sql in made:
        columns = (
            base.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,)).fetchall() if kind == "table" else []
        )
        computed = any(hidden for (hidden,) in columns)
        if kind not in ("table", "index") or computed or str(sql).upper().startswith("CREATE VIRTUAL"):
            raise ValueError(f"{str(kind)[:20]} {str(name)[:80]!r} in the database; rosbag2 makes plain tables only")
    if any(name == "messages" for name, _, _ in made):
        (longest,) = base.execute("SELECT max(length(data)) FROM messages").fetchone()
        if isinstance(longest, int) and longest > MOST_BYTES:
            raise ValueError(f"a message of {longest} B; allowed: up to {MOST_BYTES}")
