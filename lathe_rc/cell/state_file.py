# SPDX-License-Identifier: Apache-2.0
"""State files of nodes, from which another process can replace a node with bit-identical results.

The format is a restricted form of Python's pickle. Arrays are written as type, shape and bytes; parameter tables are
not written, since the reading node has its own. Only classes that occur in a fresh state of the node are allowed. A
file that another user owns or can write is rejected, since its content is trusted.
"""

import enum
import io
import os
import pickle
import stat
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lathe_rc.cell.parameters import Table
from lathe_rc.errors import LatheError, shown
from lathe_rc.files import contents, sealed, unsealed

_MOST = 2**28  # largest state file [B]
_TABLE, _ARRAY, _NUMBER, _KIND, _ENUM = "table", "array", "number", "kind", "enum"
_NUMBERS = "biuf"  # allowed kinds of array elements
_Name = tuple[str, str]


class _Writer(pickle.Pickler):
    def __init__(self, buffer: io.BytesIO) -> None:
        super().__init__(buffer, pickle.HIGHEST_PROTOCOL)
        self._arrays: dict[int, int] = {}

    def persistent_id(self, each: Any) -> object:
        if isinstance(each, Table):
            return _TABLE
        if isinstance(each, np.ndarray):
            known = id(each) in self._arrays
            number = self._arrays.setdefault(id(each), len(self._arrays))
            return (_ARRAY, number) if known else (_ARRAY, number, each.dtype.str, each.shape, each.tobytes())
        if isinstance(each, np.generic):
            return _NUMBER, each.dtype.str, each.tobytes()
        if isinstance(each, np.dtype):
            return _KIND, each.str
        if isinstance(each, enum.Enum):
            return _ENUM, type(each).__module__, type(each).__qualname__, each.value
        return None


def _dtype(text: object) -> np.dtype[Any]:
    found = np.dtype(str(text))
    if found.kind not in _NUMBERS:
        raise pickle.UnpicklingError(f"elements {text!r:.80}")
    return found


class _Reader(pickle.Unpickler):
    """Restricted unpickler for state files: it allows only the given classes or, if None, records all classes."""

    def __init__(self, stream: io.BytesIO, table: Table, classes: frozenset[_Name] | None) -> None:
        super().__init__(stream)
        self._table, self._classes = table, classes
        self._arrays: dict[int, np.ndarray] = {}
        self.met: set[_Name] = set()

    def persistent_load(self, told: Any) -> Any:
        if told == _TABLE:
            return self._table
        kind, *rest = told
        if kind == _ARRAY and len(rest) == 1:
            return self._arrays[rest[0]]
        if kind == _ARRAY:
            number, dtype, shape, data = rest
            self._arrays[number] = np.frombuffer(data, _dtype(dtype)).reshape(shape).copy()
            return self._arrays[number]
        if kind == _NUMBER:
            (number,) = np.frombuffer(rest[1], _dtype(rest[0]))
            return number
        if kind == _KIND:
            return _dtype(rest[0])
        if kind == _ENUM:
            found = self.find_class(*rest[:2])
            if issubclass(found, enum.Enum):
                return found(rest[2])
        raise pickle.UnpicklingError(f"{kind!r:.80}")

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "deque"):
            return deque
        if self._classes is None or (module, name) in self._classes:
            self.met.add((module, name))
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name}"[:160])


def dump(state: Mapping[str, object]) -> bytes:
    """Return the content of a state file."""
    buffer = io.BytesIO()
    _Writer(buffer).dump(dict(state))
    return buffer.getvalue()


def save(path: Path, *parts: bytes) -> None:
    """Write a state and later changes to it, each part as returned by `dump`.

    The file is replaced atomically: a reader sees either the previous or the new state, even if this process is killed.

    Raises:
        LatheError: the file cannot be written.
    """
    new = path.with_name(f"{path.name}.new")
    try:
        new.unlink(missing_ok=True)
        with open(new, "xb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            file.write(sealed(b"".join(parts)))
        new.replace(path)
    except OSError as error:
        raise LatheError(f"{path}: the state cannot be kept ({error.strerror})") from None


def _check_owner(path: Path) -> None:
    about = path.stat()
    if about.st_uid != os.getuid() or about.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise LatheError(f"{path}: another user owns or may write this state; allowed: your own file, mode 600")


def load(path: Path, table: Table, fresh: Mapping[str, object], *others: type) -> dict[str, Any]:
    """Read the state of a node from a file.

    Args:
        path: path of the file.
        table: parameters of the node.
        fresh: fresh state of the same node, whose classes are allowed in the file.
        others: further allowed classes.

    Raises:
        LatheError: the file cannot be read, is writable by another user, or is not a state file.
    """
    own = _Reader(io.BytesIO(dump(fresh)), table, None)
    own.load()
    classes = own.met | {(each.__module__, each.__qualname__) for each in others}
    try:
        _check_owner(path)
        stream, state = io.BytesIO(unsealed(contents(path, _MOST))), dict[str, Any]()
        # Each part needs its own reader, since references in a part do not extend to other parts.
        while stream.tell() < stream.getbuffer().nbytes:
            state |= _Reader(stream, table, frozenset(classes)).load()
    except LatheError:
        raise
    except OSError as error:
        raise LatheError(f"{path}: the state cannot be read ({error.strerror})") from None
    except Exception as error:  # noqa: BLE001 - pickle can raise any exception on a damaged file
        raise LatheError(f"{path}: not a state of this node ({type(error).__name__}: {shown(error)})") from None
    if state.keys() != fresh.keys():
        raise LatheError(f"{path}: not a state of this node")
    return state
