# SPDX-License-Identifier: Apache-2.0
"""Writer of rosbag2 folders: an MCAP file, and its metadata in the layout of the rosbags package.

The storage of rosbags' own writer offers neither a chunk size nor a flush, both of which are needed to limit the loss
in a crash; `lathe_rc.bag.writing.mcap_file` offers them. The YAML writer of rosbags takes 0.2 s per bag and would delay
the recorded cell for that long; libyaml takes a few ms.
"""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import yaml
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2.metadata import dump_qos_v9

from lathe_rc import messages
from lathe_rc.bag.reading import seal
from lathe_rc.bag.writing.mcap_file import McapFile, channel_content, schema_content
from lathe_rc.bag.writing.rows import RowPlan
from lathe_rc.errors import InputError, LatheError

Compression = Literal["zstd", "none"]
Durability = Literal["volatile", "transient_local"]

FLUSH_PERIOD = 0.5  #: wall time after which a recorder writes messages out even if they do not fill a chunk [s]
_FOREVER = QosTime(9223372036, 854775807)
_UNKNOWN = 64 * "0"  # hash of a type from a middleware that has none; readers would compare it
_NEVER = 2**63 - 1  # start of a bag without messages, as written by rosbags [ns]


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]  # absent without libyaml
    """YAML dumper that quotes all strings, so that no reader of any YAML version parses one as a number."""

    def ignore_aliases(self, data: object) -> bool:
        """Disable YAML aliases, so that equal subtrees are written out each time, as rosbags does."""
        return True


_Dumper.add_representer(str, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"'))


def _yaml(tree: Any) -> str:
    return str(yaml.dump(tree, None, _Dumper, default_flow_style=False, allow_unicode=True))


class Topic(NamedTuple):
    """Channel of a bag; the byte fields hold the raw record contents, including the leading IDs.

    Attributes:
        name: name of the topic.
        type: message type; may be empty.
        encoding: serialization of the messages.
        qos: profiles of the publishers, as far as they can be parsed.
        digest: hash of the message type; may be empty.
        schema: content of the schema record; None without a schema.
        channel: content of the channel record.
    """

    name: str
    type: str
    encoding: str
    qos: tuple[Qos, ...]
    digest: str
    schema: bytes | None
    channel: bytes


class MessageSink(Protocol):
    """Sink for the messages of a run: one bag, or a writer of several bags."""

    def tell(self, about: Mapping[str, str]) -> None:
        """Store strings in the metadata of the bag; see `BagWriter`."""

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a topic before its first message; see `BagWriter`."""

    def channel(self, topic: str) -> int:
        """Return the channel number of a topic in the file."""

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Append a message to an announced topic; see `BagWriter`."""

    def write_rows(self, plan: RowPlan, first_ns: int, data: bytes | memoryview) -> None:
        """Append rows of blocks of all dense topics; see `BagWriter`."""

    def flush(self) -> None:
        """Hand all messages written so far to the operating system; see `BagWriter`."""

    def close(self) -> None:
        """Complete the output and close it; see `BagWriter`."""


@cache
def definition(msgtype: str) -> tuple[str, str]:
    """Return the definition text and the hash of a message type that this package knows."""
    store = messages.store()
    return store.generate_msgdef(msgtype, ros_version=2)[0], store.hash_rihs01(msgtype)


def offered_qos(depth: int, durability: Durability) -> Qos:
    """Return the QoS profile that every lathe node offers: reliable, keep last."""
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if durability == "transient_local" else QosDurability.VOLATILE,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        avoid_ros_namespace_conventions=False,
    )


def refuse_existing(path: Path) -> None:
    """Reject a path at which no bag can be created.

    Raises:
        InputError: the path already exists, or its parent folder does not.
    """
    if path.exists():
        raise InputError(f"{path} exists; a bag is never overwritten: name another folder or remove it")
    if not path.absolute().parent.exists():
        raise InputError(f"{path}: there is no folder {path.parent}; make it, or name another one")


class _Part(NamedTuple):
    """File of a bag: name, messages by channel, first and last log time [ns], None without messages; data checksum."""

    name: str
    counts: Mapping[int, int]
    first_ns: int | None
    last_ns: int | None
    checksum: int = 0

    def span(self) -> dict[str, Any]:
        """Return start, duration and number of messages as in the metadata of a bag."""
        first = _NEVER if self.first_ns is None else self.first_ns
        return {
            "starting_time": {"nanoseconds_since_epoch": first},
            "duration": {"nanoseconds": max((self.last_ns or 0) - first, 0)},
            "message_count": sum(self.counts.values()),
        }


def _begun(path: Path, chunk_size: int, compression: Compression, profile: str) -> McapFile:
    """Return the first file of a bag in a new folder, which is removed if the file cannot be created."""
    try:
        return McapFile(path, chunk_size=chunk_size, compress=compression == "zstd", profile=profile)
    except OSError:
        shutil.rmtree(path.parent, ignore_errors=True)
        raise


