# SPDX-License-Identifier: Apache-2.0
"""Recovery of a complete bag from one that is truncated or damaged in places."""

import shutil
from pathlib import Path

from lathe_rc.bag import provenance
from lathe_rc.bag.repairing.salvage import Salvage, Topic
from lathe_rc.bag.writing.writer import BagWriter, ListedTopic, refuse_existing
from lathe_rc.errors import LatheError, shown

_CHUNK = 2**20  # [B]


def recover(path: Path, target: Path) -> Salvage:
    """Copy the intact content of a bag to a new one, whether or not it can be decoded.

    Args:
        path: folder or file of the damaged bag.
        target: folder of the new bag; must not exist yet, and is removed if the recovery fails.

    Returns:
        The recovered content and the damage found.

    Raises:
        InputError: there is nothing to read, or the target exists.
        LatheError: reading from or writing to the disk fails.
    """
    refuse_existing(target)
    try:
        salvage = Salvage(path)
        writer = BagWriter(target, compression="zstd", chunk_size=_CHUNK, about={}, profile=salvage.profile)
        try:
            _copy(salvage, writer)
        except BaseException:
            writer.abort()
            shutil.rmtree(target)
            raise
    except OSError as error:
        raise LatheError(f"{path}: cannot be recovered ({error.strerror or shown(error)})") from None
    return salvage


def _copy(salvage: Salvage, writer: BagWriter) -> None:
    """Copy all readable messages and records to the new bag."""
    channels: dict[Topic, int] = {}

    def announce(topic: Topic) -> int:
        channels[topic] = writer.copy_channel(ListedTopic(*topic[:4]), topic.digest, (topic.schema, topic.channel))
        return channels[topic]

    salvage.copied = writer.copy_record
    for topic, sequence, log_ns, publish_ns, data in salvage:
        number = channels.get(topic)
        writer.copy(announce(topic) if number is None else number, sequence, log_ns, publish_ns, data)
        salvage.saved += 1
    for topic in [each for each in salvage.topics if each not in channels]:  # without messages
        announce(topic)
    missing = f", {salvage.missing} messages missing" if salvage.missing else ""
    writer.tell(
        salvage.about | {provenance.RECOVERED: f"{salvage.saved} messages; {salvage.lost_bytes} B lost{missing}"}
    )
    writer.close()


def mend(path: Path) -> Salvage | None:
    """Complete a bag in place: add an index and metadata for all messages that reached the disk.

    Args:
        path: folder of the bag.

    Returns:
        The recovered content and the damage found; None if there was nothing to repair.
    """
    if not any(path.glob("*.mcap")) or (path / "metadata.yaml").exists():
        return None
    workshop = path.with_name(f"{path.name}.mending")
    shutil.rmtree(workshop, ignore_errors=True)
    workshop.mkdir()
    try:
        new = workshop / path.name  # the MCAP file is named after its folder
        found = recover(path, new)
        old = path.with_name(f"{path.name}.cut")
        path.rename(old)
        new.rename(path)
        shutil.rmtree(old)
    finally:
        shutil.rmtree(workshop)
    return found
