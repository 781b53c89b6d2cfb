# SPDX-License-Identifier: Apache-2.0
"""Bags for the tests: of other makers and of records made by hand; commands for them, and the size of campaigns."""

import contextlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path

import zstandard
from click.testing import CliRunner, Result
from mcap.writer import MCAP0_MAGIC
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagWriter
from rosbags.typesys import Stores, get_typestore

from lathe_rc.bag.writing.writer import BagWriter, offered_qos
from lathe_rc.cli import main

JAZZY = get_typestore(Stores.ROS2_JAZZY)
QOS = offered_qos(10, "volatile")
MODES = [
    (plugin, mode)
    for plugin in StoragePlugin
    for mode in CompressionMode
    if plugin == StoragePlugin.MCAP or mode != CompressionMode.STORAGE
]  #: storages and compressions of rosbags
Said = tuple[str, int, bytes]  #: topic, log time [ns] and bytes of a message


def sized(number: int) -> int:
    """Cases of a campaign in tests/system: a tenth, or all with LATHE_CAMPAIGN=whole in the environment."""
    return number if os.environ.get("LATHE_CAMPAIGN") == "whole" else -(-number // 10)


def some(cases: list, every: int) -> list:
    """Every few of the cases, or all with LATHE_CAMPAIGN=whole in the environment."""
    return cases if os.environ.get("LATHE_CAMPAIGN") == "whole" else cases[::every]


def lathe(*arguments: object) -> Result:
    """Call the command line in this process."""
    return CliRunner().invoke(main, list(map(str, arguments)))


# ---- bags of others


def strange_bag(
    path: Path,
    plugin: StoragePlugin = StoragePlugin.MCAP,
    mode: CompressionMode = CompressionMode.NONE,
    count: int = 600,
) -> list[Said]:
    """A bag that other people's tools might have made, of types that this package does not publish; its messages."""
    point, text = JAZZY.types["geometry_msgs/msg/Point"], JAZZY.types["std_msgs/msg/String"]
    sent = []
    writer = RosbagWriter(path, version=9, storage_plugin=plugin)
    if mode != CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        points, texts = (
            writer.add_connection(topic, kind.__msgtype__, typestore=JAZZY, offered_qos_profiles=[QOS])
            for topic, kind in (("/where", point), ("/said", text))
        )
        for number in range(count):
            topic, message = (points, point(number, 0.5, -number)) if number % 3 else (texts, text(f"word {number}"))
            data = bytes(JAZZY.serialize_cdr(message, topic.msgtype))
            writer.write(topic, 10**9 + number * 1000, data)
            sent.append((topic.topic, 10**9 + number * 1000, data))
    return sent


def read_by_others(path: Path) -> list[Said]:
    """The messages of a bag as rosbags reads them."""
    with AnyReader([path], default_typestore=JAZZY) as bag:
        return [(connection.topic, stamp, bytes(data)) for connection, stamp, data in bag.messages()]


def storage_of(path: Path) -> Path:
    """The file with the messages of a bag that has one."""
    return next(file for file in sorted(path.iterdir()) if file.suffix in (".mcap", ".db3", ".zstd"))


def bag_writer(path: Path, topic: str, msgtype: str, chunk_size: int = 4096) -> BagWriter:
    """A bag of ours with a topic."""
    writer = BagWriter(path, compression="none", chunk_size=chunk_size, about={})
    writer.add_topic(topic, msgtype, QOS)
    return writer


# ---- MCAP by hand


@contextlib.contextmanager
def mcap_writer(path: Path, profile: str = "ros2", **options: object) -> Iterator[McapWriter]:
    """A file of the mcap library, finished at the end."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, **options)  # type: ignore[arg-type]
        writer.start(profile)
        yield writer
        writer.finish()


def record(opcode: int, content: bytes) -> bytes:
    """A record."""
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: bytes) -> bytes:
    """A text or a map, behind its length."""
    return struct.pack("<I", len(value)) + value


HEADER = record(1, text(b"ros2") + text(b""))
FIRST = len(MCAP0_MAGIC + HEADER)  #: place of the first record behind the header
SCHEMA = record(3, struct.pack("<H", 1) + text(b"std_msgs/msg/String") + text(b"ros2msg") + text(b"string data\n"))
EMPTY = record(5, struct.pack("<HIQQ", 1, 0, 5, 5))  #: a message without bytes


def channel(qos: bytes = b"", number: int = 1) -> bytes:
    """A topic /t of that schema."""
    pairs = text(b"offered_qos_profiles") + text(qos)
    return record(4, struct.pack("<HH", number, 1) + text(b"/t") + text(b"cdr") + text(pairs))


def statistics(chunks: int = 0, messages: int = 0) -> bytes:
    """Counts of a file; of the topic's messages if there are any."""
    counts = struct.pack("<HQ", 1, messages) if messages else b""
    return record(11, struct.pack("<QHIIIIQQ", chunks, 1, 1, 0, 0, chunks, 0, 1) + text(counts))


def chunk(
    data: bytes = b"", *, compression: bytes = b"zstd", size: int | None = None, packed: bytes | None = None
) -> bytes:
    """A chunk without a checksum; ``packed`` and ``size`` take the place of those that belong to its records."""
    packed = zstandard.compress(data) if packed is None else packed
    head = struct.pack("<QQQI", 0, 1, len(data) if size is None else size, 0) + text(compression)
    return record(6, head + struct.pack("<Q", len(packed)) + packed)


def chunk_index(start: int, length: int, *, size: int = 1000, packed: int = 9) -> bytes:
    """The entry of a chunk in the index."""
    head = struct.pack("<QQQQIQ", 0, 1, start, length, 0, 0)
    return record(8, head + text(b"zstd") + struct.pack("<QQ", packed, size))


def mcap(path: Path, data: bytes = b"", summary: bytes = b"") -> Path:
    """A file of these records."""
    head = MCAP0_MAGIC + HEADER + data
    start = len(head) if summary else 0
    path.write_bytes(head + summary + record(2, struct.pack("<QQI", start, 0, 0)) + MCAP0_MAGIC)
    return path
