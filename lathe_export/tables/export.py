# SPDX-License-Identifier: Apache-2.0
"""Export of a bag's topics; the memory required does not depend on the length of the bag."""

import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lathe_export.tables import message_rows
from lathe_export.tables.formats import FORMATS, Format, Rows
from lathe_export.tables.message_rows import is_known
from lathe_rc import messages
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.stream import BagHeader, feed, first_of
from lathe_rc.blocks.columns import Column, columns, dense_rows, sparse_rows
from lathe_rc.blocks.ports import Sparse
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.messages import Samples, Signals, full
from lathe_rc.names import instead

_TOPIC = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_LONGEST_TOPIC = 255  # characters; the limit for a file name
_MOST_TOPICS = 256  # each is an open file
_ROWS = 65536  # number of rows of a table collected before they are written


@dataclass(frozen=True)
class Exported:
    """Result of an export.

    Attributes:
        place: path of the file or folder.
        rows: number of rows by topic.
        left_out: exported topics with samples or messages that are not in their tables, with the reason, one line each.
        others: topics that were not asked for and are not exported.
    """

    place: Path
    rows: Mapping[str, int]
    left_out: Sequence[str] = ()
    others: Sequence[str] = ()


class _Table:
    """Row buffer of a topic's table, written out in batches."""

    def __init__(self, table: Sequence[Column], writer: Rows) -> None:
        self.columns, self.rows, self.messages = table, 0, 0
        self._writer = writer
        self._waiting: list[Mapping[str, Samples]] = []
        self._pending = 0

    def add(self, rows: Mapping[str, Samples]) -> None:
        """Append rows; arrays kept for a later batch are copied, because the caller reuses them."""
        count = rows["sample"].size
        self.rows += count
        self._pending += count
        if self._pending < _ROWS:
            self._waiting.append({name: array.copy() for name, array in rows.items()})
            return
        self._waiting.append(rows)
        self._flush()

    def _flush(self) -> None:
        if self._waiting:
            names = [column.name for column in self.columns]
            self._writer.write({name: np.concatenate([rows[name] for rows in self._waiting]) for name in names})
        self._waiting, self._pending = [], 0

    def close(self) -> None:
        """Write the remaining rows and close the table."""
        self._flush()
        self._writer.close()


