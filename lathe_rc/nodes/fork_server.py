# SPDX-License-Identifier: Apache-2.0
"""Server that forks the processes of cells: ``python -m lathe_rc.nodes.fork_server DESCRIPTOR``.

It imports the modules of the nodes once, and forks itself for each process of a cell: that takes milliseconds, where a
new interpreter takes a second for the same imports. It takes part in no ROS domain itself. On request, the forked
process is replaced by a command: a separate interpreter.

`lathe_rc.process_launcher` requests processes over a socket. The responses are pairs: process number and None, with the
pidfd, when the process has started; process number and exit code when it has ended.

The libraries of ROS 2 start two threads on import, which wait for a tracing session of LTTng. They hold no lock
meanwhile; forked processes run without these threads, and so without LTTng.
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
from typing import Any, NoReturn

from lathe_rc.nodes.report import VARIABLE

_NODES = "lathe_rc.nodes.process"
_MOST = 2**18  # [B] size of a request, mainly the environment
_FAREWELL = 10.0  # [s] for processes to end after the launcher has gone


def _load(nodes: dict[str, Any]) -> None:
    """Import the modules of all nodes, and preload the kernels that some nodes use."""
    with contextlib.suppress(ImportError):  # a process that needs the module reports the error
        importlib.import_module(_NODES).preload(nodes)
    gc.freeze()  # the collector skips objects shared with forked processes


def _become(request: dict[str, Any], report: int, log: int) -> NoReturn:
    """Turn a freshly forked process into a process of a cell."""
    # A group of its own for signals, but no session: Linux schedules sessions against each other (sched_autogroup), and
    # each message would preempt its sender.
    os.setpgid(0, 0)
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"] | {VARIABLE: str(report)})
    for stream in (1, 2):
        os.dup2(log, stream)
    os.close(log)
    if request["command"]:
        os.set_inheritable(report, True)  # noqa: FBT003 - it has no other form
        os.execvpe(request["command"][0], request["command"], os.environ)
    sys.path[:] = request["path"]  # third-party modules are found as by the launcher
    process = importlib.import_module(_NODES)
    process.run_and_exit(request["arguments"])
    raise AssertionError("a process of a cell exits by itself")


def _reap_children(line: socket.socket, children: dict[int, int]) -> None:
    """Wait for the child processes after the launcher has gone; kill the remaining ones."""
    line.close()  # a closed connection stays readable forever
    end = time.monotonic() + _FAREWELL
    while children and (readable := select.select([*children], [], [], max(end - time.monotonic(), 0.0))[0]):
        for process in readable:
            del children[process]
    for process in children:
        signal.pidfd_send_signal(process, signal.SIGKILL)


def serve(line: socket.socket) -> int:
    """Fork processes on request until the launcher has gone.

    Returns:
        The exit code of the server.
    """
    children: dict[int, int] = {}  # process number by pidfd, which is readable once the process has ended
    while True:
        readable, _, _ = select.select([line.fileno(), *children], [], [])
        for process in children.keys() & set(readable):
            pid = children.pop(process)
            os.close(process)
            code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            with contextlib.suppress(BrokenPipeError):  # the closed connection is detected below
                line.send(json.dumps([pid, code]).encode())
        if line.fileno() not in readable:
            continue
        asked, descriptors, _, _ = socket.recv_fds(line, _MOST, 2)
        if not asked:
            _reap_children(line, children)
            return 0
        request = json.loads(asked)
        if "preload" in request:
            _load(request["preload"])
            continue
        if not request["command"] and _NODES not in sys.modules:
            _load({})
        if not (pid := os.fork()):
            for other in (line.detach(), *children):
                os.close(other)
            _become(request, *descriptors)
        process = os.pidfd_open(pid)
        children[process] = pid
        with contextlib.suppress(BrokenPipeError):
            socket.send_fds(line, [json.dumps([pid, None]).encode()], [process])
        for descriptor in descriptors:
            os.close(descriptor)


def main() -> None:
    """Serve requests at the socket whose descriptor is the command-line argument."""
    gc.disable()  # cell processes enable it; collecting during the imports takes 10 % longer
    with socket.socket(fileno=int(sys.argv[1])) as line:
        sys.exit(serve(line))


if __name__ == "__main__":
    main()
