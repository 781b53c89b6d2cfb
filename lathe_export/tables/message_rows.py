# SPDX-License-Identifier: Apache-2.0
"""Messages of any ROS type as rows of a table, one per message, with flattened columns such as ``position[0]``."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from lathe_export.tables.formats import Format
from lathe_rc import messages
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.blocks.columns import MOST_COLUMNS, TEXT, Column, flattened
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.messages import Samples

_TIMES = (Column("time", np.dtype(np.float64), "s"), Column("log_ns", np.dtype(np.int64), "ns"))  # by the log
_STAMP = Column("stamp_ns", np.dtype(np.int64), "ns")  # in the header
_ROWS = 4096  # number of rows written together

Cell = tuple[Any, np.dtype[Any]]


def is_known(msgtype: str) -> bool:
    """Return whether messages of a type can be decoded."""
    return msgtype in messages.store().fielddefs


def _row(msgtype: str, log_ns: int, data: bytes) -> dict[str, Cell]:
    """Return the columns of an encoded message."""
    message = messages.decode(msgtype, data)
    row = {"time": (log_ns / 1e9, _TIMES[0].dtype), "log_ns": (log_ns, _TIMES[1].dtype)}
    if messages.fields(msgtype)[:1] == [("header", (Nodetype.NAME, "std_msgs/msg/Header"))]:
        row["stamp_ns"] = messages.stamp_ns(message), _STAMP.dtype
    parts = flattened(message)
    return row | {name: (value, dtype) for name, value, dtype in parts if not name.startswith("header.stamp.")}


def _rows(source: BagSource, topic: str) -> Iterator[dict[str, Cell]]:
    """Yield the columns of each message of a topic.

    Raises:
        LatheError: a message cannot be decoded, or is too large for a table.
    """
    msgtype = source.topics[topic].type
    for _, log_ns, data in source.messages({topic}):
        try:
            yield _row(msgtype, log_ns, data)
        except (InputError, ValueError) as error:
            kind = InputError if isinstance(error, InputError) else LatheError
            raise kind(f"{source.path}: {topic} at {log_ns} ns: {shown(error)}") from None


def _columns(source: BagSource, topic: str) -> list[Column]:
    """Return the columns of all messages of a topic, in the order of the fields.

    A number that some messages lack becomes a double, which is NaN there.
    """
    types: dict[str, np.dtype[Any]] = {}
    seen: dict[str, int] = {}
    count = 0
    for row in _rows(source, topic):
        count += 1
        for name, (_, dtype) in row.items():
            types.setdefault(name, dtype)
            seen[name] = seen.get(name, 0) + 1
        if len(types) > MOST_COLUMNS:
            raise InputError(f"{source.path}: {topic} has {len(types)} columns; allowed in a table: {MOST_COLUMNS}")
    order = {name: place for place, (name, _) in enumerate(messages.fields(source.topics[topic].type))}

    def place(name: str) -> int:
        return order.get(name.partition(".")[0].partition("[")[0], -1)

    fixed = {"time": _TIMES[0], "log_ns": _TIMES[1], "stamp_ns": _STAMP}
    found = [fixed[name] for name in types if name in fixed] or list(_TIMES)
    for name in sorted((name for name in types if name not in fixed), key=place):
        whole = types[name] == TEXT or seen[name] == count
        found.append(Column(name, types[name] if whole else np.dtype(np.float64)))
    return found


def export(source: BagSource, topic: str, target: Format) -> int:
    """Write the table of a topic and return the number of its rows.

    Raises:
        InputError: the messages have too many columns.
        LatheError: a message cannot be decoded.
    """
    columns = _columns(source, topic)
    table, rows, waiting = target.table(topic, columns), 0, list[Mapping[str, Cell]]()

    def write() -> None:
        table.write({column.name: _joined(column, waiting) for column in columns})
        waiting.clear()

    for row in _rows(source, topic):
        waiting.append(row)
        rows += 1
        if len(waiting) == _ROWS:
            write()
    if waiting:
        write()
    table.close()
    return rows


def _joined(column: Column, rows: list[Mapping[str, Cell]]) -> Samples:
    missing: Any = "" if column.dtype == TEXT else np.nan
    return np.array([row[column.name][0] if column.name in row else missing for row in rows], column.dtype)
