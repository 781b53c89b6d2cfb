# SPDX-License-Identifier: Apache-2.0
"""Bounded reads, writes that are whole or not at all, and checksums of files that lathe_rc reads again.

A checksum stands inside its file, so that both are written at once: at the end, or where the writer of a format has
left `ROOM` for it, in a text that other programs read as any other.
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

MOST = 2**26  #: longest file that is read whole [B]
_PIECE = 2**20  # [B]
_NO_FILE = "not a file"
_MARK, _DIGITS = b"lathe_rc checksum ", 32
ROOM = _MARK + _DIGITS * b"0"  #: for a checksum


class DamagedError(ValueError):
    """A file has another content than the one that its checksum was made of."""


def contents(path: Path, most: int = MOST) -> bytes:
    """The content of a file. Pipes and system files, at which a reader could wait for ever, are refused.

    Raises:
        OSError: it cannot be read; EFBIG: it is longer than ``most`` bytes.
    """
    found = bytearray()
    with open(path, "rb", opener=open_file) as stream:
        # Python takes memory for all that a single read may give.
        while piece := stream.read(min(_PIECE, most + 1 - len(found))):
            found += piece
    if piece is None:  # it would have had to wait
        raise OSError(errno.EINVAL, _NO_FILE)
    if len(found) > most:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
    return bytes(found)


def open_file(name: str, flags: int) -> int:
    """An opener, for `open`, of files alone: a pipe or a device could keep a reader for ever."""
    number = os.open(name, flags | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise OSError(errno.EINVAL, _NO_FILE)
    return number


def sealed(content: bytes) -> bytes:
    """The content of a file with its checksum in the last `ROOM`; without one, at the end."""
    place = content.rfind(ROOM)
    head, tail = (content, b"") if place < 0 else (content[:place], content[place + len(ROOM) :])
    return head + _MARK + _checksum(head, tail) + tail


def unsealed(content: bytes, *, needed: bool = True) -> memoryview:
    """The content of a file that `sealed` has made, up to its checksum.

    Args:
        content: see above.
        needed: whether it must have a checksum: files of older versions have none.

    Raises:
        DamagedError: it is not as it was written, or there is no checksum.
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
    """Refuse a place where no file can be written, before anything is computed.

    Raises:
        InputError: it is a folder, or in a folder that does not exist; ``option`` names it.
    """
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise InputError(f"{option} {path}: {'is a folder' if path.is_dir() else 'no such folder'}; name a file")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file beside ``path`` that takes its place when the block ends: on the disk, then renamed.

    Whatever happens before leaves the old file as it was, and nothing beside it.

    Raises:
        OSError: it cannot be written.
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
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # the new name itself
        finally:
            os.close(folder)
    finally:
        if beside:
            beside.unlink(missing_ok=True)


def _umask() -> int:
    """The permissions that new files of this process do not have; temporary files have none for others."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
