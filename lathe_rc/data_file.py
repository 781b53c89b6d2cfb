# SPDX-License-Identifier: Apache-2.0
"""Files of plain data: JSON and the bytes of its arrays, compressed, between a first line and a checksum.

They contain no code. The compressed content begins with a line that gives the length of the JSON text.
"""

import errno
import json
import math
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lathe_rc.errors import InputError, shown
from lathe_rc.files import DamagedError, contents, sealed, unsealed

MOST = 2**28  #: largest file, and largest content [B]
_DTYPE, _SHAPE = "dtype", "shape"
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
    arrays = _Arrays()
    text = json.dumps(told, default=arrays.encoded).encode()
    return sealed(_head(kind) + zlib.compress(b"".join([b"%d\n" % len(text), text, *arrays.written]), level))


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
        content = _unpacked(contents(path, most), _head(kind), most)
        start = content.index(b"\n") + 1
        end = start + int(content[:start])
        arrays = _Arrays(content[end:])
        return make(json.loads(content[start:end], object_hook=arrays.decoded))
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


class _Arrays:
    """Arrays of a file, whose bytes follow its text in their order."""

    def __init__(self, data: bytes = b"") -> None:
        self._data = memoryview(data)
        self.written: list[bytes] = []

    def encoded(self, part: object) -> object:
        """Return what stands for an array or a number of NumPy in the text."""
        if isinstance(part, np.ndarray):
            self.written.append(part.tobytes())
            return {_DTYPE: part.dtype.str, _SHAPE: part.shape}
        if isinstance(part, np.generic):
            return part.item()
        raise TypeError(f"a {type(part).__name__} in a file of plain data")

    def decoded(self, part: dict[str, Any]) -> object:
        """Return the next array for what stands for it in the text."""
        if part.keys() != {_DTYPE, _SHAPE}:
            return part
        dtype = np.dtype(str(part[_DTYPE]))
        if dtype.kind not in _NUMBERS:
            raise ValueError(f"elements {part[_DTYPE]!r:.80}")
        size = dtype.itemsize * math.prod(part[_SHAPE])
        found, self._data = self._data[:size], self._data[size:]
        return np.frombuffer(found, dtype).reshape(part[_SHAPE]).copy()


def _unpacked(content: bytes, head: bytes, most: int) -> bytes:
    if not content.startswith(head):
        raise ValueError("it begins differently")
    unpacking = zlib.decompressobj()
    found = unpacking.decompress(bytes(unsealed(content))[len(head) :], most)
    if not unpacking.eof:
        raise ValueError("incomplete, or larger than allowed")
    return found
