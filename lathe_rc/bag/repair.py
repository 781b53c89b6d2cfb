# SPDX-License-Identifier: Apache-2.0
"""Making a readable bag of one whose recorder was killed."""

import shutil
import struct
from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.rosbag2.metadata import parse_qos
from zstandard import ZstdError

from lathe_rc.bag.writer import BagWriter

_CUT = (McapError, EOFError, struct.error, ZstdError, ValueError, KeyError)  # what a file that was cut off may raise


def mend(path: Path) -> int | None:
    """Complete a bag in place: index and metadata for every message that reached the disk.

    Args:
        path: folder of the bag.

    Returns:
        The number of messages saved; None if there was nothing to mend.
    """
    files = sorted(path.glob("*.mcap"))
    if not files or (path / "metadata.yaml").exists():
        return None
    workshop = path.with_name(f"{path.name}.mending")
    shutil.rmtree(workshop, ignore_errors=True)
    new = workshop / path.name  # the file inside takes the folder's name
    writer = BagWriter(new, compression="zstd", chunk_size=2**20, about={"lathe_rc.mended": "true"})
    schemas: dict[int, Schema] = {}
    channels: dict[int, str] = {}
    saved = 0
    try:
        with files[0].open("rb") as stream:
            for record in StreamReader(stream).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel) and record.id not in channels:
                    channels[record.id] = record.topic
                    (qos,) = parse_qos(record.metadata["offered_qos_profiles"])
                    writer.add_topic(record.topic, schemas[record.schema_id].name, qos)
                elif isinstance(record, Message):
                    writer.write(channels[record.channel_id], record.log_time, record.data)
                    saved += 1
    except _CUT:
        pass  # the cut: everything before it has been saved
    writer.close()
    old = path.with_name(f"{path.name}.cut")
    path.rename(old)
    new.rename(path)
    workshop.rmdir()
    shutil.rmtree(old)
    return saved
