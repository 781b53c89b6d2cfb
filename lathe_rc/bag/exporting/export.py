# SPDX-License-Identifier: Apache-2.0
"""Export of a bag's signal topics; the memory required does not depend on the length of the bag."""

import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lathe_rc import messages
from lathe_rc.bag.exporting.formats import FORMATS, Format, Rows
from lathe_rc.bag.reading.source import Source
from lathe_rc.bag.reading.stream import feed
from lathe_rc.cell.columns import Column, columns, dense_rows, sparse_rows
from lathe_rc.cell.stage import Sparse
from lathe_rc.errors import InputError, LatheError
from lathe_rc.messages import Samples, Signals, full
from lathe_rc.names import instead

_TOPIC = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_LONGEST_TOPIC = 255  # characters; the limit for a file name
_MOST_TOPICS = 256  # each is an open file
_ROWS = 65536  # number of rows of a table collected before they are written


@dataclass(frozen=True)
class Exported:
    """Result of an export: its path, and the number of rows by topic."""

    place: Path
    rows: Mapping[str, int]


class _Table:
    """Row buffer of a topic's table, written out in batches."""

    def __init__(self, table: Sequence[Column], writer: Rows) -> None:
        self.columns, self.rows = table, 0
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
                table.add(sparse_rows(table.columns, found, self._step_ns))

    def close(self) -> Mapping[str, int]:
        """Complete the files and return the number of rows by topic."""
        for table in self._tables.values():
            table.close()
        self._target.finish()
        return {topic: table.rows for topic, table in self._tables.items()}


def _selected(source: Source, wanted: Sequence[str]) -> dict[str, str]:
    """Return the message types of the topics to export, by name."""
    found = sorted(source.topics.items())
    types = {topic: said.type for topic, said in found if said.type in messages.signal_types()}
    if not types:
        raise InputError(f"{source.path}: no signal topics of lathe_rc; nothing to export")
    for topic in map(full, wanted):
        if topic not in types:
            known = instead(topic, types, listing=f"lathe bag info {source.path}")
            raise InputError(f"--topics {topic}: not in the bag; {known}")
    chosen = {topic: types[topic] for topic in dict.fromkeys(map(full, wanted))} or types
    for topic in chosen:
        if not _TOPIC.fullmatch(topic) or len(topic) > _LONGEST_TOPIC:
            raise InputError(
                f"{source.path}: topic {topic[:80]!r} is no name of ROS and gives no file; name others by --topics"
            )
    if len(chosen) > _MOST_TOPICS:
        raise InputError(f"{source.path}: {len(chosen)} topics; allowed at a time: {_MOST_TOPICS}, named by --topics")
    return chosen


def _step_ns(source: Source) -> int:
    """Return the sampling step of the run [ns]; 0 if the bag has no block."""
    dense = [topic for topic, found in source.topics.items() if found.type in messages.block_types()]
    return next((step_ns for topic in dense if (step_ns := source.step_ns(topic))), 0)


def _refuse_existing(place: Path) -> None:
    if place.exists():
        raise InputError(f"{place} exists; an export never overwrites: name another place or remove it")


def export_bag(
    bag: str | os.PathLike[str], place: str | os.PathLike[str], kind: str, topics: Sequence[str] = ()
) -> Exported:
    """Export signal topics of a bag to other files, atomically.

    Args:
        bag: path of the bag.
        place: folder to create; for ``npz``, the file to create.
        kind: ``csv``, ``parquet`` or ``npz``.
        topics: topics to export, with or without the leading slash; all topics if empty.

    Raises:
        InputError: the output exists, a topic does not exist, or the path is not a bag.
        LatheError: the bag is incomplete, or writing to the disk fails.

    Example:
        >>> import lathe_rc
        >>> result = lathe_rc.run(lathe_rc.load("piston", ["spindle_encoder.revolutions=2"]), bag="piston_bag")
        >>> exported = lathe_rc.export_bag("piston_bag", "piston.npz", "npz", ["/tool"])
    """
    bag, place = Path(bag), Path(place)
    _refuse_existing(place)
    if not place.absolute().parent.is_dir():
        raise InputError(f"{place}: no such folder {place.absolute().parent}; make it first")
    with Source(bag) as source:
        types, step_ns = _selected(source, topics), _step_ns(source)
    try:
        with tempfile.TemporaryDirectory(prefix=f".{place.name}.", dir=place.absolute().parent) as workshop:
            result = Path(workshop) / "result"
            target = FORMATS[kind](result)
            if target.folder:
                result.mkdir()
            exporter = Exporter(types, step_ns, target)
            feed(bag, [exporter])
            rows = exporter.close()
            _refuse_existing(place)  # another process may have created it meanwhile; the rename would replace it
            result.rename(place)
    except OSError as error:
        raise LatheError(f"{place}: cannot be written ({error.strerror or error})") from None
    return Exported(place, rows)
