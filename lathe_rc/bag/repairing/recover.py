# SPDX-License-Identifier: Apache-2.0
"""Making a complete bag of one that was cut off or is broken in places."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from lathe_rc.bag import provenance
from lathe_rc.bag.repairing.salvage import Salvage
from lathe_rc.bag.writing.writer import BagWriter, refuse_existing
from lathe_rc.errors import shown

_CHUNK = 2**20  # [B]
_ENCODING = "cdr"  # how messages are serialized in what this package writes


@dataclass(frozen=True)
class Recovery:
    """The result of a recovery.

    Attributes:
        saved: messages.
        skipped: messages of topics whose type or serialization format nobody knows.
        lost_bytes: bytes of the files that gave nothing.
        damage: what was wrong, one line each.
    """

    saved: int
    skipped: int
    lost_bytes: int
    damage: tuple[str, ...]

    @property
    def lossy(self) -> bool:
        """Whether anything is missing."""
        return bool(self.lost_bytes or self.skipped)


def recover(path: Path, target: Path) -> Recovery:
    """Write what is whole of a bag to a new one.

    Args:
        path: folder or file.
        target: folder of the new bag; must not exist.

    Raises:
        InputError: nothing to read from, or the target exists.
        LatheError: the disk does not take it.
    """
    refuse_existing(target)
    salvage = Salvage(path)
    writer = BagWriter(target, compression="zstd", chunk_size=_CHUNK, about={})
    known: set[str] = set()
    refused: dict[str, str] = {}
    saved = skipped = 0

    def announce(topic: str) -> None:
        said = salvage.topics[topic]
        if said.encoding != _ENCODING:
            refused[topic] = f"serialization format {shown(said.encoding)!r}"
        elif writer.copy_topic(topic, said.type, said.qos, definition=said.definition, digest=said.digest):
            known.add(topic)
        else:
            refused[topic] = f"type {said.type}"

    try:
        for topic, log_ns, data in salvage:
            if topic not in known and topic not in refused:
                announce(topic)
            if topic in refused:
                skipped += 1
                continue
            writer.write(topic, log_ns, data)
            saved += 1
        for topic in salvage.topics:
            if topic not in known and topic not in refused:  # announced, without a message
                announce(topic)
        writer.tell(salvage.about | {provenance.RECOVERED: f"{saved} messages; {salvage.lost_bytes} B lost"})
    finally:
        writer.close()
    damage = [*salvage.damage, *(f"{topic}: {what} is not known" for topic, what in refused.items())]
    return Recovery(saved, skipped, salvage.lost_bytes, tuple(damage))


def mend(path: Path) -> Recovery | None:
    """Complete a bag in place: index and metadata for every message that reached the disk.

    Args:
        path: folder of the bag.

    Returns:
        None if there was nothing to mend.
    """
    if not any(path.glob("*.mcap")) or (path / "metadata.yaml").exists():
        return None
    workshop = path.with_name(f"{path.name}.mending")
    shutil.rmtree(workshop, ignore_errors=True)
    workshop.mkdir()
    new = workshop / path.name  # the file inside takes the folder's name
    found = recover(path, new)
    old = path.with_name(f"{path.name}.cut")
    path.rename(old)
    new.rename(path)
    workshop.rmdir()
    shutil.rmtree(old)
    return found
