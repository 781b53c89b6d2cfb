# SPDX-License-Identifier: Apache-2.0
"""Bounded reads, atomic writes, and checksums for files that lathe_rc reads back.

The checksum is part of the file, so that both are written at once: it is stored at the end, or in the `ROOM` that the
writer reserves for it if other programs must still be able to read the file.
"""

import contextlib
import errno
import hashlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

from lathe_rc.errors import InputError

MOST = 2**26  #: maximum length of a file that is read at once [B]
_PIECE = 2**20  # [B]
_NO_FILE = "not a file"
_MARK, _DIGITS = b"lathe_rc checksum ", 32
ROOM = _MARK + _DIGITS * b"0"  #: placeholder of a checksum


class DamagedError(ValueError):
    """Mismatch between the content of a file and its checksum."""


def contents(path: Path, most: int = MOST) -> bytes:
    """Return the content of a file; pipes and system files, which can block a reader forever, are rejected.

    Raises:
        OSError: the file cannot be read, or it is longer than ``most`` bytes (EFBIG).
    """
    found = bytearray()
    with open(path, "rb", opener=open_file) as stream:
        # Python allocates memory for the maximum length of a single read.
        while piece := stream.read(min(_PIECE, most + 1 - len(found))):
            found += piece
    if piece is None:  # the read would block
        raise OSError(errno.EINVAL, _NO_FILE)
    if len(found) > most:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
    return bytes(found)


def open_file(name: str, flags: int) -> int:
    """Open regular files only (``opener`` for `open`): opening a pipe or a device could block forever."""
    number = os.open(name, flags | getattr(os, "O_NONBLOCK", 0))  # Windows lacks it
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise OSError(errno.EINVAL, _NO_FILE)
    return number


def sealed(content: bytes) -> bytes:
    """Return the content of a file with its checksum in the last `ROOM`, or at the end if no room is reserved."""
    place = content.rfind(ROOM)
    head, tail = (content, b"") if place < 0 else (content[:place], content[place + len(ROOM) :])
    return head + _MARK + _checksum(head, tail) + tail


def unsealed(content: bytes, *, needed: bool = True) -> memoryview:
    """Return the content of a file written with `sealed`, up to its checksum.

    Args:
        content: the bytes of the file.
        needed: whether a checksum is required; files of older versions have none.

    Raises:
        DamagedError: the content does not match the checksum, or a required checksum is missing.
    """
    view, place = memoryview(content), content.rfind(_MARK)
    if place < 0 and not needed:
        return view
    if place < 0:
        raise DamagedError("it has no checksum")
    if content[place + len(_MARK) : place + len(ROOM)] != _checksum(view[:place], view[place + len(ROOM) :]):
        raise DamagedError("its checksum is that of another content")
    return view[:place]


def _checksum(head: bytes | memoryview, tail: bytes | memoryview) -> bytes:
    found = hashlib.sha256(head)
    found.update(tail)
    return found.hexdigest()[:_DIGITS].encode()


def check_place(option: str, path: Path) -> None:
    """Check that a file can be written at a path, before any computation.

    Raises:
        InputError: the path is a folder, or its parent folder does not exist; the message names ``option``.
    """
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise InputError(f"{option} {path}: {'is a folder' if path.is_dir() else 'no such folder'}; name a file")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Write a file atomically: yield a temporary file in the same folder, which replaces ``path`` after the block.

    The temporary file is flushed to disk and then renamed. After an error, the old file is unchanged and the temporary
    file is removed.

    Raises:
        OSError: the file cannot be written.
    """
    beside = None
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            beside = Path(file.name)
            beside.chmod(0o666 & ~_umask())
            yield cast("BinaryIO", file)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
        beside = None
        if hasattr(os, "O_DIRECTORY"):  # Windows cannot open a folder
            folder = os.open(path.parent, os.O_DIRECTORY)
            try:
                os.fsync(folder)  # makes the rename durable
            finally:
                os.close(folder)
    finally:
        if beside:
            beside.unlink(missing_ok=True)


@contextlib.contextmanager
def written(path: Path) -> Iterator[BinaryIO]:
    """Write a file that a user names atomically, as `replacing` does.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        with replacing(path) as file:
            yield file
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place") from None


def write(path: Path, text: str) -> None:
    """Write a text file atomically; see `written`."""
    with written(path) as file:
        file.write(text.encode())


def _umask() -> int:
    """Return the umask of this process, needed to give a temporary file the permissions of an ordinary file."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
