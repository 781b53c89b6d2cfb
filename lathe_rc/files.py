# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast


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
