# SPDX-License-Identifier: Apache-2.0
"""Reader of bags from any recorder: rosbag2 folders with any storage and compression, or a single file from one.

No size stated in a bag is trusted: each is checked before memory of that size is allocated. The limits are in
`lathe_rc.bag.reading.limits`.
"""

import heapq
import os
import sqlite3
import struct
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from operator import itemgetter
from pathlib import Path
from types import TracebackType

from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from lathe_rc.bag.loss import Loss, loss_of
from lathe_rc.bag.reading import metadata
from lathe_rc.bag.reading.limits import MOST_OPEN, MOST_TOPICS
from lathe_rc.bag.reading.mcap_storage import open_mcap
from lathe_rc.bag.reading.metadata import Metadata, Topic
from lathe_rc.bag.reading.seal import Seal
from lathe_rc.bag.reading.sealed_metadata import compare
from lathe_rc.bag.reading.storage import Batch, Message, Span, Storage
from lathe_rc.bag.reading.unpacking import ReadingBudget, is_packed, unpack, unpack_file, unpacked_size
from lathe_rc.blocks.block import Block
from lathe_rc.blocks.wire import Decoder
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.messages import START_NS, block_types

_TOGETHER, _TOGETHER_BYTES = 2**14, 2**22  # number and total size [B] of messages handed on together
_NEVER = 2**64  # log time after all others [ns]
_SQLITE = b"SQLite format 3\0"
_KINDS = (".mcap", ".db3", ".zstd")
_RECOVER = "; lathe bag recover saves the rest"
_SEAL_ANEW = "; lathe bag check tells all, lathe bag recover makes a sealed bag of what was recorded"
_WRONG = (ValueError, OSError, struct.error, sqlite3.Error, ZstdError)  # exceptions caused by damaged bytes and files

Read = tuple[Span, Mapping[int, str]]  # a span and its requested channels


@dataclass(frozen=True)
class Unread:
    """Topic whose messages are not read.

    Attributes:
        topic: name of the topic.
        type: message type; empty if the bag states none.
        why: reason for not reading it.
        count: number of messages.
    """

    topic: str
    type: str
    why: str
    count: int

    def __str__(self) -> str:
        """Return the topic, type, message count and reason as text."""
        return f"{self.topic} {self.type}".strip() + f", {self.count} messages {self.why}"


def files_of(path: Path) -> list[Path]:
    """Return the message files of a bag, sorted by name: those in a folder, or the named file itself.

    If a player has left an unpacked copy next to a compressed file, only the compressed file is returned.

    Raises:
        InputError: a file of the bag is a link that leads out of the folder.
    """
    found = [path] if path.is_file() else [*path.glob("*")]
    for file in found:
        if file.suffix in _KINDS or file.name in (metadata.NAME, "digests.json"):
            _refuse_link(file, path)
    packed = {file.with_suffix("") for file in found if file.suffix == ".zstd"}
    return sorted(file for file in found if file.suffix in _KINDS and file not in packed and file.is_file())


def _refuse_link(file: Path, bag: Path) -> None:
    """Reject a file that is a link leading out of its bag.

    Raises:
        InputError: the file is such a link.
    """
    folder = Path(os.path.realpath(bag))  # unlike Path.resolve, it accepts circular links
    if file != bag and not Path(os.path.realpath(file)).is_relative_to(folder):
        raise InputError(f"{file}: a link that leads out of the bag; allowed: the file itself in its place")


def name_of(path: Path) -> str:
    """Return the name of a bag, for the names of derived files; paths ``.`` and ``..`` are resolved."""
    return Path(os.path.abspath(path)).name  # noqa: PTH100 - resolve() fails on circular links


