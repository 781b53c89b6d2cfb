# SPDX-License-Identifier: Apache-2.0
"""Reader of all valid messages in a bag that is truncated or damaged in places.

Bytes are copied without decoding: schemas, channels and messages keep every byte except their IDs.
"""

import sqlite3
import struct
import tempfile
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema, Statistics

from lathe_rc import messages
from lathe_rc.bag.reading import metadata
from lathe_rc.bag.reading.limits import MOST_BYTES, MOST_METADATA, MOST_TEXT, MOST_TOPICS
from lathe_rc.bag.reading.metadata import check_name, qos_of_text
from lathe_rc.bag.reading.seal import LIBRARY, FileSeal
from lathe_rc.bag.reading.sealed_metadata import Agreement, compare
from lathe_rc.bag.reading.sound_records import SoundRecords, Told, parsed
from lathe_rc.bag.reading.source import files_of
from lathe_rc.bag.reading.sqlite_storage import check_tables, connect, left_over, select, with_journal
from lathe_rc.bag.reading.unpacking import unpack, unpack_file, unpacked_size
from lathe_rc.bag.writing.mcap_file import channel_content, schema_content
from lathe_rc.bag.writing.writer import Topic, definition
from lathe_rc.errors import InputError, shown

ROS2 = "ros2"  #: profile of rosbag2 files

_MESSAGE = struct.Struct("<IQQ")  # sequence, log time and publish time, before a message's data
_ZSTD = b"\x28\xb5\x2f\xfd"  # first bytes of an individually compressed message; CDR begins with a zero
_PAGE = 4096  # bytes of a database reported as lost when SQLite does not state how many
_MOST_ID_BITS = 62  # maximum size of a row ID [bit]
_MOST_DAMAGE = 1000  # maximum number of places reported
_SCHEMALESS = "__schemaless__"  # type of messages without a schema, as in rosbags


class Message(NamedTuple):
    """Recovered message with its topic; times in ns."""

    topic: Topic
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


class _Definition(NamedTuple):
    """Schema or channel record, and whether a checksum confirms it."""

    content: bytes
    checked: bool


