# SPDX-License-Identifier: Apache-2.0
"""Shared memory that killed processes have left behind.

Fast DDS keeps the queue at which a process listens in /dev/shm/fastrtps_portN; N follows from the ROS domain, and who
comes next uses the file again. A process that is killed while it uses the queue leaves it broken: messages to the next
one get lost, and its cell stands still before the first block. What a process sends is in its segment,
/dev/shm/fastrtps_ and 16 digits, 0.5 MB; those of the killed would fill the memory (of a container, often 64 MB). So
what nobody uses is removed before a node starts.

DDS opens a port under a semaphore of its own, PORT_mutex: who holds that can remove a port while others start.

A process that is killed while it makes a port leaves it without content, and the next that opens it waits without end
until it is made; it cannot help itself. So the harness, and nodes that wait for others, look for such ports: see
`release`.
"""

import fcntl
import os
import re
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import posix_ipc

FOLDER = Path("/dev/shm")  # noqa: S108 - where POSIX shared memory is on Linux
_PORT = re.compile(r"fast(rtps|dds)_port\d{1,5}")
_SEGMENT = re.compile(r"fast(rtps|dds)_[0-9a-f]{16}")
# Somebody opens it, listens, or leaves; or it is another user's.
_IN_USE = (posix_ipc.BusyError, BlockingIOError, FileNotFoundError, posix_ipc.PermissionsError)
_LOCKS = ("_el", "_sl")  # of a process that listens alone, and of those that listen together
# The first word of a segment, by Boost.Interprocess: 0 and 1 until it is made.
_FIRST = struct.Struct("=I")
_MADE, _CORRUPTED = 2, 3
_LONG = 1.0  # [s] to make a port: it takes a millisecond


def sweep(folder: Path = FOLDER) -> list[str]:
    """Remove the ports and segments that this user's processes have left; their names.

    A port is in use as long as one of its lock files is locked or a process has it in its memory; a segment as long as
    its lock file is, which its process locks first. Sweeps wait for one another: a port that another sweep holds would
    be taken for one at which somebody listens, and stay.
    """
    if not folder.is_dir():
        return []
    with _alone(folder):
        ours = [file for file in sorted(folder.iterdir()) if _is_ours(file)]
        ports = [file for file in ours if _PORT.fullmatch(file.name) and _remove_port(file)]
        segments = [file for file in ours if _SEGMENT.fullmatch(file.name) and _remove_segment(file)]
        return [file.name for file in (*ports, *segments)]


def release(folder: Path = FOLDER) -> list[str]:
    """Let those go on that wait for a port whose maker was killed; the names of such ports.

    The port loses its name and is marked as corrupted: whoever waits gives it up and makes another one. Should its
    maker live after all, it has a lost port: see `lathe_rc.nodes.lost_ports`.
    """
    if not folder.is_dir():
        return []
    with _alone(folder):
        files = [file for file in sorted(folder.iterdir()) if _PORT.fullmatch(file.name) and _is_ours(file)]
        return [file.name for file in files if _give_up(file)]


def _give_up(port: Path) -> bool:
    """Give up a port that has been in the making for too long; whether it has."""
    with suppress(FileNotFoundError), port.open("r+b") as stream:
        first = stream.read(_FIRST.size).ljust(_FIRST.size, b"\0")
        if _FIRST.unpack(first)[0] < _MADE and time.time() - os.fstat(stream.fileno()).st_mtime > _LONG:
            port.unlink()
            stream.seek(0)
            stream.write(_FIRST.pack(_CORRUPTED).ljust(os.sysconf("SC_PAGESIZE"), b"\0"))
            return True
    return False


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX)
        yield
    finally:
        os.close(opened)


def _is_ours(file: Path) -> bool:
    try:
        return file.stat().st_uid == os.geteuid()
    except FileNotFoundError:  # somebody else has removed it
        return False


def _remove_port(port: Path) -> bool:
    """Remove a port if nobody uses it; whether it has."""
    with ExitStack() as held:
        try:
            held.enter_context(_opened_by_nobody_else(port))
            locks = [lock for end in _LOCKS if (lock := port.with_name(port.name + end)).exists()]
            for lock in locks:
                fcntl.flock(held.enter_context(lock.open("rb")), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except _IN_USE:
            return False
        if _is_mapped(port):
            return False
        for file in [port, *locks]:
            file.unlink(missing_ok=True)  # DDS removes some, too
        return True


@contextmanager
def _opened_by_nobody_else(port: Path) -> Iterator[None]:
    """Keep DDS from opening or removing a port meanwhile; it waits up to 2 s.

    Raises:
        posix_ipc.BusyError: DDS does one of the two.
        posix_ipc.PermissionsError: the semaphore is another user's.
    """
    opening = _taken(f"{port.name}_mutex")
    try:
        yield
    finally:
        opening.release()
        opening.close()


def _taken(name: str) -> posix_ipc.Semaphore:
    """Take a semaphore that is free, or that a killed process has held: it would stay taken for ever.

    A process that is killed while DDS makes a port leaves an empty one, and the next that opens it waits without end.

    Raises:
        posix_ipc.BusyError: a living process holds it.
    """
    semaphore = posix_ipc.Semaphore(f"/{name}", posix_ipc.O_CREAT, initial_value=1)
    try:
        semaphore.acquire(timeout=0)
    except posix_ipc.BusyError:
        semaphore.close()
        if _is_mapped(FOLDER / f"sem.{name}"):
            raise
        with suppress(posix_ipc.ExistentialError):  # DDS removes some, too
            posix_ipc.unlink_semaphore(f"/{name}")
        return _taken(name)
    return semaphore


def _remove_segment(segment: Path) -> bool:
    """Remove a segment if its process has ended; whether it has. A process that still reads in it has it in memory."""
    lock = segment.with_name(segment.name + _LOCKS[0])
    try:
        with lock.open("rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            segment.unlink(missing_ok=True)
            lock.unlink(missing_ok=True)  # DDS removes both, too
    except (BlockingIOError, FileNotFoundError):  # it lives, or has just removed them
        return False
    return True


def _is_mapped(file: Path) -> bool:
    """Whether a process has a file in its memory, by its number: who makes a semaphore has it under another name."""
    try:
        number = str(file.stat().st_ino)
    except FileNotFoundError:
        return False
    for maps in Path("/proc").glob("[0-9]*/maps"):
        try:
            text = maps.read_text(encoding="utf-8", errors="replace")
        except (FileNotFoundError, ProcessLookupError, PermissionError):
            continue  # it has ended; or it is another user's, who cannot use this user's ports
        mapped = (line.split(maxsplit=5) for line in text.splitlines() if number in line)
        if any(len(parts) > 5 and parts[4] == number and parts[5].startswith(f"{file.parent}/") for parts in mapped):
            return True
    return False
