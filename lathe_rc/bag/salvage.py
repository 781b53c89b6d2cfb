# SPDX-License-Identifier: Apache-2.0
"""Every message that is whole in a bag that is not: cut off, or broken in places."""

import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema
from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

from lathe_rc.bag.source import MOST_BYTES, MOST_TOPICS, read_chunk, read_record, unpack, unpack_file, unpacked_size
from lathe_rc.errors import InputError

_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_ZSTD = b"\x28\xb5\x2f\xfd"  # begins a message that is compressed by itself; CDR begins with a zero
_UNREADABLE = (McapError, ValueError, KeyError, IndexError, EOFError, struct.error, TypeError)


@dataclass(frozen=True)
class Announced:
    """What a broken bag still says of a topic; texts may be empty."""

    type: str
    definition: str
    digest: str
    qos: tuple[Qos, ...]


@dataclass
class Salvage:
    """What is left of a bag; iterate over it to get topic, log time [ns] and bytes of each whole message.

    Args:
        path: a rosbag2 folder or a file of one.

    Attributes:
        topics: announced so far, by name.
        about: texts that the bag says of itself.
        damage: what was wrong and where, one line each.
        lost_bytes: bytes of the files that gave nothing.

    Raises:
        InputError: there is no file of a bag.
    """

    path: Path
    topics: dict[str, Announced] = field(default_factory=dict)
    about: dict[str, str] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    lost_bytes: int = 0

    def __post_init__(self) -> None:
        kinds = (".mcap", ".db3", ".zstd")
        found = [self.path] if self.path.is_file() else list(self.path.glob("*"))
        self._files = sorted(file for file in found if file.suffix in kinds)
        if not self._files:
            raise InputError(f"{self.path}: no bag; allowed: a folder with .mcap or .db3 files, or such a file")

    def __iter__(self) -> Iterator[tuple[str, int, bytes]]:
        """The whole messages in the order of the files."""
        for file in self._files:
            for topic, log_ns, data in self._file(file):
                if not data.startswith(_ZSTD):
                    yield topic, log_ns, data
                    continue
                try:
                    yield topic, log_ns, unpack("zstd", data, unpacked_size(data[:18]))
                except ValueError as error:
                    self._lose(file, 0, len(data), f"{topic} at {log_ns} ns: {error}")

    def _file(self, file: Path) -> Iterator[tuple[str, int, bytes]]:
        if file.suffix != ".zstd":
            yield from (self._mcap if file.suffix == ".mcap" else self._sqlite)(file)
            return
        with tempfile.TemporaryDirectory(prefix="lathe-salvage-") as folder:
            unpacked = Path(folder) / file.stem
            self._unpack(file, unpacked)
            yield from self._file(unpacked)

    def _unpack(self, file: Path, unpacked: Path) -> None:
        """Unpack a file that is compressed as a whole, as far as it goes."""
        with unpacked.open("wb") as out:
            try:
                out.writelines(unpack_file(file))
            except ValueError as error:
                raise InputError(f"{file}: {error}") from None
            except zstandard.ZstdError as error:
                self.damage.append(f"{file.name}: {error}")

    # ---- MCAP ---------------------------------------------------------------------------------------

    def _mcap(self, file: Path) -> Iterator[tuple[str, int, bytes]]:
        size = file.stat().st_size
        channels: dict[int, str] = {}
        schemas: dict[int, Schema] = {}
        with file.open("rb") as stream:
            if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                self._lose(file, 0, size, "not an MCAP file")
                return
            yield from self._records(file, stream, size, schemas, channels)

    def _lose(self, file: Path, place: int, end: int, why: str) -> None:
        self.damage.append(f"{file.name}: {why}")
        self.lost_bytes += end - place

    def _records(
        self,
        file: Path,
        stream: BinaryIO,
        size: int,
        schemas: dict[int, Schema],
        channels: dict[int, str],
        inside: int | None = None,
    ) -> Iterator[tuple[str, int, bytes]]:
        """What the records of a file hold, or those of a chunk that stands at byte ``inside`` of it."""
        while True:
            place = stream.tell()
            try:
                record = read_record(stream, size)
            except ValueError as error:
                self._lose(file, place, size, str(error))
                return
            if record is None:
                if inside is None:
                    self._lose(file, size, size, "ends without a footer")
                return
            opcode, content = record
            if opcode == Opcode.FOOTER:
                return
            if opcode == Opcode.CHUNK:
                try:
                    whole = read_chunk(content, place)
                except ValueError as error:
                    self._lose(file, place, stream.tell(), str(error))
                    continue
                yield from self._records(file, BytesIO(whole), len(whole), schemas, channels, inside=place)
            elif found := self._record(file, opcode, content, schemas, channels):
                yield found

    def _record(
        self, file: Path, opcode: int, content: bytes, schemas: dict[int, Schema], channels: dict[int, str]
    ) -> tuple[str, int, bytes] | None:
        """The message in a record, if it is one; others are taken note of."""
        try:
            if opcode == Opcode.MESSAGE:
                channel, _, log_ns, _ = _MESSAGE.unpack_from(content)
                return channels[channel], log_ns, content[_MESSAGE.size :]
            data = ReadDataStream(BytesIO(content))
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(data)
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                self._channel(Channel.read(data), schemas, channels)
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(data)
                if metadata.name == "lathe_rc":
                    self.about |= metadata.metadata
        except _UNREADABLE as error:
            self._lose(file, 0, len(content), f"record of kind {opcode}: {error}")
        return None

    def _channel(self, channel: Channel, schemas: dict[int, Schema], channels: dict[int, str]) -> None:
        if len(self.topics) >= MOST_TOPICS:
            raise ValueError(f"more than {MOST_TOPICS} topics")
        schema = schemas[channel.schema_id]
        qos = tuple(parse_qos(channel.metadata.get("offered_qos_profiles", "") or "[]"))
        channels[channel.id] = channel.topic
        digest = channel.metadata.get("topic_type_hash", "")
        self.topics[channel.topic] = Announced(schema.name, schema.data.decode(), digest, qos)

    # ---- SQLite -------------------------------------------------------------------------------------

    def _sqlite(self, file: Path) -> Iterator[tuple[str, int, bytes]]:
        try:
            with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
                names = self._sqlite_topics(base)
                rows = base.execute(
                    "SELECT topic_id, timestamp, data FROM messages WHERE length(data) <= ? ORDER BY id", (MOST_BYTES,)
                )
                for number, log_ns, data in rows:
                    if number in names and isinstance(data, bytes):
                        yield names[number], int(log_ns), data
        except sqlite3.Error as error:
            self._lose(file, 0, 0, str(error))

    def _sqlite_topics(self, base: sqlite3.Connection) -> dict[int, str]:
        names: dict[int, str] = {}
        try:
            defined = dict(base.execute("SELECT topic_type, encoded_message_definition FROM message_definitions"))
        except sqlite3.Error:
            defined = {}  # bags of older ROS have none
        for number, name, kind, qos in base.execute("SELECT id, name, type, offered_qos_profiles FROM topics"):
            names[number] = name
            profiles = tuple(parse_qos(qos)) if isinstance(qos, str) and qos else ()
            self.topics[name] = Announced(str(kind), str(defined.get(kind, "")), "", profiles)
        return names
