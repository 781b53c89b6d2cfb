# SPDX-License-Identifier: Apache-2.0
"""Writing rosbag2 directories: an MCAP file, and its metadata as rosbags writes them.

The storage of rosbags' own writer has neither a chunk size nor a flush, which are what a crash promise needs;
`lathe_rc.bag.writing.mcap_file` has. Its YAML takes 0.2 s for a bag, during which a cell that is being recorded would
wait; libyaml takes some ms.
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
from lathe_rc.bag.writing.mcap_file import McapFile
from lathe_rc.bag.writing.rows import RowPlan
from lathe_rc.errors import InputError, LatheError

Compression = Literal["zstd", "none"]
Durability = Literal["volatile", "transient_local"]
Records = tuple[bytes | None, bytes]

FLUSH_PERIOD = 0.5  #: [s] of wall time after which a recorder writes messages out even if they fill no chunk
_FOREVER = QosTime(9223372036, 854775807)
_NEVER = 2**63 - 1  # start of a bag without a message, as rosbags writes it [ns]


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]  # absent without libyaml
    """Writes texts in quotes: no reader, of whatever version of YAML, takes one for a number."""

    def ignore_aliases(self, data: object) -> bool:
        """Write equal parts out each time, as rosbags does."""
        return True


_Dumper.add_representer(str, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"'))


def _yaml(tree: Any) -> str:
    return str(yaml.dump(tree, None, _Dumper, default_flow_style=False, allow_unicode=True))


class ListedTopic(NamedTuple):
    """A topic as metadata list it; some channels of a file may be one.

    Attributes:
        name: fully qualified.
        type: of its messages; may be empty.
        encoding: of its messages.
        qos: that its publishers offer.
    """

    name: str
    type: str
    encoding: str
    qos: tuple[Qos, ...]


class Output(Protocol):
    """A sink for the messages of a run: a bag, or a writer of several bags."""

    def tell(self, about: Mapping[str, str]) -> None:
        """Store texts; see `BagWriter`."""

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a topic; see `BagWriter`."""

    def channel(self, topic: str) -> int:
        """The number of a topic in the file."""

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Append a message; see `BagWriter`."""

    def write_rows(self, plan: RowPlan, first_ns: int, data: bytes | memoryview) -> None:
        """Append rows of blocks; see `BagWriter`."""

    def flush(self) -> None:
        """Hand what has been written so far to the operating system; see `BagWriter`."""

    def close(self) -> None:
        """Finish; see `BagWriter`."""


@cache
def definition(msgtype: str) -> tuple[str, str]:
    """Text and hash of a message type that this package knows."""
    store = messages.store()
    return store.generate_msgdef(msgtype, ros_version=2)[0], store.hash_rihs01(msgtype)


def offered_qos(depth: int, durability: Durability) -> Qos:
    """Reliable, keep last, as every lathe node publishes."""
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
    """Refuse a place where a bag cannot be begun.

    Raises:
        InputError: something is there already, or the folder that it would be in is not there.
    """
    if path.exists():
        raise InputError(f"{path} exists; a bag is never overwritten: name another folder or remove it")
    if not path.absolute().parent.exists():
        raise InputError(f"{path}: there is no folder {path.parent}; make it, or name another one")


class BagWriter:
    """A bag being written.

    Args:
        path: its folder; must not exist.
        compression: of the chunks.
        chunk_size: bytes after which a chunk is written out: what a crash may lose.
        about: texts that the bag says of itself, see `tell`.
        profile: of the MCAP file.

    Raises:
        InputError: the folder exists, or cannot be made where it is to be.
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
        try:
            path.mkdir(mode=0o755)
            self._file = McapFile(
                path / self._name, chunk_size=chunk_size, compress=compression == "zstd", profile=profile
            )
        except OSError as error:
            raise InputError(f"{path}: cannot be made ({error.strerror})") from None
        self._about: dict[str, str] = {}
        self._topics: dict[ListedTopic, tuple[str, list[int]]] = {}  # hash of the type, and channels
        self._channels: dict[str, int] = {}  # of what is written by topic
        self._schemas: dict[str | bytes | None, int] = {}
        try:
            self.tell(about)
        except LatheError:
            self.abort()
            shutil.rmtree(path)
            raise

    @contextmanager
    def _on_disk(self) -> Iterator[None]:
        """Turn errors of the disk into one line."""
        try:
            yield
        except OSError as error:
            before = "" if self._file.first_ns is None else "what was recorded before is readable: "
            raise LatheError(f"{self._path}: cannot write ({error.strerror}); {before}make room") from None

    def tell(self, about: Mapping[str, str]) -> None:
        """Store texts: in the file at once, where they survive a crash, and in metadata.yaml at the end.

        Raises:
            LatheError: the disk does not take it.
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
        """Announce a topic of a type that this package need not know, with the text and the hash of its definition."""
        if msgtype not in self._schemas:
            self._schemas[msgtype] = self._file.add_schema(msgtype, definition)
        said = {"offered_qos_profiles": _yaml(dump_qos_v9(list(qos))).strip(), "topic_type_hash": digest}
        number = self._file.add_channel(topic, self._schemas[msgtype], "cdr", said)
        self._channels[topic] = number
        self._list(ListedTopic(topic, msgtype, "cdr", tuple(qos)), digest, number)

    def copy_channel(self, topic: ListedTopic, digest: str, records: Records) -> int:
        """Announce a topic as another bag does, understood or not.

        Args:
            topic: how it is listed.
            digest: of the type; may be empty.
            records: contents of the records of its schema, None if it has none, and of its channel.

        Returns:
            Its number for `copy`.
        """
        schema, channel = records
        if schema not in self._schemas:
            self._schemas[schema] = self._file.copy_schema(schema) if schema is not None else 0
        number = self._file.copy_channel(channel, self._schemas[schema])
        self._list(topic, digest, number)
        return number

    def _list(self, topic: ListedTopic, digest: str, channel: int) -> None:
        self._topics.setdefault(topic, (digest, []))[1].append(channel)

    def copy(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append a message to a channel that has been copied.

        Raises:
            LatheError: the disk does not take it.
        """
        with self._on_disk():
            self._file.add_message(channel, log_ns, data, publish_ns=publish_ns, sequence=sequence)

    def copy_record(self, opcode: int, content: bytes) -> None:
        """Append an attachment or metadata as another file has it.

        Raises:
            LatheError: the disk does not take it.
        """
        with self._on_disk():
            self._file.copy_record(opcode, content)

    def write(self, topic: str, log_ns: int, data: bytes | memoryview) -> None:
        """Append a message to a topic that has been announced.

        Raises:
            LatheError: the disk does not take it.
        """
        with self._on_disk():
            self._file.add_message(self._channels[topic], log_ns, data)

    def channel(self, topic: str) -> int:
        """The number of a topic in the file."""
        return self._channels[topic]

    def write_rows(self, plan: RowPlan, first_ns: int, data: bytes | memoryview) -> None:
        """Append rows of blocks, the first with log time ``first_ns``; see `lathe_rc.bag.writing.rows`.

        Raises:
            LatheError: the disk does not take it.
        """
        with self._on_disk():
            self._file.add_rows(plan.size, data)

    def flush(self) -> None:
        """Hand what has been written so far to the operating system.

        Raises:
            LatheError: the disk does not take it.
        """
        with self._on_disk():
            self._file.flush()

    def abort(self) -> None:
        """Close the file as it is."""
        self._file.abort()

    def close(self) -> None:
        """Finish the file and its metadata.

        Raises:
            LatheError: the disk did not take the last messages; the bag is complete but for them, or says so.
        """
        try:
            self.flush()
        finally:
            self._complete()

    def _complete(self) -> None:
        """Write index and metadata, for which the file has kept room."""
        tree = self._metadata()
        try:
            self._file.free_room()
            self._file.add_metadata("rosbag2", {"serialized_metadata": _yaml(tree).strip()}, last=True)
            self._file.finish()
            beside = self._path / "metadata.yaml.tmp"
            beside.write_text(_yaml({"rosbag2_bagfile_information": tree}), encoding="utf-8")
            beside.replace(self._path / "metadata.yaml")
        except OSError as error:
            raise LatheError(
                f"{self._path}: cannot be completed ({error.strerror}); make room, then lathe bag recover it"
            ) from None

    def _metadata(self) -> dict[str, Any]:
        """The metadata of version 9; they count the messages that the file has."""
        counts = {topic: sum(map(self._file.counts.__getitem__, each)) for topic, (_, each) in self._topics.items()}
        first = _NEVER if self._file.first_ns is None else self._file.first_ns
        span = {
            "starting_time": {"nanoseconds_since_epoch": first},
            "duration": {"nanoseconds": max((self._file.last_ns or 0) - first, 0)},
            "message_count": sum(counts.values()),
        }
        topics = [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": topic.encoding,
                    "offered_qos_profiles": dump_qos_v9(list(topic.qos)),
                    "type_description_hash": digest,
                },
                "message_count": counts[topic],
            }
            for topic, (digest, _) in self._topics.items()
        ]
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [self._name],
            **span,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": self._name, **span}],
            "custom_data": self._about or None,
            "ros_distro": "rosbags",
        }


class Both:
    """Two outputs with the same topics; an `Output`.

    Args:
        first, second: the outputs.
    """

    def __init__(self, first: Output, second: Output) -> None:
        self._first, self._second = first, second

    def tell(self, about: Mapping[str, str]) -> None:
        """Store texts in both."""
        self._first.tell(about)
        self._second.tell(about)

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a topic to both."""
        self._first.add_topic(topic, msgtype, qos)
        self._second.add_topic(topic, msgtype, qos)

    def channel(self, topic: str) -> int:
        """Return the number of a topic, the same in both."""
        number = self._first.channel(topic)
        assert number == self._second.channel(topic), "topics are announced to both in the same order"
        return number

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Append a message to both."""
        self._first.write(topic, log_ns, data)
        self._second.write(topic, log_ns, data)

    def write_rows(self, plan: RowPlan, first_ns: int, data: bytes | memoryview) -> None:
        """Append rows of blocks to both."""
        self._first.write_rows(plan, first_ns, data)
        self._second.write_rows(plan, first_ns, data)

    def flush(self) -> None:
        """Flush both."""
        self._first.flush()
        self._second.flush()

    def close(self) -> None:
        """Close both, the second also if the first fails."""
        try:
            self._first.close()
        finally:
            self._second.close()
