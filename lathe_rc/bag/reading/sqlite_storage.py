# SPDX-License-Identifier: Apache-2.0
"""Reader of SQLite files written by rosbag2; neither these files nor the files beside them are changed."""

import contextlib
import json
import os
import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lathe_rc.bag.reading.limits import MOST_BYTES, MOST_TOPICS
from lathe_rc.bag.reading.storage import Batch, Channel, Span, Storage
from lathe_rc.bag.reading.unpacking import ReadingBudget
from lathe_rc.errors import InputError, shown

_LAST = 2**63 - 1  # largest integer in SQLite
_LOG_HEAD, _FRAME_HEAD = 32, 24  # in a write-ahead log [B]; the same two random numbers in both mark a current frame
_JOURNAL = b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7"  # at the end of a rollback journal that names a super-journal
_WRONG = (ValueError, sqlite3.Error, OverflowError)  # exceptions caused by damaged bytes


def with_journal(path: Path, folder: Path) -> tuple[Path, int]:
    """Return a database that includes the messages in its logs: the original, or a copy in ``folder`` if it has logs.

    A killed recorder leaves a write-ahead log or a rollback journal, which the next writer would apply to the database;
    here it is applied to the copy.

    Returns:
        The database, and the number of unusable bytes in the write-ahead log: damaged, or of an incomplete transaction.

    Raises:
        InputError: a log is a link.
        ValueError: a journal names another file.
        OSError: the copy cannot be created.
        sqlite3.Error: the database is damaged.
    """
    beside = Path(os.path.realpath(path))  # SQLite expects the logs beside the target of a link
    found = [beside.with_name(f"{beside.name}-{kind}") for kind in ("wal", "journal")]
    logs = [log for log in found if log.is_file() and log.stat().st_size]
    for log in logs:
        if log.is_symlink():
            raise InputError(f"{log}: a link; allowed: the file itself in its place")
        if log.name.endswith("-journal") and _names_another(log):  # SQLite would delete the named journal
            raise ValueError(f"{log.name}: it names a further journal; no recorder writes such")
    if not logs:
        return path, 0
    copy = folder / path.name
    shutil.copyfile(path, copy)
    for log in logs:
        shutil.copyfile(log, folder / f"{path.name}{log.name.removeprefix(beside.name)}")
    # Any connection applies a hot journal to the database; a write-ahead log needs the checkpoint.
    with contextlib.closing(sqlite3.connect(copy)) as base:
        _, frames, _ = base.execute("PRAGMA wal_checkpoint").fetchone()
        base.execute("PRAGMA journal_mode=DELETE").fetchall()
    return copy, _left(logs[0], frames) if logs[0].name.endswith("-wal") else 0


def _names_another(journal: Path) -> bool:
    with journal.open("rb") as stream:
        stream.seek(max(journal.stat().st_size - len(_JOURNAL), 0))
        return stream.read() == _JOURNAL


def _left(log: Path, frames: int) -> int:
    """Return the number of bytes after a write-ahead log's valid frames, not counting frames of an earlier log."""
    end = log.stat().st_size
    if frames <= 0:
        return end
    with log.open("rb") as stream:
        head = stream.read(_LOG_HEAD)
        size, left = int.from_bytes(head[8:12], "big") + _FRAME_HEAD, 0
        for place in range(_LOG_HEAD + frames * size, end, size):
            stream.seek(place + 8)
            left += min(size, end - place) if stream.read(8) == head[16:24] else 0
    return left


def connect(path: Path) -> sqlite3.Connection:
    """Open a database read-only."""
    # With immutable, SQLite takes no locks and creates no -wal or -shm files: the bag may be on a read-only disk.
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)


@dataclass(frozen=True)
class _Table(Span):
    """Message table of a database."""

    path: Path

    def read(self, topics: Mapping[int, str], start_ns: int, stop_ns: int, budget: ReadingBudget) -> Iterator[Batch]:
        """Yield the messages one by one, in order of log time."""
        query = """SELECT topic_id, timestamp, CASE WHEN length(data) <= ? THEN data END FROM messages
            WHERE topic_id IN (SELECT value FROM json_each(?)) AND timestamp BETWEEN ? AND ? ORDER BY timestamp, id"""
        with contextlib.closing(connect(self.path)) as base:
            for number, log_ns, data in base.execute(
                query, (MOST_BYTES, json.dumps(list(topics)), max(start_ns, 0), min(stop_ns - 1, _LAST))
            ):
                # A damaged index may return rows other than those requested.
                sound = number in topics and isinstance(log_ns, int) and log_ns >= 0 and isinstance(data, bytes)
                if not sound:
                    raise ValueError(f"message of topic {str(number)[:20]} at {str(log_ns)[:20]} ns, or too long")
                budget.take(len(data), 1)
                yield Batch(data, topics, np.array([[number, log_ns, 0, len(data)]], np.uint64))


