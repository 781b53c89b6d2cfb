# SPDX-License-Identifier: Apache-2.0
"""SQLite files as rosbag2 writes them, read without a change to them or to anything beside them."""

import json
import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lathe_rc.bag.reading.limits import MOST_TOPICS
from lathe_rc.bag.reading.precheck import check_tables
from lathe_rc.bag.reading.storage import Batch, Channel, Span, Storage
from lathe_rc.bag.reading.unpacking import Budget
from lathe_rc.errors import shown

_LAST = 2**63 - 1  # number that SQLite knows
_WRONG = (ValueError, sqlite3.Error, OverflowError)  # what broken bytes lead to


def with_journal(path: Path, folder: Path) -> Path:
    """A database with the messages that only its write-ahead log has: itself, or a copy in ``folder`` if there are any.

    A recorder that was killed leaves them there. The log is worked into the copy, as the first writer would do to the
    database. A rollback journal is not looked at: it may name a file of any folder, which SQLite then removes.

    Raises:
        OSError: the copy cannot be made.
        sqlite3.Error: the database is broken.
    """
    log = path.with_name(f"{path.name}-wal")
    if not log.is_file() or not log.stat().st_size:
        return path
    copy = folder / path.name
    shutil.copyfile(path, copy)
    shutil.copyfile(log, folder / log.name)
    with closing(sqlite3.connect(copy)) as base:
        base.execute("PRAGMA journal_mode=DELETE").fetchall()
    return copy


def connect(path: Path) -> sqlite3.Connection:
    """A database that nobody writes."""
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)


@dataclass(frozen=True)
class _Table(Span):
    """The messages of a database."""

    path: Path

    def read(self, topics: Mapping[int, str], start_ns: int, stop_ns: int, budget: Budget) -> Iterator[Batch]:
        """See `Span`."""
        query = """SELECT topic_id, timestamp, data FROM messages
            WHERE topic_id IN (SELECT value FROM json_each(?)) AND timestamp BETWEEN ? AND ? ORDER BY timestamp, id"""
        with closing(connect(self.path)) as base:
            for number, log_ns, data in base.execute(
                query, (json.dumps(list(topics)), max(start_ns, 0), min(stop_ns - 1, _LAST))
            ):
                if not isinstance(log_ns, int) or not isinstance(data, bytes):
                    raise ValueError(f"message of {topics[number]} at {str(log_ns)[:40]!r}: no time or no bytes")  # noqa: TRY004 - the file's fault
                budget.take(len(data), 1)
                yield Batch(data, topics, np.array([[number, log_ns, 0, len(data)]], np.uint64))


def open_sqlite(path: Path) -> Storage:
    """The topics of a database, and one span with its messages."""
    storage = Storage()
    try:
        with closing(connect(path)) as base:
            check_tables(base)
            _read_topics(base, storage)
            first, last = _count(base, storage)
    except _WRONG as error:
        storage.damage.append(f"{path.name}: {shown(error)}")
        return storage
    storage.first_ns, storage.last_ns = max(first, 0), max(last, 0)
    storage.spans.append(_Table(storage.first_ns, storage.last_ns, 0, frozenset(storage.channels), path))
    return storage


def _read_topics(base: sqlite3.Connection, storage: Storage) -> None:
    columns = {name for (name,) in base.execute("SELECT name FROM pragma_table_info('topics')")}
    offered = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"  # the oldest bags do not have it
    rows = base.execute(f"SELECT id, name, type, serialization_format, {offered} FROM topics")  # noqa: S608 - see above
    for number, name, kind, encoding, qos in rows.fetchmany(MOST_TOPICS + 1):
        if not isinstance(number, int) or not 0 <= number <= _LAST:
            raise ValueError(f"topic {str(number)[:80]!r}; allowed: whole numbers from 0 on")
        texts = [text if isinstance(text, str) else "" for text in (name, kind, encoding, qos)]
        storage.announce(number, Channel(*texts[:3]), texts[3])


def _count(base: sqlite3.Connection, storage: Storage) -> tuple[int, int]:
    """Count the messages of each topic; returns the first and the last log time."""
    query = "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
    counts = base.execute(query).fetchmany(2 * MOST_TOPICS)
    lost = 0
    for number, count, first, last in counts:
        if not isinstance(first, int) or not isinstance(last, int) or first < 0:
            raise ValueError(f"log time {str(first)[:40]!r}; allowed: whole numbers from 0 on")
        if number in storage.channels:
            storage.channels[number].count = count
        else:
            lost += count
    if lost:
        storage.damage.append(f"{lost} messages of topics that it does not list")
    return min((row[2] for row in counts), default=0), max((row[3] for row in counts), default=0)
