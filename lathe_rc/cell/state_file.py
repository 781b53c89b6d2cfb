# SPDX-License-Identifier: Apache-2.0
"""What a node keeps of itself in a file, so that another process can go on in its place, to the bit.

Python's pickle, with limits: parameter tables are not in it, the node that reads it has its own; nothing but the
classes of stages and arrays is made of it, by no other operations than a pickler writes. So a file from elsewhere runs
no code, and needs no more memory than its length asks for.
"""

import io
import pickle
import pickletools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lathe_rc.cell.parameters import Table
from lathe_rc.errors import LatheError
from lathe_rc.files import contents

_MOST = 2**28  # longest such file [B]
_TABLE = "table"
_OF_NUMPY = frozenset({"_reconstruct", "scalar", "ndarray", "dtype", "_frombuffer"})
_PACKAGES = ("analysis", "cell", "control", "plants", "safety", "signals")  # of this package
_OPERATIONS = """
    PROTO FRAME STOP MEMOIZE BINGET LONG_BINGET MARK BINPERSID STACK_GLOBAL REDUCE BUILD NEWOBJ NEWOBJ_EX
    NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 LONG1 BINFLOAT SHORT_BINUNICODE BINUNICODE SHORT_BINBYTES BINBYTES
    EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_LIST APPEND APPENDS EMPTY_DICT SETITEM SETITEMS EMPTY_SET ADDITEMS
    FROZENSET BYTEARRAY8
""".split()  # noqa: SIM905 - one line each would be a page
_OF_PYTHON = frozenset({("collections", "deque"), ("builtins", "set"), ("builtins", "frozenset")})


class _Writer(pickle.Pickler):
    def persistent_id(self, each: Any) -> str | None:
        return _TABLE if isinstance(each, Table) else None


class _Reader(pickle.Unpickler):
    def __init__(self, data: bytes, table: Table) -> None:
        super().__init__(io.BytesIO(data))
        self._table = table

    def persistent_load(self, name: Any) -> Table:
        if name != _TABLE:
            raise pickle.UnpicklingError(f"{name!r:.80}")
        return self._table

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _OF_PYTHON or (module.split(".", maxsplit=1)[0] == "numpy" and name in _OF_NUMPY):
            return super().find_class(module, name)
        root, _, rest = module.partition(".")
        if root == "lathe_rc" and rest.split(".")[0] in _PACKAGES:
            found = super().find_class(module, name)
            if isinstance(found, type):
                return found
        raise pickle.UnpicklingError(f"{module}.{name}")


def save(path: Path, state: Mapping[str, object]) -> None:
    """Write a state; who reads meanwhile, or after this process was killed, finds the one before or this one.

    Raises:
        LatheError: it cannot be written.
    """
    buffer = io.BytesIO()
    _Writer(buffer, pickle.HIGHEST_PROTOCOL).dump(dict(state))
    new = path.with_name(f"{path.name}.new")
    try:
        new.write_bytes(buffer.getbuffer())
        new.replace(path)
    except OSError as error:
        raise LatheError(f"{path}: the state cannot be kept ({error.strerror})") from None


def _plain(data: bytes) -> bytes:
    for operation, _, _ in pickletools.genops(data):
        if operation.name not in _OPERATIONS:
            raise pickle.UnpicklingError(operation.name)
    return data


def load(path: Path, table: Table) -> dict[str, Any]:
    """Read a state.

    Args:
        path: of the file.
        table: parameters of the node.

    Raises:
        LatheError: it cannot be read, or is none.
    """
    try:
        data = contents(path, _MOST)
        state = _Reader(_plain(data), table).load()
    except OSError as error:
        raise LatheError(f"{path}: the state cannot be read ({error.strerror})") from None
    except Exception as error:  # noqa: BLE001 - pickle lets through whatever a damaged file leads to
        raise LatheError(f"{path}: not a state of this node ({type(error).__name__}: {error!s:.200})") from None
    if not isinstance(state, dict):
        raise LatheError(f"{path}: not a state of this node")
    return state
