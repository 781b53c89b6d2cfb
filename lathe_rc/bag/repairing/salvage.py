# SPDX-License-Identifier: Apache-2.0
"""Every message that is whole in a bag that is not: cut off, or broken in places."""

import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema
from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

from lathe_rc.bag.reading import precheck
from lathe_rc.bag.reading.limits import MOST_BYTES, MOST_TEXT, MOST_TOPICS
from lathe_rc.bag.reading.precheck import read_record
from lathe_rc.bag.reading.source import files_of
from lathe_rc.bag.reading.unpacking import read_chunk, unpack, unpack_file, unpacked_size
from lathe_rc.errors import InputError, LatheError, shown

_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_ZSTD = b"\x28\xb5\x2f\xfd"  # begins a message that is compressed by itself; CDR begins with a zero
_MOST_DESCRIBED = 16 * MOST_TEXT  # texts and definitions that are kept [characters]
_MOST_DAMAGE = 1000  # places that are told


@dataclass(frozen=True)
class Announced:
    """A topic as a broken bag announces it; texts may be empty."""

    type: str
    definition: str
    digest: str
    qos: tuple[Qos, ...]
    encoding: str


@lru_cache(maxsize=8)
def _profiles(text: str) -> tuple[Qos, ...]:
    """QoS as YAML has it; most topics of a bag have the same, and to read it takes longer than a chunk of messages."""
    return tuple(parse_qos(text))


@dataclass
class Salvage:
    """The readable rest of a bag; iterate over it to get topic, log time [ns] and bytes of each whole message.

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
    _qos: precheck.Qos = field(default_factory=precheck.Qos, repr=False)
    _described: int = 0  # characters of texts and definitions

    def __post_init__(self) -> None:
        self._files = files_of(self.path)
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
                self.damage.append(f"{file.name}: {shown(error)}")

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
        if len(self.damage) < _MOST_DAMAGE:
            self.damage.append(f"{file.name}: {shown(why)}")
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
        """The records of a file, or those of a chunk at byte ``inside`` of it."""
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
                if inside is not None:
                    self._lose(file, 0, len(content), f"chunk in the chunk at byte {inside}")
                    continue
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
                self._describe(len(schema.data))
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                self._channel(Channel.read(data), schemas, channels)
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(data)
                if metadata.name == "lathe_rc":
                    self._describe(sum(map(len, [*metadata.metadata, *metadata.metadata.values()])))
                    self.about |= metadata.metadata
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001 - mcap and rosbags raise whatever broken bytes lead to
            self._lose(file, 0, len(content), f"record of kind {opcode}: {shown(error)}")
        return None

    def _describe(self, length: int) -> None:
        """Count what is kept beside the messages."""
        if self._described + length > _MOST_DESCRIBED:
            raise ValueError(f"more than {_MOST_DESCRIBED} characters of texts and definitions")
        self._described += length

    def _channel(self, channel: Channel, schemas: dict[int, Schema], channels: dict[int, str]) -> None:
        schema = schemas[channel.schema_id]
        precheck.check_name(channel.topic)
        precheck.check_name(schema.name)
        self._qos.add(channel)
        qos = _profiles(channel.metadata.get("offered_qos_profiles", "") or "[]")
        digest = channel.metadata.get("topic_type_hash", "")
        self.topics[channel.topic] = Announced(schema.name, schema.data.decode(), digest, qos, channel.message_encoding)
        channels[channel.id] = channel.topic

    # ---- SQLite -------------------------------------------------------------------------------------

    def _sqlite(self, file: Path) -> Iterator[tuple[str, int, bytes]]:
        try:
            with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
                precheck.check_tables(base)
                names = self._sqlite_topics(base)
                rows = base.execute(
                    "SELECT topic_id, timestamp, data FROM messages WHERE length(data) <= ? ORDER BY id", (MOST_BYTES,)
                )
                for number, log_ns, data in rows:
                    if number in names and isinstance(log_ns, int) and log_ns >= 0 and isinstance(data, bytes):
                        yield names[number], log_ns, data
        except (LatheError, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001 - SQLite and rosbags raise whatever broken bytes lead to
            self._lose(file, 0, 0, shown(error))

    def _sqlite_topics(self, base: sqlite3.Connection) -> dict[int, str]:
        names: dict[int, str] = {}
        try:
            rows = base.execute("SELECT topic_type, encoded_message_definition FROM message_definitions")
            defined = {kind: text for kind, text in rows.fetchmany(MOST_TOPICS) if isinstance(text, str)}
        except sqlite3.Error:
            defined = {}  # bags of older ROS have none
        try:
            listed = base.execute("SELECT id, name, type, serialization_format, offered_qos_profiles FROM topics")
        except sqlite3.Error:  # those of the oldest do not have that either
            listed = base.execute("SELECT id, name, type, serialization_format, '' FROM topics")
        for number, name, kind, encoding, qos in listed.fetchmany(MOST_TOPICS):
            precheck.check_name(name)
            precheck.check_name(kind)
            text = qos if isinstance(qos, str) else ""
            precheck.check_yaml(text, "offered_qos_profiles")
            definition = defined.get(kind, "")
            self._describe(len(definition) + len(text))
            names[number] = name
            self.topics[name] = Announced(kind, definition, "", _profiles(text), str(encoding))
        return names