class Exporter:
    """Exporter of selected topics, one table per topic; a sink (see `lathe_rc.cell.engine.Sink`).

    Args:
        types: message types of the topics to export, by fully qualified name.
        step_ns: sampling step [ns].
        target: output format.
    """

    def __init__(self, types: Mapping[str, str], step_ns: int, target: Format) -> None:
        self._step_ns, self._target = step_ns, target
        self._tables = {t: _Table(columns(kind), target.table(t, columns(kind))) for t, kind in types.items()}

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Append the rows of a chunk."""
        for topic, signals in dense.items():
            if table := self._tables.get(full(topic)):
                table.add(dense_rows(first, signals, self._step_ns))
        for topic, found in sparse.items():
            table = self._tables.get(full(topic))
            if table and found:
                table.messages += len(found)
                table.add(sparse_rows(table.columns, found, self._step_ns))

    def close(self) -> Mapping[str, int]:
        """Complete the files and return the number of rows by topic."""
        for table in self._tables.values():
            table.close()
        self._target.finish()
        return {topic: table.rows for topic, table in self._tables.items()}

    def left_out(self, source: BagSource, header: BagHeader) -> list[str]:
        """Return what was not passed on of the blocks and messages of a bag, one line each."""
        first, said = first_of(source), list[str]()
        for topic, table in self._tables.items():
            about = source.topics[topic]
            if about.type in messages.block_types():
                early = next((block.first_index for block in source.blocks(topic)), first)
                if early < first:
                    said.append(f"{topic}: samples {early} to {first - 1}, which other topics lack")
            elif about.count > table.messages:
                said.append(f"{topic}: {about.count - table.messages} messages at times without samples of all topics")
        if header.left:
            said.append(f"samples from {header.samples} on, of topics that have up to {header.left} more than others")
        return said


def _selected(source: BagSource, wanted: Sequence[str]) -> dict[str, str]:
    """Return the message types of the topics to export, by name.

    Without topics that are asked for: those with signals of a cell or, in a bag without blocks, all.
    """
    known = {topic: said.type for topic, said in sorted(source.topics.items()) if is_known(said.type)}
    signals = {topic: kind for topic, kind in known.items() if kind in messages.signal_types()}
    unread = {topic: said.type for topic, said in source.topics.items() if topic not in known}
    for topic in map(full, wanted):
        if topic in unread:
            raise InputError(f"--topics {topic}: {shown(unread[topic])} is no type that is known here; name others")
        if topic not in known:
            raise InputError(
                f"--topics {topic}: not in the bag; {instead(topic, known, listing=f'lathe bag info {source.path}')}"
            )
    default = signals if _step_ns(source) else known
    chosen = {topic: known[topic] for topic in dict.fromkeys(map(full, wanted))} or default
    if not any(source.topics[topic].count for topic in chosen):
        raise InputError(f"{source.path}: no messages of known types in {', '.join(chosen) or 'it'}; nothing to export")
    for topic in chosen:
        if not _TOPIC.fullmatch(topic) or len(topic) > _LONGEST_TOPIC:
            raise InputError(
                f"{source.path}: topic {topic[:80]!r} is no name of ROS and gives no file; name others by --topics"
            )
    if len(chosen) > _MOST_TOPICS:
        raise InputError(f"{source.path}: {len(chosen)} topics; allowed at a time: {_MOST_TOPICS}, named by --topics")
    return chosen


def _step_ns(source: BagSource) -> int:
    """Return the sampling step of the run [ns]; 0 if the bag has no block."""
    dense = [topic for topic, found in source.topics.items() if found.type in messages.block_types()]
    return next((step_ns for topic in dense if (step_ns := source.step_ns(topic))), 0)


def _refuse_existing(place: Path) -> None:
    if place.exists():
        raise InputError(f"{place} exists; an export never overwrites: name another place or remove it")


def export_bag(
    bag: str | os.PathLike[str], place: str | os.PathLike[str], kind: str, topics: Sequence[str] = ()
) -> Exported:
    """Export topics of a bag to other files, atomically.

    Signals of a cell have a row per sample, its messages one per message and element. Other topics, and all topics of
    a bag without blocks, have one row per message (see `lathe_export.tables.message_rows`).

    Args:
        bag: path of the bag.
        place: folder to create; for ``npz``, the file to create.
        kind: ``csv``, ``parquet`` or ``npz``.
        topics: topics to export, with or without the leading slash; if empty, all signals or, without blocks, all.

    Raises:
        InputError: the output exists, a topic does not exist, or the path is not a bag.
        LatheError: the bag is incomplete, or writing to the disk fails.

    Example:
        >>> import lathe_export
        >>> import lathe_rc
        >>> result = lathe_rc.run(lathe_rc.load("piston", ["spindle_encoder.revolutions=2"]), bag="piston_bag")
        >>> exported = lathe_export.export_bag("piston_bag", "piston.npz", "npz", ["/tool"])
    """
    bag, place = Path(bag), Path(place)
    _refuse_existing(place)
    if not place.absolute().parent.is_dir():
        raise InputError(f"{place}: no such folder {place.absolute().parent}; make it first")
    with BagSource(bag) as source:
        types, step_ns = _selected(source, topics), _step_ns(source)
        signals = {topic: kind for topic, kind in types.items() if step_ns and kind in messages.signal_types()}
        others = [] if topics else sorted(source.topics.keys() - types.keys())
        try:
            with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.absolute().parent) as workshop:
                result = Path(workshop) / "result"
                target = FORMATS[kind](result)
                if target.folder:
                    result.mkdir()
                exporter = Exporter(signals, step_ns, target)
                rows = {topic: message_rows.export(source, topic, target) for topic in types if topic not in signals}
                header = feed(bag, [exporter]) if signals else None
                rows |= exporter.close()
                left_out = exporter.left_out(source, header) if header else []
                _refuse_existing(place)  # another process may have created it meanwhile; the rename would replace it
                result.rename(place)
        except OSError as error:
            raise LatheError(f"{place}: cannot be written ({error.strerror or error})") from None
    return Exported(place, {topic: rows[topic] for topic in types}, left_out, others)