@dataclass
class Salvage:
    """Readable content of a damaged bag; iteration yields each intact message.

    Args:
        path: rosbag2 folder, or a single file from one.

    Attributes:
        copied: callback for the opcode and content of each attachment, and of metadata from other software.
        topics: all topics that can be copied.
        profile: profile of the MCAP files.
        about: strings from the bag's metadata; those under its seal, once all messages have been read.
        origin: in words, the seal of the bag or the lack of one; empty for bags of other recorders.
        damage: kind and location of the damage, one line per damaged place.
        lost_bytes: number of bytes in the files that yielded no message.
        saved: number of recovered messages, set by `recover`.
        skipped: number of messages on topics that cannot be copied.
        missing: number of messages that the bag counts but that were not found.
        lossy: whether messages are missing, or may be wrong.

    Raises:
        InputError: there is no bag file at the path.
    """

    path: Path
    copied: Callable[[int, bytes], None] = lambda _opcode, _content: None
    topics: dict[Topic, None] = field(default_factory=dict)
    about: dict[str, str] = field(default_factory=dict)
    origin: str = ""
    damage: list[str] = field(default_factory=list)
    lost_bytes: int = 0
    saved: int = 0
    skipped: int = 0
    missing: int = 0
    lossy: bool = False
    _described: int = 0  # total length of strings and definitions [characters]
    _counted: int | None = None  # number of messages stated in the file being read
    _ended: bool = True  # whether that file is complete
    _seals: dict[str, FileSeal] = field(default_factory=dict)  # by file

    def __post_init__(self) -> None:
        self._files = files_of(self.path)
        if not self._files:
            raise InputError(f"{self.path}: no bag; allowed: a folder with .mcap or .db3 files, or such a file")
        self._metadata = self._read_metadata()
        header = self._header(self._files[0])
        self.profile, self._is_ours = header.profile, header.library == LIBRARY

    def _read_metadata(self) -> metadata.Metadata | None:
        """Return the metadata of a folder; None if they are missing or unreadable."""
        if not (self.path / metadata.NAME).exists():
            return None
        try:
            told = metadata.read(self.path)
            self._describe(told.about)
        except ValueError as error:
            self._tell(shown(error))
            return None
        return told

    def _header(self, file: Path) -> Header:
        """Return the header of an MCAP file; that of a file of rosbag2 if there is none."""
        unknown = Header(ROS2, "")
        if file.suffix != ".mcap":
            return unknown
        with file.open("rb") as stream:
            size = min(file.stat().st_size, MOST_TEXT)
            first = next(iter(SoundRecords(stream, size, lambda _why, _lost: None)), None)
        if first is None or first.opcode != Opcode.HEADER:
            return unknown
        return parsed(Header, first.content)

    def __iter__(self) -> Iterator[Message]:
        """Yield the intact messages in the order of the files."""
        packed = self._metadata is not None and self._metadata.packed
        read, complete = 0, True
        for file in self._files:
            lost, skipped, found = self.lost_bytes, self.skipped, 0
            self._counted, self._ended = None, True
            for message in self._file(file):
                found += 1
                if message.data.startswith(_ZSTD) and (packed or message.topic.encoding == "cdr"):
                    yield from self._unpacked(file, message)
                else:
                    yield message
            found += self.skipped - skipped
            read += found
            complete &= (self.lost_bytes == lost and self._ended) or self._counted == found
            self._miss(file.name, self._counted, found)
        told = sum(topic.count for topic in self._metadata.topics.values()) if self._metadata else None
        self._miss(metadata.NAME, told, read)
        self.lossy |= bool(self.missing or self.skipped) or not (complete or told == read)
        self._take_seal()

    def _take_seal(self) -> None:
        """Replace the strings of the metadata by the sealed ones, if the bag has a seal that holds."""
        try:
            found = compare(self._metadata, self._seals, whole=self.path.is_dir())
        except ValueError:
            found = Agreement(None, None)
        if found.seal is None or found.metadata is None:
            self.origin = "a bag without a seal that holds" if self._is_ours else ""
            return
        for what in found.strangers + found.changes:
            self._tell(what)
        self.about = dict(found.metadata.about)
        self.origin = f"the bag with seal {found.seal}" + ", of which files were exchanged" * bool(found.strangers)
        self.lossy |= bool(found.strangers)

    def _miss(self, name: str, counted: int | None, read: int) -> None:
        if counted is not None and counted > read:
            self._tell(f"{name} counts {counted} messages, {counted - read} more than there are")
            self.missing = max(self.missing, counted - read)

    def _unpacked(self, file: Path, message: Message) -> Iterator[Message]:
        """Yield an individually compressed message in its uncompressed form."""
        try:
            yield message._replace(data=unpack("zstd", message.data, unpacked_size(message.data[:18])))
        except ValueError as error:
            self._lose(file, f"{message.topic.name} at {message.log_ns} ns: {error}", len(message.data))
            self.lossy = True

    def _file(self, file: Path) -> Iterator[Message]:
        if file.suffix != ".zstd":
            yield from (self._mcap if file.suffix == ".mcap" else self._sqlite)(file)
            return
        with tempfile.TemporaryDirectory(prefix="lathe-salvage-") as folder:
            unpacked = Path(folder) / file.stem
            self._unpack(file, unpacked)
            yield from self._file(unpacked)

    def _unpack(self, file: Path, unpacked: Path) -> None:
        """Unpack a file that is compressed as a whole, up to the first damage."""
        with unpacked.open("wb") as out:
            try:
                out.writelines(unpack_file(file))
            except ValueError as error:
                raise InputError(f"{file}: {error}") from None
            except zstandard.ZstdError as error:
                self._tell(f"{file.name}: {shown(error)}")

    def _tell(self, what: str) -> None:
        if len(self.damage) < _MOST_DAMAGE:
            self.damage.append(what)

    def _lose(self, file: Path, why: str, size: int) -> None:
        self._tell(f"{file.name}: {shown(why)}")
        self.lost_bytes += size

    def count(self, length: int) -> None:
        """Count the characters of content kept in addition to the messages.

        Raises:
            ValueError: the total exceeds the limit.
        """
        if self._described + length > MOST_METADATA:
            raise ValueError(f"more than {MOST_METADATA} characters of texts and definitions")
        self._described += length

    def _describe(self, about: Mapping[str, str]) -> None:
        """Add strings from the metadata of the bag."""
        self.count(sum(map(len, [*about, *about.values()])))
        self.about |= about

    def add(self, topic: Topic, offered: str) -> Topic:
        """Announce a topic; its QoS profiles are copied even if they cannot be parsed.

        Raises:
            ValueError: the topic cannot be copied.
        """
        check_name(topic.name)
        try:
            topic = topic._replace(qos=qos_of_text(offered))
        except ValueError as error:
            self._tell(f"{topic.name}: quality of service that is copied, not understood ({shown(error)})")
        if len(self.topics) >= MOST_TOPICS and topic not in self.topics:
            raise ValueError(f"more than {MOST_TOPICS} topics")
        self.topics[topic] = None
        return topic

    # ---- MCAP ---------------------------------------------------------------------------------------

    def _mcap(self, file: Path) -> Iterator[Message]:
        told = partial(self._lose, file)
        with file.open("rb") as stream:
            sound = SoundRecords(stream, file.stat().st_size, told)
            sound.check_sums()
            known, unchecked = _Definitions(self, sound), 0
            sealed = self._seals[file.name] = FileSeal()
            for record in () if sound.summary_wrong else sound.summary():
                known.add(record.opcode, record.content, checked=record.checked)
            for record in sound:
                with suppress(ValueError, struct.error, EndOfFile):
                    sealed.take(record.opcode, record.content)
                if record.opcode == Opcode.STATISTICS and not sound.summary_wrong:
                    self._counted = parsed(Statistics, record.content).message_count
                for content, found in sound.inside(record):
                    for opcode, begin, end in found.others.tolist():
                        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                            known.add(opcode, content[begin:end], checked=record.checked)
                        else:
                            self._other(opcode, content[begin:end], 0 if sound.ended else end - begin, told)
                    for number, log_ns, begin, end in found.messages.tolist():
                        if topic := known.topics.get(number) or known.topic_of(number):
                            sequence, _, publish_ns = _MESSAGE.unpack_from(content, begin - _MESSAGE.size)
                            yield Message(topic, sequence, log_ns, publish_ns, content[begin:end])
                            unchecked += not record.checked
            known.finish()
            self._ended = sound.ended
            if unchecked and sound.data_wrong:
                self._tell(f"{file.name}: {unchecked} messages have no checksum of their own; some may be wrong")
                self.lossy = True

    def _other(self, opcode: int, content: bytes, lost: int, told: Told) -> None:
        """Process a record that is not a message, schema or channel."""
        try:
            if opcode == Opcode.METADATA:
                metadata = parsed(Metadata, content)
                if metadata.name.partition(" ")[0] == "lathe_rc":  # the further records are numbered
                    self._describe(metadata.metadata)
                elif metadata.name != "rosbag2":  # the new bag has its own
                    self.copied(opcode, content)
            elif opcode == Opcode.ATTACHMENT:
                self.copied(opcode, content)
            elif opcode == Opcode.CHUNK:
                raise ValueError("a chunk in the chunk")  # noqa: TRY301
            elif opcode > Opcode.DATA_END:
                raise ValueError("it is not copied")  # noqa: TRY301
        except ValueError as error:
            told(f"record of kind {opcode}: {error}", lost)

    # ---- SQLite -------------------------------------------------------------------------------------

    def _sqlite(self, file: Path) -> Iterator[Message]:
        strange = 0
        try:
            with ExitStack() as stack:
                folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="lathe-salvage-"))
                database, left = with_journal(file, Path(folder))
                if left:
                    self._lose(file, left_over(left), left)
                base = stack.enter_context(closing(connect(database)))
                with suppress(sqlite3.DatabaseError):  # caused by a damaged page; the other pages are read below
                    check_tables(base)
                topics = self._sqlite_topics(file, base)
                for number, log_ns, data in _readable_rows(base, partial(self._lose, file)):
                    topic = topics.get(number)
                    if topic and isinstance(log_ns, int) and log_ns >= 0 and isinstance(data, bytes):
                        yield Message(topic, 0, log_ns, log_ns, data)
                    else:
                        strange += 1
            if strange:
                self.skipped += strange
                self._tell(f"{file.name}: {strange} messages without a topic, a time or bytes that can be copied")
        except (sqlite3.Error, ValueError) as error:
            self._lose(file, str(error), file.stat().st_size)

    def _sqlite_topics(self, file: Path, base: sqlite3.Connection) -> dict[Any, Topic]:
        """Return the topics of a SQLite file by number."""
        definitions = select(base, "message_definitions", ("topic_type", "encoding", "encoded_message_definition"))
        defined = {kind: (encoding, text) for kind, encoding, text in definitions}
        names = ("id", "name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash")
        topics: dict[Any, Topic] = {}
        for number, name, kind, encoding, offered, digest in select(base, "topics", names):
            try:
                check_name(kind)
                known_text, known = definition(kind) if kind in messages.store().fielddefs else ("", "")
                how, text = defined.get(kind, ("ros2msg" if known_text else "", known_text))
                self.count(len(text) + len(offered))
                said = {"offered_qos_profiles": offered, "topic_type_hash": digest or known}
                schema, channel = schema_content(kind, how, text.encode()), channel_content(name, encoding, said)
                topics[number] = self.add(Topic(name, kind, encoding, (), digest or known, schema, channel), offered)
            except ValueError as error:
                self._tell(f"{file.name}: {shown(name)}: {error}")
        return topics