class BagWriter:
    """Writer of one bag.

    Args:
        path: folder of the bag; must not exist yet.
        compression: compression of the chunks.
        chunk_size: size after which a chunk is written out [B]; a crash loses four at most.
        about: strings for the bag's metadata (see `tell`).
        profile: profile of the MCAP file.

    Attributes:
        split_ns: span of log time after which the next message begins another file [ns]; 0: one file. It may change
            at any time.

    Raises:
        InputError: the folder exists, or cannot be created.
    """

    def __init__(
        self,
        path: Path,
        *,
        compression: Compression,
        chunk_size: int,
        about: Mapping[str, str],
        profile: str = "ros2",
    ) -> None:
        refuse_existing(path)
        self._path, self._name = path, f"{path.name}.mcap"
        self.split_ns = 0
        self._parts: list[_Part] = []
        self._began_ns: int | None = None  # log time of the first message in the file
        try:
            path.mkdir(mode=0o755)
            self._file = _begun(path / self._name, chunk_size, compression, profile)
        except OSError as error:
            raise InputError(f"{path}: cannot be made ({error.strerror})") from None
        self._is_gone = False  # the folder, of a bag whose first bytes could not be written
        self._about: dict[str, str] = {}
        # Channels with equal name, type, encoding and QoS share an entry in the metadata: the first, and all numbers.
        self._topics: dict[tuple[object, ...], tuple[Topic, list[int]]] = {}
        self._channels: dict[str, int] = {}  # channels of the written topics, by topic
        self._schemas: dict[bytes | None, int] = {}  # by content of the record
        self.tell(about)

    @contextmanager
    def _on_disk(self) -> Iterator[None]:
        """Convert disk I/O errors into a one-line `LatheError`, and remove a bag in which nothing is recorded yet."""
        try:
            yield
        except OSError as error:
            self._is_gone = self._file.first_ns is None and not self._parts
            if self._is_gone:
                self.abort()
                shutil.rmtree(self._path, ignore_errors=True)
            before = "" if self._is_gone else "what was recorded before is readable: "
            raise LatheError(f"{self._path}: cannot write ({error.strerror}); {before}make room") from None

    def tell(self, about: Mapping[str, str]) -> None:
        """Store strings in the bag's metadata: in the file at once (crash-safe), and in metadata.yaml at the end.

        Raises:
            LatheError: writing to the disk fails.
        """
        self._about.update(about)
        if about:
            with self._on_disk():
                self._file.add_metadata("lathe_rc", about)

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a fully qualified topic of a type that this package knows."""
        text, digest = definition(msgtype)
        self.copy_topic(topic, msgtype, [qos], definition=text, digest=digest)

    def copy_topic(self, topic: str, msgtype: str, qos: Sequence[Qos], *, definition: str, digest: str) -> None:
        """Announce a topic of a type that this package may not know, with the text and hash of its definition."""
        said = {"offered_qos_profiles": _yaml(dump_qos_v9(list(qos))).strip(), "topic_type_hash": digest}
        schema, channel = schema_content(msgtype, "ros2msg", definition.encode()), channel_content(topic, "cdr", said)
        self._channels[topic] = self.copy_channel(Topic(topic, msgtype, "cdr", tuple(qos), digest, schema, channel))

    def copy_channel(self, topic: Topic) -> int:
        """Announce a topic, also of another bag, whether or not its records can be decoded.

        Returns:
            Channel number to pass to `copy`.
        """
        if topic.schema not in self._schemas:
            self._schemas[topic.schema] = self._file.add_schema(topic.schema) if topic.schema is not None else 0
        number = self._file.add_channel(topic.channel, self._schemas[topic.schema])
        self._topics.setdefault(topic[:4], (topic, []))[1].append(number)
        return number

    def copy(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append a message to a channel announced by `copy_channel`.

        Raises:
            LatheError: writing to the disk fails.
        """
        with self._on_disk():
            self._file.add_message(channel, log_ns, data, publish_ns=publish_ns, sequence=sequence)

    def copy_record(self, opcode: int, content: bytes) -> None:
        """Append an attachment or metadata record copied from another file.

        Raises:
            LatheError: writing to the disk fails.
        """
        with self._on_disk():
            self._file.copy_record(opcode, content)

    def _continue_at(self, log_ns: int) -> None:
        """Begin another file if the current one has the span that it may have."""
        if self._began_ns is None:
            self._began_ns = log_ns
        elif 0 < self.split_ns <= log_ns - self._began_ns:
            following = f"{self._path.name}_{len(self._parts) + 1}.mcap"
            made = self._file.successor(self._path / following)
            made.add_metadata("lathe_rc", self._about)
            self._finish_file()
            self._parts.append(self._part())
            self._file, self._name, self._began_ns = made, following, log_ns

    def _part(self) -> _Part:
        return _Part(self._name, self._file.counts, self._file.first_ns, self._file.last_ns, self._file.checksum)

    def write(self, topic: str, log_ns: int, data: bytes | memoryview) -> None:
        """Append a message to an announced topic.

        Raises:
            LatheError: writing to the disk fails.
        """
        with self._on_disk():
            self._continue_at(log_ns)
            self._file.add_message(self._channels[topic], log_ns, data)

    def channel(self, topic: str) -> int:
        """Return the channel number of a topic in the file."""
        return self._channels[topic]

    def write_rows(self, plan: RowPlan, first_ns: int, data: bytes | memoryview) -> None:
        """Append rows of blocks, the first at log time ``first_ns``; see `lathe_rc.bag.writing.rows`.

        Raises:
            LatheError: writing to the disk fails.
        """
        with self._on_disk():
            self._continue_at(first_ns)
            self._file.add_rows(plan.size, data)

    def flush(self) -> None:
        """Hand all messages written so far to the operating system.

        Raises:
            LatheError: writing to the disk fails.
        """
        with self._on_disk():
            self._file.flush()

    def abort(self) -> None:
        """Close the file without completing it."""
        self._file.abort()

    def close(self) -> None:
        """Complete the file and its metadata, and close it.

        Raises:
            LatheError: the last messages could not be written; apart from them, the bag is complete unless the error
                says otherwise.
        """
        try:
            self.flush()
        finally:
            self._complete()

    def _complete(self) -> None:
        """Write the index and metadata into the disk space reserved for them."""
        if self._is_gone:
            return
        try:
            text = self._finish_file()
            beside = self._path / "metadata.yaml.tmp"
            beside.write_bytes(text)
            beside.replace(self._path / "metadata.yaml")
        except OSError as error:
            raise LatheError(
                f"{self._path}: cannot be completed ({error.strerror}); make room, then lathe bag recover it"
            ) from None

    def _finish_file(self) -> bytes:
        """Seal the current file and complete it; return the content of metadata.yaml for a bag that ends with it."""
        self._file.flush()
        tree = self._metadata()
        text = _yaml({"rosbag2_bagfile_information": tree}).encode()
        checksums = tuple(part.checksum for part in (*self._parts, self._part()))
        sealed = seal.Seal(_yaml(tree).strip(), checksums, seal.digest(text, checksums))
        self._file.free_room()
        self._file.add_metadata(seal.RECORD, sealed.record, last=True)
        self._file.finish()
        return text

    def _metadata(self) -> dict[str, Any]:
        """Return the bag metadata (version 9) with the message counts of the file."""
        parts = [*self._parts, self._part()]
        counted = [
            (topic, sum(part.counts.get(number, 0) for part in parts for number in numbers))
            for topic, numbers in self._topics.values()
        ]
        firsts = [part.first_ns for part in parts if part.first_ns is not None]
        lasts = [part.last_ns for part in parts if part.last_ns is not None]
        whole = _Part(
            "", dict(enumerate(count for _, count in counted)), min(firsts, default=None), max(lasts, default=None)
        )
        topics = [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": topic.encoding,
                    "offered_qos_profiles": dump_qos_v9(list(topic.qos)),
                    "type_description_hash": "" if topic.digest.endswith(_UNKNOWN) else topic.digest,
                },
                "message_count": count,
            }
            for topic, count in counted
        ]
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [part.name for part in parts],
            **whole.span(),
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": part.name, **part.span()} for part in parts],
            "custom_data": self._about or None,
            "ros_distro": "rosbags",
        }


