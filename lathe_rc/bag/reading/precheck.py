# SPDX-License-Identifier: Apache-2.0
"""Checks that refuse what would cost a reader unlimited memory or time: YAML that grows, a database that computes."""

import contextlib
import sqlite3
from typing import Any

import yaml

from lathe_rc.bag.reading.limits import LONGEST_NAME, MOST_BYTES, MOST_DEPTH, MOST_EVENTS, MOST_TOPICS

_YAML = getattr(yaml, "CBaseLoader", yaml.BaseLoader)  # makes texts alone: no dates, no objects


def read_yaml(text: str, what: str) -> Any:
    """Lists, maps and texts of a YAML text; numbers are texts too.

    Raises:
        ValueError: see `check_yaml`; or a map's key is a collection.
    """
    check_yaml(text, what)
    try:
        return yaml.load(text, Loader=_YAML)  # noqa: S506 - makes texts alone
    except yaml.YAMLError as error:
        raise ValueError(f"{what}: {getattr(error, 'problem', 'not YAML')}") from None


def check_yaml(text: str, what: str) -> None:
    """Refuse a text that would grow when it is read, or take too long.

    Raises:
        ValueError: it has aliases, is nested too deep or too long, or is no YAML.
    """
    depth = 0
    try:
        for count, event in enumerate(yaml.parse(text, Loader=_YAML)):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"{what}: YAML aliases; ROS 2 writes none")  # noqa: TRY004 - the file's fault
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MOST_DEPTH or count > MOST_EVENTS:
                raise ValueError(f"{what}: nested deeper than {MOST_DEPTH} or of more than {MOST_EVENTS} parts")
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise ValueError(f"{what}: not YAML{f' in line {mark.line + 1}' if mark else ''}") from None
    except OverflowError:
        raise ValueError(f"{what}: not YAML (a character beyond Unicode)") from None


def check_name(name: object) -> None:
    """Refuse the name of a topic or type that could not be shown in a line.

    Raises:
        ValueError: it is no text, too long, or has characters that do not print.
    """
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= LONGEST_NAME:
        raise ValueError(f"name {str(name)[:80]!r}; allowed: up to {LONGEST_NAME} characters that print")


def is_packed(head: bytes) -> bool:
    """Whether a file that begins like this is compressed as a whole, or what comes first is skipped by zstd."""
    return head.startswith(b"\x28\xb5\x2f\xfd") or (head[1:4] == b"\x2a\x4d\x18" and head[0] >> 4 == 5)


def check_tables(base: sqlite3.Connection) -> None:
    """Refuse a SQLite file whose answers are more than what it holds: views, triggers, columns that are computed.

    Raises:
        ValueError: it has some, or a message that is too long.
        sqlite3.Error: it is none.
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
        with contextlib.suppress(sqlite3.DatabaseError):  # broken somewhere: what can be read of it is looked at later
            (longest,) = base.execute("SELECT max(length(data)) FROM messages").fetchone()
        if isinstance(longest, int) and longest > MOST_BYTES:
            raise ValueError(f"a message of {longest} B; allowed: up to {MOST_BYTES}")
