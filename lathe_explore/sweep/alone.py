# SPDX-License-Identifier: Apache-2.0
"""Computation of cells in a process of their own, of which a cell may end, block or exhaust only itself.

Workers compute cells in their own process, which is faster. If a worker ends, its cells are computed here, one after
the other, and a cell with which this process ends as well is a failed row. `alone` starts the program and keeps its
time limit, which a cell therefore cannot remove.
"""

import faulthandler
import math
import pickle
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any, TypeVar

from lathe_rc import allowed_code

T = TypeVar("T")

FIRST = 30.0  #: time beyond its limit for the first cell of a process, which loads compiled code [s]
_END = 5.0  # time that a process has to write its stack and to end [s]
_FRAME = re.compile(r'File "(.+)", line (\d+) in')  # of Python's fault handler
KILLED = "SIGKILL"  #: part of the reason of a cell whose process was killed, for example for lack of memory
NO_END = "no end within "  #: beginning of the reason of a cell that has reached its time limit


class Watchdog:
    """Time limit of the cells of a worker: ends this process, even if the cell blocks the interpreter.

    Args:
        limit: time limit of a cell [s].
        stream: file for the stacks of the process's threads.
    """

    _has_run = False  # whether this process has completed a cell

    def __init__(self, limit: float, stream: IO[Any]) -> None:
        self._limit, self._stream, self._set = limit, stream, -math.inf

    def begin(self) -> None:
        """Begin a cell."""
        now = time.monotonic()
        if now > self._set + self._limit / 10.0:  # setting it takes 0.1 ms
            longest = 1.1 * self._limit + (0.0 if Watchdog._has_run else FIRST)
            faulthandler.dump_traceback_later(longest, exit=True, file=self._stream)
            self._set = now

    def end(self) -> None:
        """End the last cell."""
        Watchdog._has_run = True
        faulthandler.cancel_dump_traceback_later()
        self._set = -math.inf  # the next cell sets the limit again, however soon it begins


def limit_memory(size: int) -> None:
    """Limit the memory of this process [B]: an allocation beyond it is an error of the cell, not the process's end."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows, where only Dask's limit of a worker's memory holds
        return
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
        with _process(pickle.dumps((work, left, memory))) as (results, process, stream):
            late, longest = False, limit + first
            with suppress(EOFError, ConnectionError):  # the process has ended
                results.recv()  # it has started
                while left and not (late := not results.poll(longest)):
                    yield results.recv()
                    del left[0]
                    longest = limit
            if left:
                yield _reason(process, stream, limit if late else None)
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


def _reason(process: subprocess.Popen[bytes], stream: IO[bytes], limit: float | None) -> str:
    """End a process that has not sent a result, and return the reason.

    Args:
        process: the process.
        stream: its output.
        limit: time limit that its job has reached [s]; None: the process has ended.
    """
    if limit is not None:
        process.send_signal(signal.SIGABRT)  # upon which it writes its stack
    with suppress(subprocess.TimeoutExpired):
        process.wait(_END)
    process.kill()
    code = process.wait()
    stream.seek(0)
    said = stream.read().decode(errors="replace")
    frame = _FRAME.search(said.rpartition("most recent call first")[2])  # of the main thread, which comes last
    place = f", in {Path(frame[1]).name}, line {frame[2]}" if frame else ""
    if limit is not None:
        return f"{NO_END}{limit:g} s{place}"
    if code < 0:
        name = signal.Signals(-code).name
        perhaps = ", perhaps for lack of memory" if name == KILLED else ""
        return f"its process was ended by {name}{perhaps}{place}"
    return f"its process ended with exit code {code}"


def main() -> None:
    """Compute the jobs that the starting process sends, and send the results back."""
    words = allowed_code.taken_from(sys.argv[1:])
    connection = Connection(int(words[0]))
    work, jobs, memory = pickle.loads(connection.recv_bytes())  # noqa: S301 - from the process that started this one
    faulthandler.enable()  # writes the stack if a signal ends this process
    if memory is not None:
        limit_memory(memory)
    connection.send(None)
    for job in jobs:
        connection.send(work(job))


if __name__ == "__main__":
    main()