class _Definitions:
    """Schemas and channels of an MCAP file, wherever they are located."""

    def __init__(self, salvage: Salvage, sound: SoundRecords) -> None:
        self._salvage, self._sound = salvage, sound
        self._known: dict[tuple[int, int], _Definition] = {}
        self.topics: dict[int, Topic] = {}  #: topics of the messages so far, by channel number
        self._lost: Counter[str] = Counter()  # number of messages not copied, by reason
        self._why: dict[int, str] = {}
        self._searched = False

    def add(self, opcode: int, content: bytes, *, checked: bool) -> None:
        """Add a schema or channel record; of contradictory records, the last one with a checksum is used."""
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return
        key = opcode, int.from_bytes(content[:2], "little")
        before = self._known.get(key)
        if before is None or before.content == content:
            self._known[key] = _Definition(content, checked or (before is not None and before.checked))
            return
        equals = checked == before.checked
        kind = Opcode(opcode).name.lower()
        self._sound.told(f"{kind} {key[1]} is described in two ways", len(content) if equals else 0)
        if checked or equals:
            self._known[key] = _Definition(content, checked)
            self.topics.clear()

    def _find(self, opcode: int, number: int) -> bytes | None:
        """Return the content of a schema or channel record; if it is not known yet, search the whole file once."""
        key = opcode, number
        if key not in self._known and not self._searched:
            self._searched = True
            told, self._sound.told = self._sound.told, lambda _why, _lost: None
            for record in self._sound:
                for content, found in self._sound.inside(record):
                    for kind, begin, end in found.others.tolist():
                        if (kind, int.from_bytes(content[begin : begin + 2], "little")) not in self._known:
                            self.add(kind, content[begin:end], checked=record.checked)
            self._sound.told = told
        return self._known[key].content if key in self._known else None

    def topic_of(self, number: int) -> Topic | None:
        """Return the topic of a message's channel; None if the topic cannot be copied."""
        if number not in self._why:
            try:
                content = self._find(Opcode.CHANNEL, number)
                if content is None:
                    raise ValueError(f"channel {number} is described nowhere")  # noqa: TRY301
                topic = self.topics[number] = self._made(content)
            except MemoryError:
                raise
            except Exception as error:  # noqa: BLE001 - mcap can raise any exception on damaged bytes
                self._why[number] = shown(error)
            else:
                return topic
        self._lost[self._why[number]] += 1
        return None

    def _made(self, content: bytes) -> Topic:
        channel = parsed(Channel, content)
        name, schema, kind = shown(channel.topic), None, _SCHEMALESS
        if channel.schema_id:
            schema = self._find(Opcode.SCHEMA, channel.schema_id)
            if schema is None:
                self._sound.told(f"{name}: schema {channel.schema_id} is described nowhere", 0)
            else:
                kind = parsed(Schema, schema).name or _SCHEMALESS
                check_name(kind)
        self._salvage.count(len(content) + len(schema or b""))
        digest = channel.metadata.get("topic_type_hash", "")
        topic = Topic(channel.topic, kind, channel.message_encoding, (), digest, schema, content)
        return self._salvage.add(topic, channel.metadata.get("offered_qos_profiles", ""))

    def finish(self) -> None:
        """Announce the channels without messages, and report the messages that are not copied."""
        for opcode, number in list(self._known):
            new = opcode == Opcode.CHANNEL and number not in self.topics and number not in self._why
            if new and self.topic_of(number) is None:
                self._lost[self._why[number]] -= 1
        self._salvage.skipped += self._lost.total()
        for why, count in self._lost.items():
            self._sound.told(f"{why}: {count} messages of it are not copied", 0)


def _readable_rows(base: sqlite3.Connection, told: Told) -> Iterator[tuple[Any, Any, Any]]:
    """Yield the topic, time and bytes of each message on an intact page; the bytes are None if they are too long."""
    query = (
        f"SELECT id, topic_id, timestamp, CASE WHEN length(data) <= {MOST_BYTES} THEN data END"  # noqa: S608 - a constant
        " FROM messages WHERE id >= ? ORDER BY id"
    )
    first = 0

    def readable(step: int) -> bool:
        try:
            base.execute(f"{query} LIMIT 1", (first + step,)).fetchone()
        except sqlite3.DatabaseError:
            return False
        return True

    while True:
        try:
            for number, *row in base.execute(query, (first,)):
                yield row[0], row[1], row[2]
                first = number + 1
        except sqlite3.DatabaseError as error:
            told(f"from message {first} on: {error}", _PAGE)
        else:
            return
        # The first row after a damaged page is located by doubling, then by bisection: row IDs have gaps of any length.
        step = next((2**k for k in range(_MOST_ID_BITS) if readable(2**k)), None)
        if step is None:
            return
        first += bisect_left(range(step), 1, lo=step // 2, key=readable)
