# SPDX-License-Identifier: Apache-2.0
"""Writing rosbag2 directories.

rosbags writes the directory, its metadata and the schemas. Its own MCAP storage has neither a chunk size nor a
flush, which are what a crash promise needs; `lathe_rc.bag.writing.mcap_file` has. Its YAML takes 0.2 s for a bag,
during which a cell that is being recorded would wait; libyaml takes some ms.
"""

import shutil
from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, Protocol, TextIO, cast

import rosbags.rosbag2.writer
import yaml
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from lathe_rc import messages
from lathe_rc.bag.writing.mcap_file import McapFile, RowPlan
from lathe_rc.errors import InputError, LatheError

Compression = Literal["zstd", "none"]
Durability = Literal["volatile", "transient_local"]
Records = tuple[bytes | None, bytes]

FLUSH_PERIOD = 0.5  #: [s] of wall time after which a recorder writes messages out even if they fill no chunk
_FOREVER = QosTime(9223372036, 854775807)


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]  # absent without libyaml
    """Writes texts in quotes: no reader, of whatever version of YAML, takes one for a number."""

    def ignore_aliases(self, data: object) -> bool:
        """Write equal parts out each time, as rosbags does."""
        return True


_Dumper.add_representer(str, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"'))


class _Yaml:
    """The part of ruamel.yaml that rosbags' writer uses."""

    def __init__(self, typ: str) -> None:
        self.default_flow_style = False

    def dump(self, tree: Any, stream: TextIO) -> None:
        """Write plain data."""
        yaml.dump(tree, stream, _Dumper, default_flow_style=self.default_flow_style, allow_unicode=True)


rosbags.rosbag2.writer.YAML = _Yaml  # type: ignore[attr-defined,assignment]  # see the top: it has no option for it


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
def _definition(msgtype: str) -> tuple[str, str]:
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


class _McapStorage:
    """rosbags' storage interface on `McapFile`."""

    def __init__(
        self, path: Path, compression: CompressionMode, chunk_size: int, profile: str, *, compress: bool
    ) -> None:
        assert compression is CompressionMode.NONE, "chunks are compressed, not messages or files"
        self.path = path / f"{path.name}.mcap"
        self.file = McapFile(self.path, chunk_size=chunk_size, compress=compress, profile=profile)
        self._schemas: dict[str, int] = {}
        self.channels: dict[int, list[int]] = {}  # by connection

    def add_msgtype(self, connection: Connection) -> None:
        """Add a message type's definition."""
        self._schemas[connection.msgtype] = self.file.add_schema(connection.msgtype, connection.msgdef.data)

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Add a topic."""
        assert isinstance(connection.ext, ConnectionExtRosbag2)
        number = self.file.add_channel(
            connection.topic,
            self._schemas[connection.msgtype],
            connection.ext.serialization_format,
            {"offered_qos_profiles": offered_qos_profiles, "topic_type_hash": connection.digest},
        )
        self.channels[connection.id] = [number]

    def close(self, version: int, metadata: str) -> None:
        """Finish the file."""
        self.file.free_room()
        self.file.add_metadata("rosbag2", {"serialized_metadata": metadata}, last=True)
        self.file.finish()


class _Writer(RosbagWriter):
    """rosbags' writer with the storage above, which gets the messages directly and counts them itself."""

    def __init__(self, path: Path, chunk_size: int, profile: str, *, compress: bool) -> None:
        super().__init__(path, version=9, storage_plugin=StoragePlugin.MCAP)
        make = partial(_McapStorage, chunk_size=chunk_size, profile=profile, compress=compress)
        self.STORAGE_PLUGINS = {StoragePlugin.MCAP: make}  # type: ignore[dict-item]  # wants a class, only calls it

    @property
    def mcap(self) -> _McapStorage:
        """The storage, once open."""
        return cast("_McapStorage", self.storage)

    def close(self) -> None:
        """See rosbags; the metadata count the messages that the storage has been given."""
        file = self.mcap.file
        self.counts = {key: sum(map(file.counts.__getitem__, each)) for key, each in self.mcap.channels.items()}
        if file.first_ns is not None and file.last_ns is not None:
            self.min_timestamp, self.max_timestamp = file.first_ns, file.last_ns
        super().close()


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
        self._writer = _Writer(path, chunk_size, profile, compress=compression == "zstd")
        try:
            self._writer.open()
        except OSError as error:
            raise InputError(f"{path}: cannot be made ({error.strerror})") from None
        self._file = self._writer.mcap.file
        self._channels: dict[str, int] = {}
        self._copied: dict[bytes | None, int] = {}  # schemas
        try:
            self.tell(about)
        except LatheError:
            self.abort()
            shutil.rmtree(path)
            raise

    def tell(self, about: Mapping[str, str]) -> None:
        """Store texts: in the file at once, where they survive a crash, and in metadata.yaml at the end.

        Raises:
            LatheError: the disk does not take it.
        """
        for key, text in about.items():
            self._writer.set_custom_data(key, text)
        if not about:
            return
        try:
            self._file.add_metadata("lathe_rc", about)
        except OSError as error:
            raise self._full(error) from None

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a fully qualified topic of a type that this package knows."""
        text, digest = _definition(msgtype)
        self._added(
            topic, self._writer.add_connection(topic, msgtype, msgdef=text, rihs01=digest, offered_qos_profiles=[qos])
        )

    def copy_topic(self, topic: str, msgtype: str, qos: Sequence[Qos], *, definition: str, digest: str) -> None:
        """Announce a topic of a type that this package need not know, with the text and the hash of its definition."""
        self._added(
            topic,
            self._writer.add_connection(
                topic, msgtype, msgdef=definition, rihs01=digest, offered_qos_profiles=list(qos)
            ),
        )

    def copy_channel(self, topic: str, msgtype: str, ext: ConnectionExtRosbag2, digest: str, records: Records) -> int:
        """Announce a topic as another bag does, understood or not.

        Args:
            topic: its name.
            msgtype: of its messages.
            ext: their encoding and the quality of service that its publishers offer.
            digest: of the type; may be empty.
            records: contents of the records of its schema, None if it has none, and of its channel.

        Returns:
            Its number for `copy`.
        """
        schema, channel = records
        if schema not in self._copied:
            self._copied[schema] = self._file.copy_schema(schema) if schema is not None else 0
        number = self._file.copy_channel(channel, self._copied[schema])
        for known in self._writer.connections:
            if (known.topic, known.msgtype, known.ext) == (topic, msgtype, ext):
                self._writer.mcap.channels[known.id].append(number)
                return number
        key = len(self._writer.connections) + 1
        nothing = MessageDefinition(MessageDefinitionFormat.NONE, "")
        self._writer.connections.append(Connection(key, topic, msgtype, nothing, digest, 0, ext, self._writer))
        self._writer.mcap.channels[key] = [number]
        return number

    def copy(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append a message to a channel that has been copied.

        Raises:
            LatheError: the disk does not take it.
        """
        try:
            self._file.add_message(channel, log_ns, data, publish_ns=publish_ns, sequence=sequence)
        except OSError as error:
            raise self._full(error) from None

    def copy_record(self, opcode: int, content: bytes) -> None:
        """Append an attachment or metadata as another file has it.

        Raises:
            LatheError: the disk does not take it.
        """
        try:
            self._file.copy_record(opcode, content)
        except OSError as error:
            raise self._full(error) from None

    def _added(self, topic: str, connection: Connection) -> None:
        (self._channels[topic],) = self._writer.mcap.channels[connection.id]

    def write(self, topic: str, log_ns: int, data: bytes | memoryview) -> None:
        """Append a message to a topic that has been announced.

        Raises:
            LatheError: the disk does not take it.
        """
        try:
            self._file.add_message(self._channels[topic], log_ns, data)
        except OSError as error:
            raise self._full(error) from None

    def channel(self, topic: str) -> int:
        """The number of a topic in the file."""
        return self._channels[topic]

    def write_rows(self, plan: RowPlan, first_ns: int, data: bytes | memoryview) -> None:
        """Append rows of blocks, the first with log time ``first_ns``; see `lathe_rc.bag.writing.rows`.

        Raises:
            LatheError: the disk does not take it.
        """
        try:
            self._file.add_rows(plan, first_ns, data)
        except OSError as error:
            raise self._full(error) from None

    def _full(self, error: OSError) -> LatheError:
        before = "" if self._file.first_ns is None else "what was recorded before is readable: "
        return LatheError(f"{self._writer.path}: cannot write ({error.strerror}); {before}make room")

    def flush(self) -> None:
        """Hand what has been written so far to the operating system.

        Raises:
            LatheError: the disk does not take it.
        """
        try:
            self._file.flush()
        except OSError as error:
            raise self._full(error) from None

    def abort(self) -> None:
        """Close the file as it is."""
        self._file.abort()

    def close(self) -> None:
        """Finish the file and its metadata.

        Raises:
            LatheError: the disk did not take the last messages; the bag is complete but for them, or says so.
        """
        try:
            self._file.flush()
        except OSError as error:
            raise self._full(error) from None
        finally:
            self._complete()

    def _complete(self) -> None:
        """Write index and metadata, for which the file has kept room."""
        try:
            self._writer.close()
        except OSError as error:
            raise LatheError(
                f"{self._writer.path}: cannot be completed ({error.strerror}); make room, then lathe bag recover it"
            ) from None