class BagSource:
    """Bag opened for reading; a context manager.

    Args:
        path: rosbag2 folder, or a single file from one.
        partial: whether to read the readable parts of a damaged bag.
        altered: whether to read a bag that does not agree with its seal, by what is sealed.
        whole: whether blocks are read beyond the loss of a member.

    Attributes:
        path: path of the bag.
        topics: readable topics by name.
        unread: other topics, whose messages have no type or are not serialized as in ROS 2.
        about: strings from the bag's metadata (see docs/bags.md).
        first_ns, last_ns: smallest and largest log time [ns]; both 0 if the bag is empty.
        contradictions: differences between the bag's metadata and its files, one line each; the files take precedence.
        damage: unreadable parts, one line each; empty unless ``partial``.
        seal: seal of the bag; None if no seal holds.
        altered: differences from what was sealed when the bag was closed, one line each; also that a bag of lathe_rc
            has no seal. Empty unless ``partial`` or ``altered``.

    Raises:
        InputError: the path is not a bag, or the bag does not agree with its seal, or is incomplete or, with
            ``partial``, has no readable part.
    """

    def __init__(self, path: Path, *, partial: bool = False, altered: bool = False, whole: bool = False) -> None:
        self.path, self._whole = path, whole
        self.about: Mapping[str, str] = {}
        self.first_ns = self.last_ns = 0
        self.topics: dict[str, Topic] = {}
        self.unread: list[Unread] = []
        self.contradictions: list[str] = []
        self.damage: list[str] = []
        self.altered: list[str] = []
        self.seal: Seal | None = None
        self._storages: list[Storage] = []
        self._size, self._packed = 0, False
        self._temporary = ExitStack()
        try:
            self._open()
        except _WRONG as error:
            self.damage.append(_reason(error))
        except BaseException:
            self._temporary.close()
            raise
        saved = any(topic.count for topic in self.topics.values())
        if self.damage and not (partial and (saved or self.unread)):
            self._temporary.close()
            raise InputError(f"{path}: not a readable bag ({self.damage[0]}){_RECOVER if saved else ''}")
        if self.altered and not (partial or altered):
            self._temporary.close()
            raise InputError(f"{path}: {self.altered[0]}{_SEAL_ANEW}")
        self.damage += self.altered if partial else []
        if self.unread and not self.topics and not partial:
            self._temporary.close()
            raise InputError(f"{path}: no topic that can be read ({self.unread[0]}); allowed: messages of ROS 2")

    def _open(self) -> None:
        if not self.path.exists():
            raise ValueError("there is no such folder or file")
        files, told = [self.path], None
        if self.path.is_dir():
            files = files_of(self.path)
            told = self._metadata(files)
        if told:
            named = told.files
            others = [f for f in files if f.name not in named and f.name.removesuffix(".zstd") not in named]
            files = [self.path / name for name in named]
            for file in files:
                _refuse_link(file, self.path)
            if not all(file.exists() for file in files):
                files += others  # may be renamed copies; recover reads them as well
            else:
                self.contradictions += [
                    f"{metadata.NAME} does not name {file.name}: not read; lathe bag recover saves its messages too"
                    for file in others
                ]
        by_name: dict[str, Storage] = {}
        for file in files:
            try:
                by_name[file.name] = self._storage(file)
                self._size += file.stat().st_size
            except _WRONG as error:
                self.damage.append(f"{file.name}: {_reason(error)}")
        self._storages = [*by_name.values()]
        found = compare(told, {name: each.sealed for name, each in by_name.items()}, whole=self.path.is_dir())
        self.seal, told, self.altered = found.seal, found.metadata, found.strangers + found.changes
        if told:
            self.about, self._packed = told.about, told.packed
        for storage in self._storages:
            self.damage += storage.damage
            self.contradictions += storage.remarks
        self._gather()
        filled = [storage for storage in self._storages if any(c.count for c in storage.channels.values())]
        self.first_ns = min((storage.first_ns for storage in filled), default=0)
        self.last_ns = max((storage.last_ns for storage in filled), default=0)
        if told:
            self._compare(told, by_name)
        if len(self.topics) > MOST_TOPICS:
            raise ValueError(f"{len(self.topics)} topics; allowed: up to {MOST_TOPICS}")

    def _metadata(self, files: Sequence[Path]) -> Metadata | None:
        """Return the metadata of a folder; None if they are missing or unreadable, and only the files are used."""
        if not (self.path / metadata.NAME).exists():
            if not files:
                raise ValueError(f"no {metadata.NAME} in that folder, nor a .mcap or .db3 file")
            names = f"{files[0].name} alone is" if len(files) == 1 else f"its {len(files)} files are"
            self.contradictions.append(f"no {metadata.NAME} in that folder: {names} read; lathe bag recover writes one")
            return None
        try:
            told = metadata.read(self.path)
        except ValueError as error:
            self.damage.append(shown(error))
            return None
        if told.repeated:
            self.contradictions.append(f"{metadata.NAME} names a file more than once")
        return told

    def _storage(self, path: Path, depth: int = 0) -> Storage:
        """Open one file of the bag, unpacking it first if it is compressed as a whole."""
        if not path.is_file():
            raise ValueError("no file" if path.exists() else "there is no such file")  # opening a pipe would block
        with path.open("rb") as stream:
            head = stream.read(len(_SQLITE))
        if head.startswith(MCAP0_MAGIC):
            return open_mcap(path)
        if head == _SQLITE:
            from lathe_rc.bag.reading.sqlite_storage import open_sqlite

            return open_sqlite(path, self._folder())
        if not is_packed(head):
            raise ValueError("a bag of ROS 1" if head.startswith(b"#ROSBAG") else "not an MCAP or SQLite file")
        if depth:
            raise ValueError("compressed twice")
        plain = self._folder() / path.stem
        with plain.open("wb") as out:
            out.writelines(unpack_file(path))
        return self._storage(plain, 1)

    def _folder(self) -> Path:
        """Create a temporary folder that is removed when the bag is closed."""
        return Path(self._temporary.enter_context(tempfile.TemporaryDirectory(prefix="lathe-bag-")))

    def _gather(self) -> None:
        """Collect the topics of all files."""
        unread: dict[tuple[str, str, str], int] = {}
        for channel in chain.from_iterable(storage.channels.values() for storage in self._storages):
            known = self.topics.get(channel.topic)
            why = channel.unread or (known and known.type != channel.type and f"beside those of {known.type}") or ""
            if why:
                key = channel.topic, channel.type, why
                unread[key] = unread.get(key, 0) + channel.count
                continue
            before = known or Topic(channel.type, (), 0)
            qos = before.qos if set(channel.qos) <= set(before.qos) else before.qos + channel.qos
            self.topics[channel.topic] = Topic(channel.type, qos, before.count + channel.count)
        self.unread = [Unread(*key, count) for key, count in unread.items()]

    def _compare(self, told: Metadata, files: Mapping[str, Storage]) -> None:
        """Add the metadata that the files lack, and note where metadata and files contradict each other."""
        wrong: list[tuple[str, int]] = []
        if told.span and self._storages:
            held = zip(("first", "last"), told.span, (self.first_ns, self.last_ns), strict=True)
            wrong += [(f"{which} message at {said} ns", found) for which, said, found in held if said != found]
        unread = {each.topic: each.count for each in self.unread}
        for topic, said in told.topics.items():
            known = self.topics.get(topic)
            if known and not known.qos:
                self.topics[topic] = replace(known, qos=said.qos)
            elif not known and topic not in unread:
                self.topics[topic] = Topic(said.type, said.qos, 0)
            count = (known.count if known else 0) + unread.get(topic, 0)
            wrong += [(f"{said.count} messages of {topic}", count)] if said.count != count else []
        counts = {name: sum(c.count for c in storage.channels.values()) for name, storage in files.items()}
        totals = [("in all", told.count, sum(counts.values()))]
        totals += [(f"in {name}", said, counts[name]) for name, said in told.counts.items() if name in counts]
        wrong += [(f"{said} messages {where}", count) for where, said, count in totals if said != count]
        untold = self.topics.keys() - told.topics.keys()
        wrong += [(f"0 messages of {topic}", self.topics[topic].count) for topic in sorted(untold)]
        self.contradictions += [f"{metadata.NAME} says {said}; the files: {found}" for said, found in wrong]

    def __enter__(self) -> "BagSource":
        """Return the bag itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bag and remove its temporary files."""
        self._temporary.close()

    @cached_property
    def loss(self) -> Loss | None:
        """Loss of a member, at which reading ends; None: the bag ends before, and is read to its end.

        Raises:
            InputError: the bag's entry about it is not in the recorder's format; see also `messages`.
        """
        return loss_of(self.about) if not self._whole and self.last_ns >= self.loss_ns else None

    @cached_property
    def loss_ns(self) -> int:
        """Simulated time at which a member was lost [ns]; later than all others without a loss (errors as for `loss`).

        It is that of sample 0 if the bag has no block.
        """
        if not (loss := loss_of(self.about)):
            return _NEVER
        dense = {topic: said.type for topic, said in self.topics.items() if said.type in block_types()}
        topic, _, data = next(self.messages(set(dense)), ("", 0, b"")) if dense else ("", 0, b"")
        try:
            return START_NS + loss.first * (Decoder(dense[topic]).decode(data).step_ns if topic else 0)
        except ValueError as error:
            raise LatheError(f"{self.path}: {topic}: {shown(error)}") from None

    def blocks(self, topic: str, *, start_ns: int | None = None) -> Iterator[Block]:
        """Yield the blocks of a dense topic, starting at a log time [ns], up to the `loss` of a member.

        Raises:
            InputError: see `messages`.
            LatheError: a block cannot be decoded.
        """
        decoder, loss = Decoder(self.topics[topic].type), self.loss
        for _, _, data in self.messages({topic}, start_ns=start_ns):
            try:
                block = decoder.decode(data)
            except ValueError as error:
                raise LatheError(f"{self.path}: {topic}: {shown(error)}") from None
            if loss and block.first_index + block.samples > loss.first:
                if block.first_index < loss.first:
                    yield block.part(0, loss.first - block.first_index)
                return
            yield block

    def step_ns(self, topic: str) -> int:
        """Return the sampling step of a dense topic from its first block [ns]; 0 if it has no block.

        Raises:
            InputError: see `messages`.
            LatheError: the block cannot be decoded.
        """
        return next((block.step_ns for block in self.blocks(topic)), 0)

    def messages(
        self, topics: set[str] | None = None, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Message]:
        """Yield the topic, log time [ns] and bytes of each message, in order of log time (see `batches`)."""
        return chain.from_iterable(self.batches(topics, start_ns=start_ns, stop_ns=stop_ns))

    def batches(
        self, topics: set[str] | None = None, *, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Batch]:
        """Yield the messages in order of log time, in batches of a convenient size.

        Args:
            topics: topics to read; None: all.
            start_ns: smallest log time to read [ns].
            stop_ns: log time at which reading stops, exclusive [ns].

        Raises:
            InputError: the bag is damaged at the position of the next message.
        """
        names = set(self.topics) if topics is None else topics & set(self.topics)
        start, stop = start_ns or 0, _NEVER if stop_ns is None else stop_ns
        budget = ReadingBudget(self._size)
        reads: list[Read] = []
        for storage in self._storages:
            wanted = {
                number: channel.topic
                for number, channel in storage.channels.items()
                if channel.topic in names and not channel.unread and channel.type == self.topics[channel.topic].type
            }
            reads += [
                (span, wanted)
                for span in storage.spans
                if wanted and span.last_ns >= start and span.first_ns < stop
                and (not span.channels or not span.channels.isdisjoint(wanted))
            ]  # fmt: skip
        try:
            found = chain.from_iterable(_merged(group, start, stop, budget) for group in _overlapping(reads))
            if self._packed:
                found = chain.from_iterable(self._unpacked(each, budget) for each in found)
            yield from _larger(found)
        except _WRONG as error:
            hint = _RECOVER if any(map(_readable, reads)) else ""
            raise InputError(f"{self.path}: broken ({_reason(error)}){hint}") from None

    def _unpacked(self, batch: Batch, budget: ReadingBudget) -> Iterator[Batch]:
        """Unpack messages that are compressed individually, each to at most its stated size."""
        for topic, log_ns, data in batch:
            whole = unpack("zstd", data, unpacked_size(data[:18]))
            budget.take(len(whole))
            yield Batch.of((topic, log_ns, whole))


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else "") or shown(error)


