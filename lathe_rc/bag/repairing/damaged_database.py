# SPDX-License-Identifier: Apache-2.0
"""Rows of a SQLite file of rosbag2 that is broken in places, or of an older layout."""

import sqlite3
from bisect import bisect_left
from collections.abc import Iterator
from typing import Any

from lathe_rc import messages
from lathe_rc.bag.reading.limits import MOST_BYTES, MOST_TOPICS
from lathe_rc.bag.reading.sound_records import Told

_PAGE = 4096  # bytes that are said to be lost where SQLite does not say
_MOST_ID_BITS = 62  # of a row


def readable_rows(base: sqlite3.Connection, told: Told) -> Iterator[tuple[Any, Any, Any]]:
    """Topic, time and bytes of the messages on all pages that are whole; no bytes if there are too many."""
    query = (
        f"SELECT id, topic_id, timestamp, CASE WHEN length(data) <= {MOST_BYTES} THEN data END"  # noqa: S608 - a constant
        " FROM messages WHERE id >= ? ORDER BY id"
    )
    first = 0

    def readable(step: int) -> bool:
        try:
            base.execute(f"{query} LIMIT 1", (first + step,)).fetchone()
        except sqlite3.DatabaseError:
            return False
        return True

    while True:
        try:
            for number, *row in base.execute(query, (first,)):
                yield row[0], row[1], row[2]
                first = number + 1
        except sqlite3.DatabaseError as error:
            told(f"from message {first} on: {error}", _PAGE)
        else:
            return
        step = next((2**k for k in range(_MOST_ID_BITS) if readable(2**k)), None)
        if step is None:
            return
        first += bisect_left(range(step), 1, lo=step // 2, key=readable)


def known_definition(kind: str) -> tuple[str, str, str]:
    """Encoding, text and hash of a type's definition, empty if this package does not have it."""
    store = messages.store()
    if kind not in store.fielddefs:
        return "", "", ""
    return "ros2msg", store.generate_msgdef(kind, ros_version=2)[0], store.hash_rihs01(kind)


def select(base: sqlite3.Connection, table: str, columns: tuple[str, ...]) -> list[tuple[Any, ...]]:
    """Rows of a table as texts, but for a number in the first column; bags of older ROS lack columns and tables."""
    there = {row[1] for row in base.execute(f"PRAGMA table_info({table})")}
    if columns[0] not in there:
        return []
    listed = ", ".join(name if name in there else "''" for name in columns)
    rows = base.execute(f"SELECT {listed} FROM {table}").fetchmany(MOST_TOPICS)  # noqa: S608 - of constants
    return [(first, *(text if isinstance(text, str) else "" for text in rest)) for first, *rest in rows]
