# SPDX-License-Identifier: Apache-2.0
"""Start of processes through a fork server (see `lathe_rc.nodes.fork_server`); this module does not import ROS.

The fork server of `multiprocessing` imports the user's main module again in each process: a script without
``if __name__ == "__main__"`` would rerun itself, and so would a notebook. It also cannot load kernels on request.
"""

import atexit
import contextlib
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import weakref
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Literal

from lathe_rc import allowed_code, extras
from lathe_rc.errors import LatheError

Start = Literal["fork", "spawn"]  #: start of a process: forked from one with all imports, or as a new interpreter

_MOST = 2**16  # longest answer [B]


class Child:
    """Process started by the fork server, with the methods of `subprocess.Popen`.

    Args:
        pid: process ID.
        descriptor: pidfd of the process, which stays unique even if the process ID is reused.

    Attributes:
        returncode: exit code, as in `subprocess.Popen`.
    """

    def __init__(self, pid: int, descriptor: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._descriptor = descriptor
        weakref.finalize(self, os.close, descriptor)
        self._ended = threading.Event()

    def poll(self) -> int | None:
        """Return the exit code of the process; None while it runs."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end of the process.

        Raises:
            subprocess.TimeoutExpired: the process has not ended within ``timeout`` seconds.
        """
        if not self._ended.wait(timeout):
            raise subprocess.TimeoutExpired(str(self.pid), timeout or 0.0)
        assert self.returncode is not None
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal to the process, unless it has ended."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._descriptor, number)

    def kill(self) -> None:
        """Send SIGKILL to the process."""
        self.send_signal(signal.SIGKILL)

    def end(self, code: int) -> None:
        """Store the exit code that the fork server reports."""
        self.returncode = code
        self._ended.set()


class ForkServer:
    """Fork server of this process; it ends when this process does.

    Raises:
        LatheError: ROS 2 is not installed.

    Attributes:
        lost: whether the server has ended.
    """

    def __init__(self) -> None:
        extras.require("rclpy")
        self._line, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [*allowed_code.interpreter("lathe_rc.nodes.fork_server"), str(theirs.fileno())],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )
        self._children: dict[int, Child] = {}
        self._started: queue.SimpleQueue[Child | None] = queue.SimpleQueue()
        self._asking = threading.Lock()
        self.lost = False
        threading.Thread(target=self._listen, daemon=True).start()
        atexit.register(self.close)

    def preload(self, nodes: Mapping[str, tuple[str, Mapping[str, object]]]) -> None:
        """Load the modules and kernels of nodes in the server, without waiting for it to finish.

        Args:
            nodes: kind and parameters of each node.
        """
        with self._asking, contextlib.suppress(BrokenPipeError):
            self._line.send(json.dumps({"preload": nodes}).encode())

    def start(
        self,
        arguments: Sequence[str],
        *,
        environment: Mapping[str, str],
        report: socket.socket,
        log: int,
        command: Sequence[str] = (),
    ) -> Child:
        """Start a process in a new session, with the current folder of this process.

        Args:
            arguments: command-line arguments of `lathe_rc.nodes.container`, which the process runs.
            environment: complete environment of the process.
            report: socket for the new process's `lathe_rc.nodes.report.Reporter`; may be closed after the call.
            log: descriptor of the file for the new process's output.
            command: command to run instead of the container.

        Raises:
            LatheError: the server has ended.
        """
        request = {
            "arguments": list(arguments),
            "environment": dict(environment),
            "folder": str(Path.cwd()),
            "path": sys.path,
            "command": list(command),
        }
        with self._asking:
            with contextlib.suppress(BrokenPipeError):
                socket.send_fds(self._line, [json.dumps(request).encode()], [report.fileno(), log])
            child = self._started.get()
        if child is None:
            self._started.put(None)  # for the next caller
            raise LatheError("the process that starts the nodes has ended: see what it has written")
        return child

    def _listen(self) -> None:
        """Process the server's answers; when it ends, kill its children, whose exit codes would be unknown."""
        with contextlib.suppress(OSError):
            while (answer := socket.recv_fds(self._line, _MOST, 1))[0]:
                pid, code = json.loads(answer[0])
                if code is None:
                    child = self._children[pid] = Child(pid, answer[1][0])
                    self._started.put(child)
                else:
                    self._children.pop(pid).end(code)
        self.lost = True
        for child in self._children.values():
            child.kill()
            child.end(-signal.SIGKILL)
        self._started.put(None)

    def close(self) -> None:
        """Stop the server."""
        with contextlib.suppress(OSError):
            self._line.shutdown(socket.SHUT_RDWR)
        self._process.terminate()  # it may still be compiling kernels that are no longer needed
        self._process.wait()


@cache
def _server_of(_pid: int) -> ForkServer:
    return ForkServer()


def server() -> ForkServer:
    """Return the fork server of this process; start one on the first call, or if the last one has ended."""
    if _server_of(os.getpid()).lost:
        _server_of.cache_clear()
    return _server_of(os.getpid())
