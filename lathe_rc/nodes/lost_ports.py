# SPDX-License-Identifier: Apache-2.0
"""Queues in shared memory at which this process listens, and that the others do not find any more.

A process finds the queue of another, its port, by the name of a file, /dev/shm/fastrtps_portN. When a process dies
while it holds a lock of a port, those that send there, and the one that listens, all see that it is broken, and each
makes it anew. Now and then one of them removes the file of the port that the listener has just made: it listens at a
queue without a name, and hears nothing more.

DDS marks a broken port in its memory. The listener looks at the mark three times a second, and makes the port anew. So
a process whose port has been without a name for half a second sets that mark itself.
"""

import re
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from lathe_rc.errors import LatheError
from lathe_rc.nodes.stale_shared_memory import FOLDER

_LISTENS = re.compile(rf"{FOLDER}/(fast(?:rtps|dds)_port(\d+))_[es]l")
_OWN = Path("/proc/self")


class _Head(NamedTuple):
    """Numbers of 32 bits that follow each other in the memory of a port (PortNode of SharedMemGlobal.hpp)."""

    number: int
    listeners: int
    healthy_check_timeout_ms: int
    wait_timeout_ms: int
    capacity: int
    waiting: int
    marks: int  # 1: not broken; 2: one process listens alone; 4: somebody listens

    @property
    def plausible(self) -> bool:
        """Whether this is the head of a port at which somebody listens."""
        return self.listeners > 0 and self.wait_timeout_ms == self.healthy_check_timeout_ms // 3 and 4 <= self.marks < 8


_HEAD = struct.Struct("=7I")
_NOT_BROKEN = 1
_PATIENCE = 0.5  # [s]: DDS may be making the port anew just now


class LostPorts:
    """The ports at which this process listens, once it has all its nodes.

    Args:
        warn: takes a line for each port that is made anew.
    """

    def __init__(self, warn: Callable[[str], object]) -> None:
        self._warn = warn
        self._files = dict.fromkeys(sorted(_listened()), 0)  # the file of each that was last seen in this memory
        self._since: dict[str, float] = {}  # when each of those that are lost was first missed

    def look(self, now: float) -> None:
        """Let DDS make those ports anew that have lost their name, and say so; to be called some ten times a second.

        Args:
            now: monotonic time [s].

        Raises:
            LatheError: the memory of a port is not laid out as that of Fast DDS 2.14.
        """
        for name in self._files:
            if not self._is_lost(name):
                self._since.pop(name, None)
            elif now - self._since.setdefault(name, now) >= _PATIENCE:
                del self._since[name]
                if _mark(name):
                    self._warn(f"no other process finds {name} any more; DDS makes it anew")

    def _is_lost(self, name: str) -> bool:
        try:
            file = (FOLDER / name).stat().st_ino
        except FileNotFoundError:
            file = 0
        if file and file == self._files[name]:
            return False
        if file in (number for number, _, _ in _mapped(name)):
            self._files[name] = file
            return False
        return True


def _listened() -> set[str]:
    found = set()
    for link in (_OWN / "fd").iterdir():
        with suppress(FileNotFoundError):  # it was opened to list them
            if match := _LISTENS.fullmatch(str(link.readlink())):
                found.add(match[1])
    return found


def _mapped(name: str) -> Iterator[tuple[int, int, int]]:
    """Where this process has a port in its memory: number of the file, first address and end."""
    for line in (_OWN / "maps").read_text(encoding="utf-8", errors="replace").splitlines():
        addresses, _, _, _, number, *path = line.split(maxsplit=5)
        if path and path[0].removesuffix(" (deleted)") == f"{FOLDER}/{name}":
            first, end = addresses.split("-")
            yield int(number), int(first, 16), int(end, 16)


def _mark(name: str) -> bool:
    """Mark a port as broken, in all memory that this process has of it; whether it was not yet."""
    number, marked = int(name.partition("port")[2]), False
    # as a file: memory that DDS gives back meanwhile is an error then, no crash
    with (_OWN / "mem").open("r+b", buffering=0) as memory:
        for _, first, end in _mapped(name):
            memory.seek(first)
            content = memory.read(end - first)
            place = content.find(struct.pack("=I", number))
            while 0 <= place <= len(content) - _HEAD.size:
                head = _Head(*_HEAD.unpack_from(content, place))
                if head.plausible:
                    break
                place = content.find(struct.pack("=I", number), place + 1)
            else:
                raise LatheError(f"{FOLDER}/{name} has no file any more, and is not laid out as Fast DDS 2.14 does it")
            if head.marks & _NOT_BROKEN:
                memory.seek(first + place + _HEAD.size - 4)
                memory.write(struct.pack("=I", head.marks & ~_NOT_BROKEN))
                marked = True
    return marked
