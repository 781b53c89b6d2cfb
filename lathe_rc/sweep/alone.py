# SPDX-License-Identifier: Apache-2.0
"""Computation of cells in a process of their own, of which a cell may end, block or exhaust only itself.

Workers compute cells in their own process, which is faster. If a worker ends, its cells are computed here, one after
the other, and a cell with which this process ends as well is a failed row. The program is started by `alone`.
"""

import faulthandler
import pickle
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any, TypeVar

from lathe_rc import allowed_code

T = TypeVar("T")

FIRST = 30.0  #: time beyond its limit for the first cell of a process, which loads compiled code [s]
_FRAME = re.compile(r'File "(.+)", line (\d+) in')
KILLED = signal.SIGKILL.name  #: part of the reason of a cell whose process was killed, for example for lack of memory
NO_END = "no end within "  #: beginning of the reason of a cell that has reached its time limit
_TIMEOUT = "Timeout ("  # beginning of the output of Python's fault handler


class Watchdog:
    """Time limit of a process's cells: ends the process, even if the cell blocks the interpreter.

    Args:
        limit: time limit of a cell [s].
        stream: file for the stacks of the process's threads.
        first: time beyond the limit for the first cell of the process [s].
    """

    _has_run = False  # whether this process has completed a cell

    def __init__(self, limit: float, stream: IO[Any], first: float = FIRST) -> None:
        self._limit, self._stream, self._first, self._set = limit, stream, first, -limit

    def begin(self) -> None:
        """Begin a cell."""
        now = time.monotonic()
        if now > self._set + self._limit / 10.0:  # setting it takes 0.1 ms
            longest = 1.1 * self._limit + (0.0 if Watchdog._has_run else self._first)
            faulthandler.dump_traceback_later(longest, exit=True, file=self._stream)
            self._set = now

    def end(self) -> None:
        """End the last cell."""
        Watchdog._has_run = True
        faulthandler.cancel_dump_traceback_later()


def limit_memory(size: int) -> None:
    """Limit the memory of this process [B]: an allocation beyond it is an error of the cell, not the process's end."""
    resource.setrlimit(resource.RLIMIT_DATA, (size, resource.getrlimit(resource.RLIMIT_DATA)[1]))


def alone(
    work: Callable[[T], Any], jobs: Sequence[T], limit: float, memory: int | None, first: float = FIRST
) -> Iterator[Any]:
    """Yield the results of jobs in their order; for a job whose process ends, the reason as a `str`.

    Args:
        work: function of a job, which can be pickled.
        jobs: arguments of the function.
        limit: time limit of a job [s].
        memory: memory limit of the process [B]; None: no limit.
        first: time beyond the limit for the first job of a process [s].
    """
    left = list(jobs)
    while left:
        with _process(pickle.dumps((work, left, limit, memory, first))) as (results, process, stream):
            try:
                while left:
                    yield results.recv()
                    del left[0]
            except (EOFError, ConnectionError):
                process.wait()
                stream.seek(0)
                yield _reason(process.returncode, stream.read().decode(errors="replace"), limit)
                del left[0]


@contextmanager
def _process(task: bytes) -> Iterator[tuple[Connection, subprocess.Popen[bytes], IO[bytes]]]:
    ours, theirs = Pipe()
    with tempfile.TemporaryFile() as stream:
        command = [*allowed_code.interpreter(__name__), *allowed_code.arguments(), str(theirs.fileno())]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream, pass_fds=[theirs.fileno()]
        )
        theirs.close()
        try:
            ours.send_bytes(task)
            yield ours, process, stream
        finally:
            ours.close()
            process.kill()
            process.wait()


def _reason(code: int, said: str, limit: float) -> str:
    """Return the reason of a process's end, from its exit code and its output."""
    if _TIMEOUT in said:
        frame = _FRAME.search(said.rpartition("most recent call first")[2])  # of the main thread, which comes last
        place = f", in {Path(frame[1]).name}, line {frame[2]}" if frame else ""
        return f"{NO_END}{limit:g} s{place}"
    if code < 0:
        perhaps = ", perhaps for lack of memory" if code == -signal.SIGKILL else ""
        return f"its process was ended by {signal.Signals(-code).name}{perhaps}"
    return f"its process ended with exit code {code}"


def main() -> None:
    """Compute the jobs that the starting process sends, and send the results back."""
    words = allowed_code.taken_from(sys.argv[1:])
    connection = Connection(int(words[0]))
    work, jobs, limit, memory, first = pickle.loads(connection.recv_bytes())  # noqa: S301 - from the process that started this one
    if memory is not None:
        limit_memory(memory)
    watchdog = Watchdog(limit, sys.stderr, first)
    for job in jobs:
        watchdog.begin()
        found = work(job)
        watchdog.end()
        connection.send(found)


if __name__ == "__main__":
    main()
