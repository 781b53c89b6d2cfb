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

_LISTENS = re.compile(rf"{FOLDER}/(fast(?:rtps|dds)_port(\d+))_[es]l(?: \(deleted\))?")
_OWN = Path("/proc/self")


class _Head(NamedTuple):
    """Numbers of 32 bits that follow each other in the memory of a port (PortNode of SharedMemGlobal.hpp)."""

    number: int
    listeners: int
    healthy_check_timeout_ms: int
    wait_timeout_ms: int
    capacity: int
    waiting: int
    marks: int  # 1: sound; 2: one process listens alone; 4: somebody listens

    @property
    def plausible(self) -> bool:
        """Whether this can be the head of a port."""
        return self.wait_timeout_ms == self.healthy_check_timeout_ms // 3 and self.marks < 8

    @property
    def listens(self) -> bool:
        """Whether somebody listens there and takes it for sound."""
        return self.listeners > 0 and self.marks & _LISTENED == _LISTENED


_HEAD = struct.Struct("=7I")
_SOUND, _LISTENED = 1, 5
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
            LatheError: the memory of a lost port is not laid out as that of Fast DDS 2.14.
        """
        try:
            for name in self._files:
                if not self._is_lost(name):
                    self._since.pop(name, None)
                elif now - self._since.setdefault(name, now) >= _PATIENCE:
                    del self._since[name]
                    if _mark(name):
                        self._warn(f"no other process finds {name} any more; DDS makes it anew")
        except OSError as error:
            self._warn(f"this process cannot see whether others still find it: {error}")
            self._files = {}

    def _is_lost(self, name: str) -> bool:
        file = _file(name)
        if file == self._files[name]:
            return False
        heads = [*_heads(name)]
        where = {number for number, _, head in heads if head.listens} or {number for number, _, _ in _mapped(name)}
        if file in where:
            self._files[name] = file
        return file not in where


def _file(name: str) -> int:
    """The number of the file of a port; -1 if there is none."""
    try:
        return (FOLDER / name).stat().st_ino
    except FileNotFoundError:
        return -1


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


def _heads(name: str) -> Iterator[tuple[int, int, _Head]]:
    """The heads of a port in this process's memory: number of the file, address and content."""
    wanted = struct.pack("=I", int(name.partition("port")[2]))
    # as a file: memory that DDS gives back meanwhile is an error then, no crash
    with (_OWN / "mem").open("rb", buffering=0) as memory:
        for number, first, end in _mapped(name):
            content = b""
            with suppress(OSError):  # DDS has given it back
                memory.seek(first)
                content = memory.read(end - first)
            place = content.find(wanted)
            while 0 <= place <= len(content) - _HEAD.size:
                head = _Head(*_HEAD.unpack_from(content, place))
                if head.plausible:
                    yield number, first + place, head
                    break
                place = content.find(wanted, place + 1)


def _mark(name: str) -> bool:
    """Mark a port as broken wherever this process listens to another file than that of its name; whether it did."""
    heads, file = [*_heads(name)], _file(name)
    if not heads:
        raise LatheError(f"{FOLDER}/{name} has no file any more, and is not laid out as Fast DDS 2.14 does it")
    lost = [(address, head) for number, address, head in heads if head.listens and number != file]
    with (_OWN / "mem").open("r+b", buffering=0) as memory:
        for address, head in lost:
            with suppress(OSError):  # DDS has given it back
                memory.seek(address + _HEAD.size - 4)
                memory.write(struct.pack("=I", head.marks & ~_SOUND))
    return bool(lost)