class Both:
    """Pair of outputs with the same topics, both of which receive every message; a `MessageSink`.

    Args:
        first: bag of the whole run.
        second: other output.

    Attributes:
        first: see the arguments.
    """

    def __init__(self, first: BagWriter, second: MessageSink) -> None:
        self.first, self._second = first, second

    def tell(self, about: Mapping[str, str]) -> None:
        """Store strings in the metadata of both outputs."""
        self.first.tell(about)
        self._second.tell(about)

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a topic to both outputs."""
        self.first.add_topic(topic, msgtype, qos)
        self._second.add_topic(topic, msgtype, qos)

    def channel(self, topic: str) -> int:
        """Return the channel number of a topic, which is the same in both outputs."""
        number = self.first.channel(topic)
        assert number == self._second.channel(topic), "topics are announced to both in the same order"
        return number

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Append a message to both outputs."""
        self.first.write(topic, log_ns, data)
        self._second.write(topic, log_ns, data)

    def write_rows(self, plan: RowPlan, first_ns: int, data: bytes | memoryview) -> None:
        """Append rows of blocks to both outputs."""
        self.first.write_rows(plan, first_ns, data)
        self._second.write_rows(plan, first_ns, data)

    def flush(self) -> None:
        """Flush both outputs."""
        self.first.flush()
        self._second.flush()

    def close(self) -> None:
        """Close both outputs, the second even if closing the first fails."""
        try:
            self.first.close()
        finally:
            self._second.close()
