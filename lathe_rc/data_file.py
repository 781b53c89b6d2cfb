# SPDX-License-Identifier: Apache-2.0
"""Files of plain data: JSON with arrays, compressed, between a first line and a checksum. They contain no code."""

import base64
import errno
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lathe_rc.errors import InputError, shown
from lathe_rc.files import DamagedError, contents, sealed, unsealed

MOST = 2**28  #: largest file, and largest content [B]
_NUMBERS = "biuf"  # allowed kinds of array elements

T = TypeVar("T")


def packed(kind: str, told: object, level: int = 1) -> bytes:
    """Return the bytes of a file.

    Args:
        kind: name of its kind, such as ``checkpoint``.
        told: lists, dictionaries with texts as keys, texts, numbers and arrays.
        level: of the compression; 0: none.

    Raises:
        TypeError: ``told`` contains something else.
    """
    return sealed(_head(kind) + zlib.compress(json.dumps(told, default=_encoded).encode(), level))


def read(path: Path, kind: str, make: Callable[[Any], T], most: int = MOST) -> T:
    """Read a file written by `packed` and return what ``make`` makes of its content.

    Args:
        path: path of the file.
        kind: name of its kind.
        make: function of the content; ValueError, TypeError, LookupError and AttributeError mean another content.
        most: largest length of the file, and of its content [B].

    Raises:
        InputError: the file cannot be read, is damaged, or is of another kind.
    """
    try:
        return make(json.loads(_unpacked(contents(path, most), _head(kind), most), object_hook=_decoded))
    except InputError:
        raise
    except OSError as error:
        reason = f"larger than any {kind} here, {most} B" if error.errno == errno.EFBIG else error.strerror
        raise InputError(f"{path}: the {kind} cannot be read ({reason}); name a file that was written") from None
    except DamagedError as error:
        raise InputError(f"{path}: damaged ({error}); make it anew") from None
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, zlib.error) as error:
        raise InputError(f"{path}: not a {kind} ({shown(error)}); make it anew") from None


def _head(kind: str) -> bytes:
    return f"lathe_rc {kind} 1\n".encode()


def _encoded(part: object) -> object:
    if isinstance(part, np.ndarray):
        return {"dtype": part.dtype.str, "shape": part.shape, "data": base64.b64encode(part.tobytes()).decode()}
    if isinstance(part, np.generic):
        return part.item()
    raise TypeError(f"a {type(part).__name__} in a file of plain data")


def _decoded(part: dict[str, Any]) -> object:
    if part.keys() != {"dtype", "shape", "data"}:
        return part
    dtype = np.dtype(str(part["dtype"]))
    if dtype.kind not in _NUMBERS:
        raise ValueError(f"elements {part['dtype']!r:.80}")
    return np.frombuffer(base64.b64decode(part["data"]), dtype).reshape(part["shape"]).copy()


def _unpacked(content: bytes, head: bytes, most: int) -> bytes:
    if not content.startswith(head):
        raise ValueError("it begins differently")
    unpacking = zlib.decompressobj()
    found = unpacking.decompress(bytes(unsealed(content))[len(head) :], most)
    if not unpacking.eof:
        raise ValueError("incomplete, or larger than allowed")
    return found
