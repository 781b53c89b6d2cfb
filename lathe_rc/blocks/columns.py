# SPDX-License-Identifier: Apache-2.0
"""Signal topics as tables: columns with units, and one row per sample or message."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, cast

import numpy as np
from rosbags.interfaces import Nodetype

from lathe_rc import messages
from lathe_rc.blocks.ports import Sparse
from lathe_rc.errors import InputError
from lathe_rc.messages import NOT_SIGNALS, START_NS, Samples, Signals

TEXT = np.dtype(object)  #: element type of strings
MOST_COLUMNS = 1024  #: columns of a table
_OCTET = {"octet": "uint8", "char": "uint8", "byte": "uint8"}
_FIELD = re.compile(r"\S+\s+(\w+)\s*#(.*)")
_UNIT = re.compile(r"\[([^\[\]]+)\]")


@dataclass(frozen=True)
class Column:
    """Column of a topic's table.

    Attributes:
        name: name of the message's field; ``sample`` and ``time`` come first in every table.
        dtype: type of the elements; `TEXT` for strings.
        unit: unit; empty if the message definition has none.
    """

    name: str
    dtype: np.dtype[Any]
    unit: str = ""

    @property
    def label(self) -> str:
        """Name with unit, as in ``angle [rad]``."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


_FIRST = (Column("sample", np.dtype(np.int64)), Column("time", np.dtype(np.float64), "s"))


@cache
def units(msgtype: str) -> Mapping[str, str]:
    """Return the units by field, from the comments in the type's .msg file; ``m or N`` if it depends on the sender.

    For types of other packages, units are not available.
    """
    package, _, name = msgtype.partition("/msg/")
    if package != messages.PACKAGE:
        return {}
    text = (files("lathe_rc") / "msg_defs" / "msg" / f"{name}.msg").read_text(encoding="utf-8")
    found = (_FIELD.fullmatch(line.strip()) for line in text.splitlines())
    return {field[1]: " or ".join(dict.fromkeys(_UNIT.findall(field[2]))) for field in found if field}


@cache
def columns(msgtype: str) -> tuple[Column, ...]:
    """Return the table columns of signal topics of a message type."""
    known = units(msgtype)
    if msgtype in messages.block_types():
        fields = messages.sample_fields(msgtype)
    else:
        # The index has a column of its own, `sample`.
        left_out = {*NOT_SIGNALS, "sample_index"}
        given = messages.fields(msgtype)
        fields = {name: _element(kind, detail) for name, (kind, detail) in given if name not in left_out}
    return (*_FIRST, *(Column(name, dtype, known.get(name, "")) for name, dtype in fields.items()))


def _element(kind: Nodetype, detail: Any) -> np.dtype[Any]:
    """Return the element type of a field that is a number, a string, or a list of them."""
    base = detail if kind == Nodetype.BASE else cast("Any", detail)[0][1]
    return TEXT if base[0] == "string" else np.dtype(base[0])


def flattened(message: Any) -> Iterator[tuple[str, Any, np.dtype[Any]]]:
    """Yield name, value and type of each number and string in a message of any type, such as ``position[0]``.

    Raises:
        InputError: a list has more elements than a table may have columns.
    """
    return _parts(Nodetype.NAME, message.__msgtype__, "", message)


def _parts(kind: Nodetype, detail: Any, name: str, value: Any) -> Iterator[tuple[str, Any, np.dtype[Any]]]:
    if kind == Nodetype.BASE:
        yield name, value, TEXT if "string" in detail[0] else np.dtype(_OCTET.get(detail[0], detail[0]))
    elif kind == Nodetype.NAME:
        for part, (inner, about) in messages.fields(detail):
            yield from _parts(inner, about, f"{name}.{part}" if name else part, getattr(value, part))
    elif len(value) > MOST_COLUMNS:
        raise InputError(f"{name} has {len(value)} elements; allowed in a table: {MOST_COLUMNS} columns")
    else:
        for place, each in enumerate(value):
            yield from _parts(detail[0][0], detail[0][1], f"{name}[{place}]", each)


def dense_rows(first: int, signals: Signals, step_ns: int) -> dict[str, Samples]:
    """Return the columns of consecutive samples starting at ``first``, shape (samples,)."""
    sample = np.arange(first, first + next(iter(signals.values())).size)
    return {"sample": sample, "time": _seconds(sample, step_ns), **signals}


def sparse_rows(table: Sequence[Column], found: Sequence[Sparse], step_ns: int) -> dict[str, Samples]:
    """Return the columns of messages at individual samples; a message with lists has one row per element."""
    cells: dict[str, list[Any]] = {column.name: [] for column in table}
    for message in found:
        parts = {column.name: message.values[column.name] for column in table[len(_FIRST) :]}
        lists = {name: list(part) for name, part in parts.items() if isinstance(part, (list, np.ndarray))}
        rows = max([1, *map(len, lists.values())])
        cells["sample"] += [message.index] * rows
        for column in table[len(_FIRST) :]:
            missing: Any = "" if column.dtype == TEXT else np.nan
            given = lists.get(column.name)
            padded = [parts[column.name]] * rows if given is None else given + [missing] * (rows - len(given))
            cells[column.name] += padded
    sample = np.array(cells["sample"], dtype=np.int64)
    rest = {column.name: np.array(cells[column.name], column.dtype) for column in table[len(_FIRST) :]}
    return {"sample": sample, "time": _seconds(sample, step_ns), **rest}


def _seconds(sample: Samples, step_ns: int) -> Samples:
    seconds: Samples = (START_NS + sample * step_ns) / 1e9
    return seconds