def _overlapping(reads: Sequence[Read]) -> Iterator[list[Read]]:
    """Group the spans that overlap in log time; consecutive groups do not overlap."""
    group: list[Read] = []
    end = 0
    for read in sorted(reads, key=lambda read: read[0].first_ns):
        if group and read[0].first_ns >= end:
            yield group
            group = []
        group.append(read)
        end = max(end, read[0].last_ns)
    if group:
        yield group


def _merged(group: Sequence[Read], start: int, stop: int, budget: ReadingBudget) -> Iterator[Batch]:
    """Merge the messages of overlapping spans by log time."""
    if len(group) == 1:
        ((span, wanted),) = group
        yield from span.read(wanted, start, stop, budget)
        return
    at_a_time = 0
    edges = [(span.first_ns, span.size) for span, _ in group] + [(span.last_ns + 1, -span.size) for span, _ in group]
    for _, size in sorted(edges):
        at_a_time += size
        if at_a_time > MOST_OPEN:
            raise ValueError(f"chunks of the same time take more than {MOST_OPEN} B; record them in order of time")

    # The merge starts by requesting one message from each generator, which would unpack all chunks of the group. Each
    # generator therefore begins with a marker at the first time of its span.
    def late(span: Span, wanted: Mapping[int, str]) -> Iterator[Message]:
        yield "", span.first_ns, b""
        yield from chain.from_iterable(span.read(wanted, start, stop, budget))

    for message in heapq.merge(*(late(*read) for read in group), key=itemgetter(1)):
        if message[0]:
            yield Batch.of(message)


def _larger(found: Iterator[Batch]) -> Iterator[Batch]:
    """Join consecutive batches, since blocks that lie together are decoded together; the first come soon."""
    some: list[Batch] = []
    count = size = most = 0
    try:
        for batch in found:
            if some and (size >= most or count + len(batch) > _TOGETHER):
                yield Batch.joined(some)
                most = min(most + size, _TOGETHER_BYTES)
                some, count, size = [], 0, 0
            some.append(batch)
            count, size = count + len(batch), size + len(batch.whole)
    except _WRONG:  # what precedes the damage is handed on
        if some:
            yield Batch.joined(some)
        raise
    if some:
        yield Batch.joined(some)


def _readable(read: Read) -> bool:
    """Return whether a span has at least one readable message."""
    span, wanted = read
    try:
        return any(span.read(wanted, 0, _NEVER, ReadingBudget(span.size)))
    except _WRONG:
        return False
