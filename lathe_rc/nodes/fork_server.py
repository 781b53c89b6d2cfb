# SPDX-License-Identifier: Apache-2.0
"""The process that starts the processes of cells: ``python -m lathe_rc.nodes.fork_server DESCRIPTOR``.

It imports once what nodes need, and forks itself for each process of a cell: that takes milliseconds, where a new
interpreter takes a second to import the same. It takes part in no ROS domain itself. A process of which the request
says so is replaced by a command: a separate interpreter.

`lathe_rc.starting` asks for processes over a socket and hears over it, as an event each, that one has been stopped or
continued, or has ended. The standard library's fork server (`multiprocessing.forkserver`) reports ends alone; but no
other process can report a stopped one that holds a lock of DDS.

The libraries of ROS 2 run two threads from their import on, which wait for a tracing session of LTTng. They hold no
lock meanwhile; forked processes do without them, and so without LTTng.
"""

import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Iterator
from typing import Any

from lathe_rc.nodes.report import VARIABLE

_NODES = "lathe_rc.nodes.process"
_MOST = 2**18  # [B] of a request; the environment is the most of it
_FAREWELL = 10.0  # [s] for processes to end by themselves when nobody asks any more
_CHANGES = os.WEXITED | os.WSTOPPED | os.WCONTINUED | os.WNOHANG


def _load(nodes: dict[str, Any]) -> None:
    """Import what nodes need, and load what some of them will."""
    with contextlib.suppress(ImportError):  # a process that needs it says so
        importlib.import_module(_NODES).preload(nodes)
    gc.freeze()  # the collector leaves alone what forked processes share with this one


def _become(request: dict[str, Any], report: int, log: int) -> int:
    """Turn a process that has just been forked into one of a cell; its exit code."""
    os.setsid()
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"] | {VARIABLE: str(report)})
    for stream in (1, 2):
        os.dup2(log, stream)
    os.close(log)
    if request["command"]:
        os.set_inheritable(report, True)  # noqa: FBT003 - it has no other form
        os.execvpe(request["command"][0], request["command"], os.environ)
    sys.path[:] = request["path"]  # modules of others are found where who asks finds them
    process = importlib.import_module(_NODES)
    return int(process.run(*process.split(request["arguments"])))


def _changed(living: set[int]) -> Iterator[dict[str, Any]]:
    """Changes of processes since the last call; those that have ended are not ``living`` any more."""
    with contextlib.suppress(ChildProcessError):  # there is none
        while found := os.waitid(os.P_ALL, 0, _CHANGES):
            ended = found.si_code in (os.CLD_EXITED, os.CLD_KILLED, os.CLD_DUMPED)
            state = "ended" if ended else "continued" if found.si_code == os.CLD_CONTINUED else "stopped"
            code = found.si_status if found.si_code == os.CLD_EXITED or not ended else -found.si_status
            if ended:
                living.discard(found.si_pid)
            yield {"pid": found.si_pid, "state": state, "code": code}


def _tell(line: socket.socket, living: set[int]) -> bool:
    """Say what has become of processes since the last call; whether anybody is left to hear it."""
    for change in _changed(living):
        try:
            line.send(json.dumps(change).encode())
        except BrokenPipeError:
            return False
    return True


def _see_off(woken: socket.socket, living: set[int]) -> int:
    """Wait for processes to end when nobody can ask any more; one that DDS blocks is killed. The exit code."""
    end = time.monotonic() + _FAREWELL
    while living and (left := end - time.monotonic()) > 0.0:
        if select.select([woken], [], [], left)[0]:
            woken.recv(_MOST)
        for _ in _changed(living):
            pass
    for pid in living:
        os.kill(pid, signal.SIGKILL)
    return 0


def serve(line: socket.socket) -> int:
    """Fork as asked until nobody can ask any more.

    Returns:
        The exit code, also that of each process that was forked: they leave by the same way.
    """
    ours, woken = socket.socketpair()
    for end in (ours, woken):
        end.setblocking(False)  # noqa: FBT003 - it has no other form
    signal.signal(signal.SIGCHLD, lambda _number, _frame: None)
    signal.set_wakeup_fd(woken.fileno(), warn_on_full_buffer=False)
    living: set[int] = set()
    while True:
        readable, _, _ = select.select([line, ours], [], [])
        if ours in readable:
            ours.recv(_MOST)
            if not _tell(line, living):
                return _see_off(ours, living)
        if line not in readable:
            continue
        asked, descriptors, _, _ = socket.recv_fds(line, _MOST, 2)
        if not asked:
            return _see_off(ours, living)
        request = json.loads(asked)
        if "preload" in request:
            _load(request["preload"])
            continue
        if not request["command"] and _NODES not in sys.modules:
            _load({})
        if not (pid := os.fork()):
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            for end in (line, ours, woken):
                end.close()
            return _become(request, *descriptors)
        living.add(pid)
        process = os.pidfd_open(pid)
        socket.send_fds(line, [json.dumps({"pid": pid, "state": "started", "code": 0}).encode()], [process])
        for descriptor in (process, *descriptors):
            os.close(descriptor)


def main() -> None:
    """Serve at the socket whose descriptor is the argument."""
    gc.disable()  # a process of a cell enables it: to collect while all is being imported takes a tenth longer
    with contextlib.suppress(BrokenPipeError), socket.socket(fileno=int(sys.argv[1])) as line:
        sys.exit(serve(line))


if __name__ == "__main__":
    main()
