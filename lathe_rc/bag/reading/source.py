# SPDX-License-Identifier: Apache-2.0
"""Opening bags, whoever made them: rosbag2 folders of any storage and compression that rosbags reads, or an MCAP file.

Nothing in a bag is trusted: what it says of sizes is checked before anything of that size is made.
"""

import heapq
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import chain, pairwise
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel
from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import Reader

from lathe_rc.bag.reading import precheck
from lathe_rc.bag.reading.chunk_messages import Places, walk
from lathe_rc.bag.reading.precheck import MOST_TEXT, MOST_TOPICS, read_record
from lathe_rc.bag.reading.unpacking import read_chunk, unpack, unpack_file, unpacked_size
from lathe_rc.cell.block import Block
from lathe_rc.cell.wire import Decoder
from lathe_rc.errors import InputError, LatheError, shown

Message = tuple[str, int, bytes]  #: topic, log time [ns] and bytes

_NEVER = 2**64  # log time after all others [ns]
_CHANNELS = 2**16  # numbers that a channel may have
_AT_ONCE = 2**14  # messages of a batch
_SQLITE = b"SQLite format 3\0"
_METADATA = "metadata.yaml"
_KINDS = (".mcap", ".db3", ".zstd")
_RECOVER = "; lathe bag recover saves the rest"


@dataclass(frozen=True)
class Batch:
    """Messages that stand in the same bytes.

    Attributes:
        whole: the bytes.
        topics: by channel.
        places: channel, log time [ns], begin and end of each message, shape (messages, 4).
    """

    whole: bytes
    topics: Mapping[int, str]
    places: Places

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.places)

    def __iter__(self) -> Iterator[Message]:
        """Topic, log time [ns] and bytes of each."""
        for channel, log_ns, begin, end in self.places.tolist():
            yield self.topics[channel], log_ns, self.whole[begin:end]

    @classmethod
    def of(cls, message: Message) -> "Batch":
        """A batch of one."""
        topic, log_ns, data = message
        return cls(data, {0: topic}, np.array([[0, log_ns, 0, len(data)]], np.uint64))


@dataclass(frozen=True)
class Topic:
    """The bag's metadata of a topic.

    Attributes:
        type: message type.
        qos: offered by the publishers.
        count: messages.
    """

    type: str
    qos: tuple[Qos, ...]
    count: int


def files_of(path: Path) -> list[Path]:
    """The files with the messages of a bag, by name: those of a folder, or the one that is named.

    Raises:
        InputError: a file that is read is a link that leads out of the folder.
    """
    found = [path] if path.is_file() else [*path.glob("*")]
    for file in found:
        read = file.suffix in _KINDS or file.name in (_METADATA, "digests.json")
        if read and file != path and not file.resolve().is_relative_to(path.resolve()):
            raise InputError(f"{file}: a link that leads out of the bag; allowed: the file itself in its place")
    return sorted(file for file in found if file.suffix in _KINDS and file.is_file())


def _damage(path: Path) -> str:
    """The first record of an MCAP file that is longer than it says or than allowed, and its place; empty: none."""
    limit = path.stat().st_size - len(MCAP0_MAGIC)
    qos = precheck.Qos()
    with path.open("rb") as stream:
        head = stream.read(len(MCAP0_MAGIC))
        if head != MCAP0_MAGIC:
            return "" if precheck.is_packed(head) else f"{path.name}: not an MCAP file"
        place = stream.tell()
        try:
            while (record := read_record(stream, limit)) and record[0] != Opcode.FOOTER:
                if record[0] == Opcode.CHUNK:
                    whole = read_chunk(record[1], place)
                    inside = BytesIO(whole)
                    while inner := read_record(inside, len(whole)):
                        _add_qos(qos, *inner)
                _add_qos(qos, *record)
                place = stream.tell()
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001 - mcap raises whatever broken bytes lead to
            return f"{path.name}: {shown(error)}"
    return ""


def _add_qos(qos: precheck.Qos, opcode: int, content: bytes) -> None:
    if opcode == Opcode.CHANNEL:
        qos.add(Channel.read(ReadDataStream(BytesIO(content))))


def _check_storage(path: Path) -> None:
    """Refuse a file that a library could not read in bounded memory and time; others than those of bags pass.

    Raises:
        ValueError: says why; mcap and SQLite raise others.
    """
    with path.open("rb") as stream:
        head = stream.read(len(_SQLITE))
    if precheck.is_packed(head):
        with tempfile.TemporaryDirectory(prefix="lathe-unpacked-") as folder:
            plain = Path(folder) / path.stem
            with plain.open("wb") as out:
                out.writelines(unpack_file(path))
            with plain.open("rb") as stream:
                if precheck.is_packed(stream.read(len(_SQLITE))):
                    raise ValueError(f"{path.name} is compressed twice")
            _check_storage(plain)
    elif head == _SQLITE:
        precheck.check_database(path)
    elif head.startswith(MCAP0_MAGIC) and not precheck.summary_of(path) and (why := _damage(path)):
        raise ValueError(why)