def open_sqlite(path: Path, folder: Path) -> Storage:
    """Return a database's topics and one span with its messages; a copy may be created in ``folder``.

    Raises:
        InputError, ValueError, OSError, sqlite3.Error: see `with_journal`.
    """
    storage = Storage()
    path, left = with_journal(path, folder)
    try:
        with contextlib.closing(connect(path)) as base:
            check_tables(base)
            _read_topics(base, storage)
            first, last = _count(base, storage)
    except _WRONG as error:
        storage.damage.append(shown(error))
        first = last = 0
    storage.damage += [left_over(left)] if left else []
    storage.damage = [f"{path.name}: {what}" for what in storage.damage]
    storage.first_ns, storage.last_ns = first, last
    storage.spans.append(_Table(storage.first_ns, storage.last_ns, 0, frozenset(storage.channels), path))
    return storage


def left_over(size: int) -> str:
    """Describe the unusable bytes of a write-ahead log."""
    return f"{size} B of its write-ahead log are broken, or were not written to the end"


def _read_topics(base: sqlite3.Connection, storage: Storage) -> None:
    base.execute("SELECT id FROM topics LIMIT 0")  # fails if there is no such table
    columns = ("id", "name", "type", "serialization_format", "offered_qos_profiles")
    for number, topic, msgtype, encoding, profiles in select(base, "topics", columns):
        if not isinstance(number, int) or not 0 <= number <= _LAST:
            raise ValueError(f"topic {str(number)[:80]!r}; allowed: whole numbers from 0 on")
        storage.announce(number, Channel(topic, msgtype, encoding), profiles)


def select(base: sqlite3.Connection, table: str, columns: tuple[str, ...]) -> list[tuple[Any, ...]]:
    """Return the rows of a table as strings, with a number in the first column; old bags may lack columns or tables."""
    there = {row[1] for row in base.execute(f"PRAGMA table_info({table})")}
    if columns[0] not in there:
        return []
    listed = ", ".join(name if name in there else "''" for name in columns)
    rows = base.execute(f"SELECT {listed} FROM {table}").fetchmany(MOST_TOPICS + 1)  # noqa: S608 - built from constants
    return [(first, *(text if isinstance(text, str) else "" for text in rest)) for first, *rest in rows]


def _count(base: sqlite3.Connection, storage: Storage) -> tuple[int, int]:
    """Count the messages of each topic; return the first and the last log time [ns]."""
    query = "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
    try:
        counts = base.execute(query).fetchmany(2 * MOST_TOPICS)
    except sqlite3.DatabaseError as error:
        storage.damage.append(shown(error))
        counts = _count_rows(base)
    lost, times = 0, []
    for number, count, first, last in counts:
        if number in storage.channels and isinstance(first, int) and isinstance(last, int) and first >= 0:
            storage.channels[number].count = count
            times += [first, last]
        else:
            lost += count
    if lost:
        storage.damage.append(f"{lost} messages of no topic that it lists, or without a log time from 0 on")
    return min(times, default=0), max(times, default=0)


def _count_rows(base: sqlite3.Connection) -> list[tuple[int, int, int, int]]:
    """Count the messages by topic, up to the first damaged page of the database."""
    times: dict[int, list[int]] = {}
    with contextlib.suppress(sqlite3.DatabaseError):
        for number, log_ns in base.execute("SELECT topic_id, timestamp FROM messages"):
            if isinstance(number, int) and isinstance(log_ns, int):
                count, first, last = times.setdefault(number, [0, log_ns, log_ns])
                times[number] = [count + 1, min(first, log_ns), max(last, log_ns)]
    return [(number, *three) for number, three in times.items()]  # type: ignore[misc]


def check_tables(base: sqlite3.Connection) -> None:
    """Reject a SQLite file with computed content: views, triggers or generated columns.

    Raises:
        ValueError: the file has such content, or a message that is too long.
        sqlite3.Error: the file is not a SQLite database.
    """
    made = base.execute("SELECT name, type, coalesce(sql, '') FROM sqlite_master").fetchmany(MOST_TOPICS)
    for name, kind, sql in made:
        columns = (
            base.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,)).fetchall() if kind == "table" else []
        )
        computed = any(hidden for (hidden,) in columns)
        if kind not in ("table", "index") or computed or str(sql).upper().startswith("CREATE VIRTUAL"):
            raise ValueError(f"{str(kind)[:20]} {str(name)[:80]!r} in the database; rosbag2 makes plain tables only")
    if any(name == "messages" for name, _, _ in made):
        longest = None
        with contextlib.suppress(sqlite3.DatabaseError):  # partly damaged: the readable parts are examined later
            (longest,) = base.execute("SELECT max(length(data)) FROM messages").fetchone()
        if isinstance(longest, int) and longest > MOST_BYTES:
            raise ValueError(f"a message of {longest} B; allowed: up to {MOST_BYTES}")
