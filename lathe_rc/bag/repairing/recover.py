# SPDX-License-Identifier: Apache-2.0
"""Copies of bags: of a whole bag that is truncated or damaged in places, or of chosen messages of several bags."""

import heapq
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from lathe_rc.bag import loss, provenance
from lathe_rc.bag.reading.source import name_of
from lathe_rc.bag.repairing.salvage import Message, Salvage
from lathe_rc.bag.writing.writer import BagWriter, Topic, refuse_existing
from lathe_rc.errors import InputError, LatheError, shown

_CHUNK = 2**20  # [B]


class Choice(NamedTuple):
    """Messages of bags to copy.

    Attributes:
        topics: topics to copy; empty: all.
        without: topics to leave out.
        start_ns, end_ns: smallest log time, and the log time at which copying stops [ns].
    """

    topics: frozenset[str] = frozenset()
    without: frozenset[str] = frozenset()
    start_ns: int = 0
    end_ns: int = 2**64

    def topic(self, name: str) -> bool:
        """Return True if messages of a topic are copied."""
        return name not in self.without and (not self.topics or name in self.topics)


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

    def about(salvage: Salvage) -> dict[str, str]:
        missing = f", {salvage.missing} messages missing" if salvage.missing else ""
        said = f"{salvage.saved} messages; {salvage.lost_bytes} B lost{missing}"
        said += f"; from {salvage.origin}" if salvage.origin else ""
        return salvage.about | provenance.another(salvage.about, provenance.RECOVERED, said)

    (found,) = _copied([path], target, Choice(), lambda salvages: about(*salvages))
    return found


def copy(paths: Sequence[Path], target: Path, choice: Choice) -> list[Salvage]:
    """Copy chosen messages of bags to a new bag, byte for byte.

    Several bags are merged in the order of their log times; the messages of a single bag keep their order.

    Strings in the metadata, such as the scenario, are copied from a single bag only: two bags have two of them. The
    loss of members is copied from all of them.

    Args:
        paths: folders or files of the bags.
        target: folder of the new bag; must not exist. It is removed again if the copy fails.
        choice: messages to copy.

    Returns:
        The content of each bag and the damage found in it; damaged parts are left out.

    Raises:
        InputError: there is nothing to read, or the target exists.
        LatheError: writing to the disk or reading from it fails.
    """

    def about(salvages: Sequence[Salvage]) -> dict[str, str]:
        if not any(each.saved for each in salvages):
            raise InputError(
                f"no message of {', '.join(map(str, paths))} is chosen; allowed: topics and times with some (lathe bag "
                "info)"
            )
        of = ", ".join(_copied_of(salvage) for salvage in salvages)
        abouts = [each.about for each in salvages]
        before = abouts[0] if len(abouts) == 1 else loss.together(abouts)
        return {**before, **provenance.another(before, provenance.COPIED, of)}

    return _copied(paths, target, choice, about)


def _copied_of(salvage: Salvage) -> str:
    """Return in words which messages were copied of which bag."""
    told = filter(None, [salvage.origin, "damaged" if salvage.lossy else ""])
    return f"{salvage.saved} messages of {name_of(salvage.path)}" + "".join(f", {each}" for each in told)


def _copied(
    paths: Sequence[Path], target: Path, choice: Choice, about: Callable[[Sequence[Salvage]], dict[str, str]]
) -> list[Salvage]:
    refuse_existing(target)
    try:
        salvages = [Salvage(path) for path in paths]
        writer = BagWriter(target, compression="zstd", chunk_size=_CHUNK, about={}, profile=salvages[0].profile)
        try:
            _copy(salvages, writer, choice)
            writer.tell(about(salvages))
            writer.close()
        except BaseException:
            writer.abort()
            shutil.rmtree(target, ignore_errors=True)  # a writer removes a bag of which nothing could be written
            raise
    except OSError as error:
        raise LatheError(f"{', '.join(map(str, paths))}: cannot be copied ({error.strerror or shown(error)})") from None
    return salvages


def _copy(salvages: Sequence[Salvage], writer: BagWriter, choice: Choice) -> None:
    """Copy all chosen readable messages, and all records, to the new bag."""
    channels: dict[Topic, int] = {}

    def announce(topic: Topic) -> int:
        channels[topic] = writer.copy_channel(topic)
        return channels[topic]

    def chosen(salvage: Salvage) -> Iterator[tuple[Salvage, Message]]:
        for message in salvage:
            if choice.start_ns <= message.log_ns < choice.end_ns and choice.topic(message.topic.name):
                yield salvage, message

    for salvage in salvages:
        salvage.copied = writer.copy_record
    # A single bag keeps its own order of messages.
    merged = heapq.merge(*map(chosen, salvages), key=lambda found: found[1].log_ns)
    for salvage, (topic, sequence, log_ns, publish_ns, data) in chosen(*salvages) if len(salvages) == 1 else merged:
        number = channels.get(topic)
        writer.copy(announce(topic) if number is None else number, sequence, log_ns, publish_ns, data)
        salvage.saved += 1
    for topic in dict.fromkeys(topic for salvage in salvages for topic in salvage.topics):
        if topic not in channels and choice.topic(topic.name):  # without messages
            announce(topic)


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