def _batches(whole: bytes, topics: Mapping[int, str], start_ns: int, stop_ns: int) -> Iterator[Batch]:
    """The wanted messages among the records of a chunk, by log time."""
    found = walk(whole)
    wanted = np.zeros(_CHANNELS, dtype=bool)
    wanted[list(topics)] = True
    found = found[wanted[found[:, 0]]]
    if start_ns or stop_ns < _NEVER:
        found = found[(found[:, 1] >= start_ns) & (found[:, 1] < stop_ns)]
    if np.any(found[1:, 1] < found[:-1, 1]):
        found = found[np.argsort(found[:, 1], kind="stable")]
    for first in range(0, len(found), _AT_ONCE):
        yield Batch(whole, topics, found[first : first + _AT_ONCE])


class Source:
    """A bag that is read; a context manager.

    Args:
        path: a rosbag2 folder or an MCAP file.

    Attributes:
        path: see above.
        topics: by name.
        about: texts that the bag says of itself, see docs/bags.md.
        first_ns, last_ns: smallest and largest log time; 0 and 0 if it is empty.
        contradictions: where metadata.yaml says other than the files hold, one line each; the files count.

    Raises:
        InputError: not a bag, or one that cannot be whole.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._check_files()
            self._reader = Reader(path)
            self._reader.open()
        except (LatheError, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001 - the libraries raise whatever broken bytes lead to
            why, files = shown(error), files_of(path)
            for file in files:
                why = (file.suffix == ".mcap" and _damage(file)) or why
            raise InputError(f"{path}: not a readable bag ({why}){_RECOVER if files else ''}") from None
        try:
            self._read_head()
        except (LatheError, MemoryError):
            self._reader.close()
            raise
        except Exception as error:  # noqa: BLE001 - see above
            self._reader.close()
            raise InputError(f"{path}: not a readable bag ({shown(error)})") from None

    def _check_files(self) -> None:
        """Look at what the libraries would believe.

        Raises:
            InputError: metadata that is too long.
            ValueError: there is nothing, or see `_check_storage`.
        """
        if not self.path.exists():
            raise ValueError("there is no such folder or file")
        found = files_of(self.path)
        if self.path.is_dir():
            metadata = self.path / _METADATA
            if not metadata.exists():
                lack = "" if found else ", nor a .mcap or .db3 file"
                raise ValueError(f"no {_METADATA} in that folder{lack}")
            if metadata.stat().st_size > MOST_TEXT * 16:
                raise InputError(f"{metadata}: {metadata.stat().st_size} B; allowed: up to {MOST_TEXT * 16}")
            precheck.check_yaml(metadata.read_text(encoding="utf-8"), _METADATA)
        for file in sorted(self.path.iterdir()) if self.path.is_dir() else [self.path]:
            if file.is_file():
                _check_storage(file)
            elif file.exists() and not file.is_dir():
                raise ValueError(f"{file.name} is no file")  # opening a pipe would wait for its writer

    def _read_head(self) -> None:
        whole: Any = self._reader.storage
        self._storages: list[Any] = getattr(whole, "storages", [whole])
        self._packed = self._reader.compression_mode == "message"
        self.topics = self._topics_of(self._reader.connections)
        custom: Any = getattr(whole.metadata, "custom", None) or {}
        texts = {key: text for key, text in custom.items() if isinstance(key, str) and isinstance(text, str)}
        self.about: Mapping[str, str] = {key[:256]: text[:MOST_TEXT] for key, text in texts.items()}
        spans = [each.metadata for each in self._storages if each.metadata.message_count]
        self.first_ns = min((precheck.number(span.start_time) for span in spans), default=0)
        self.last_ns = max((precheck.number(span.end_time) for span in spans), default=1) - 1
        self.contradictions = self._believe_the_files()

    def _believe_the_files(self) -> list[str]:
        """Take the numbers of messages from the files; tells where metadata.yaml says something else."""
        wrong: list[tuple[str, int]] = []
        if self._reader.message_count and self.last_ns:
            told = precheck.number(self._reader.start_time), precheck.number(self._reader.end_time) - 1
            held = zip(("first", "last"), told, (self.first_ns, self.last_ns), strict=True)
            wrong += [(f"{which} message at {said} ns", found) for which, said, found in held if said != found]
        connections = [each for storage in self._storages for each in storage.connections]
        counted = sum(each.msgcount for each in connections)
        if counted == sum(each.metadata.message_count for each in self._storages):  # an index may leave them out
            found = self._topics_of(connections)
            for topic, said in {**found, **self.topics}.items():
                told_of = self.topics[topic].count if topic in self.topics else 0
                count = found[topic].count if topic in found else 0
                wrong += [(f"{told_of} messages of {topic}", count)] if told_of != count else []
                self.topics[topic] = replace(said, count=count)
        return [f"{_METADATA} says {said}; the files: {found}" for said, found in wrong]

    def _topics_of(self, connections: Sequence[Connection]) -> dict[str, Topic]:
        """The topics by a file, or by the metadata."""
        found: dict[str, Topic] = {}
        for connection in connections:
            precheck.check_name(connection.topic)
            precheck.check_name(connection.msgtype)
            ext: Any = connection.ext
            known = found.get(connection.topic)
            count = precheck.number(connection.msgcount) + (known.count if known else 0)
            found[connection.topic] = Topic(connection.msgtype, tuple(ext.offered_qos_profiles), count)
        if len(found) > MOST_TOPICS:
            raise InputError(f"{self.path}: {len(found)} topics; allowed: up to {MOST_TOPICS}")
        return found

    def __enter__(self) -> "Source":
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self._reader.close()

    def _chunks(self, storage: Any, topics: Mapping[int, str], start_ns: int, stop_ns: int) -> Iterator[Batch]:
        """Messages of the wanted connections of an MCAP file, by its index."""
        chunks = [
            chunk
            for chunk in storage.chunks
            if chunk.message_end_time >= start_ns
            and chunk.message_start_time < stop_ns
            and (not chunk.message_index_offsets or topics.keys() & chunk.message_index_offsets.keys())
        ]
        with Path(str(storage.path)).open("rb") as stream:

            def read(chunk: Any) -> Iterator[Batch]:
                stream.seek(chunk.chunk_start_offset)
                record = read_record(stream, chunk.chunk_start_offset + chunk.chunk_length)
                whole = read_chunk(record[1] if record else b"", chunk.chunk_start_offset)
                return _batches(whole, topics, start_ns, stop_ns)

            def late(chunk: Any) -> Iterator[Message]:
                yield "", chunk.message_start_time, b""  # a chunk is not read before its time
                yield from chain.from_iterable(read(chunk))

            if all(a.message_end_time <= b.message_start_time for a, b in pairwise(chunks)):
                for chunk in chunks:
                    yield from read(chunk)
                return
            for message in heapq.merge(*map(late, chunks), key=itemgetter(1)):
                if message[0]:
                    yield Batch.of(message)

    def blocks(self, topic: str, *, start_ns: int | None = None) -> Iterator[Block]:
        """The blocks of a dense topic, from a log time [ns] on.

        Raises:
            InputError: see `messages`.
            LatheError: a block is broken.
        """
        decoder = Decoder(self.topics[topic].type)
        for _, _, data in self.messages({topic}, start_ns=start_ns):
            try:
                yield decoder.decode(data)
            except ValueError as error:
                raise LatheError(f"{self.path}: {topic}: {shown(error)}") from None

    def step_ns(self, topic: str) -> int:
        """Sampling step of a dense topic [ns], as its first block says; 0 if it has none.

        Raises:
            InputError: see `messages`.
            LatheError: the block is broken.
        """
        return next((block.step_ns for block in self.blocks(topic)), 0)

    def messages(
        self, topics: set[str] | None = None, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Message]:
        """Topic, log time [ns] and bytes of each message, in the order of log times; see `batches`."""
        return chain.from_iterable(self.batches(topics, start_ns=start_ns, stop_ns=stop_ns))

    def batches(
        self, topics: set[str] | None = None, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Batch]:
        """Messages in the order of log times, as many at a time as come handy.

        Args:
            topics: those wanted; None: all.
            start_ns: log times from this on [ns].
            stop_ns: log times before this [ns].

        Raises:
            InputError: the bag is broken where the next message should be.
        """
        names = set(self.topics) if topics is None else topics & set(self.topics)
        try:
            for storage in self._storages:
                wanted = [c for c in storage.connections if c.topic in names]
                if not wanted:
                    continue
                if getattr(storage, "chunks", None):
                    channels = {c.id: c.topic for c in wanted}
                    found = self._chunks(storage, channels, start_ns or 0, _NEVER if stop_ns is None else stop_ns)
                else:
                    single = storage.messages(wanted, start=start_ns, stop=stop_ns)
                    found = (Batch.of((connection.topic, log_ns, data)) for connection, log_ns, data in single)
                yield from chain.from_iterable(map(self._unpacked, found)) if self._packed else found
        except (LatheError, MemoryError):
            raise
        except Exception as error:  # noqa: BLE001 - the libraries raise whatever broken bytes lead to
            raise InputError(f"{self.path}: broken ({shown(error)}){_RECOVER}") from None

    def _unpacked(self, batch: Batch) -> Iterator[Batch]:
        """Messages that are compressed one by one; rosbags would unpack each to whatever size it says."""
        for topic, log_ns, data in batch:
            yield Batch.of((topic, log_ns, unpack("zstd", data, unpacked_size(data[:18]))))
