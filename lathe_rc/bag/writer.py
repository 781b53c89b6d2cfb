# SPDX-License-Identifier: Apache-2.0
"""Writing rosbag2 directories.

rosbags writes the directory, its metadata and the schemas. Its own MCAP storage has neither a chunk size nor a
flush, which are what a crash promise needs, so the file itself is written by the mcap library.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import BinaryIO, Literal

from mcap.writer import CompressionType
from mcap.writer import Writer as McapFile
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter

from lathe_rc.cell import messages
from lathe_rc.errors import InputError, LatheError

Compression = Literal["zstd", "none"]
Durability = Literal["volatile", "transient_local"]

_FOREVER = QosTime(9223372036, 854775807)


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
    """rosbags' storage interface on mcap's writer."""

    def __init__(self, path: Path, compression: CompressionMode, chunk_size: int, codec: CompressionType) -> None:
        assert compression is CompressionMode.NONE, "chunks are compressed, not messages or files"
        self.path = path / f"{path.name}.mcap"
        self._stream: BinaryIO = self.path.open("xb")
        self._file = McapFile(self._stream, chunk_size=chunk_size, compression=codec)
        self._file.start(profile="ros2", library="lathe_rc")
        self._schemas: dict[str, int] = {}
        self._channels: dict[int, int] = {}

    def add_msgtype(self, connection: Connection) -> None:
        """Add a message type's definition."""
        data = connection.msgdef.data.encode()
        self._schemas[connection.msgtype] = self._file.register_schema(connection.msgtype, "ros2msg", data)

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Add a topic."""
        assert isinstance(connection.ext, ConnectionExtRosbag2)
        self._channels[connection.id] = self._file.register_channel(
            topic=connection.topic,
            message_encoding=connection.ext.serialization_format,
            schema_id=self._schemas[connection.msgtype],
            metadata={
                "offered_qos_profiles": offered_qos_profiles,
                "topic_type_hash": connection.digest,
            },
        )

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        """Write a message."""
        self._file.add_message(self._channels[connection.id], timestamp, bytes(data), timestamp)

    def flush(self) -> None:
        """Hand everything so far to the operating system."""
        self._file.flush()
        self._stream.flush()

    def close(self, version: int, metadata: str) -> None:
        """Finish the file."""
        self._file.add_metadata("rosbag2", {"serialized_metadata": metadata})
        self._file.finish()
        self._stream.close()

    def abort(self) -> None:
        """Leave the file as it is."""
        self._stream.close()


class _Writer(RosbagWriter):
    """rosbags' writer with the storage above."""

    def __init__(self, path: Path, chunk_size: int, codec: CompressionType) -> None:
        super().__init__(path, version=9, storage_plugin=StoragePlugin.MCAP)
        make = partial(_McapStorage, chunk_size=chunk_size, codec=codec)
        self.STORAGE_PLUGINS = {StoragePlugin.MCAP: make}  # type: ignore[dict-item]  # wants a class, only calls it


def refuse_existing(path: Path) -> None:
    """Refuse a place where a bag cannot be begun.

    Raises:
        InputError: something is there already.
    """
    if path.exists():
        raise InputError(f"{path} exists; a bag is never overwritten: name another folder or remove it")


class BagWriter:
    """A bag being written.

    Args:
        path: its folder; must not exist.
        compression: of the chunks.
        chunk_size: bytes after which a chunk is written out: what a crash may lose.
        about: key and text pairs for the bag's metadata.

    Raises:
        InputError: the folder exists or cannot be made.
    """

    def __init__(self, path: Path, *, compression: Compression, chunk_size: int, about: Mapping[str, str]) -> None:
        refuse_existing(path)
        codec = CompressionType.ZSTD if compression == "zstd" else CompressionType.NONE
        self._writer = _Writer(path, chunk_size, codec)
        for key, text in about.items():
            self._writer.set_custom_data(key, text)
        try:
            self._writer.open()
        except OSError as error:
            raise InputError(f"{path}: cannot be made ({error.strerror})") from None
        self._connections: dict[str, Connection] = {}

    def add_topic(self, topic: str, msgtype: str, qos: Qos) -> None:
        """Announce a fully qualified topic."""
        self._connections[topic] = self._writer.add_connection(
            topic, msgtype, typestore=messages.store(), offered_qos_profiles=[qos]
        )

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Append a message to a topic that has been announced.

        Raises:
            LatheError: the disk does not take it.
        """
        try:
            self._writer.write(self._connections[topic], log_ns, data)
        except OSError as error:
            raise LatheError(f"{self._writer.path}: cannot write ({error.strerror})") from None

    def close(self) -> None:
        """Finish the file and its metadata."""
        self._writer.close()
