# SPDX-License-Identifier: Apache-2.0
"""Processes that a fork server starts: what they are given, what is heard of them, what becomes of them without it."""

import os
import select
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from cells import scenario

from lathe_rc import harness, process_launcher
from lathe_rc.errors import LatheError

PATIENCE = 30.0  # [s]


class Shell:
    """A shell that a server has started.

    Args:
        server: asked to start it.
        log: for what it prints.
        script: to run.
        environment: all of it.
    """

    def __init__(self, server, log, script, **environment):
        self.line, theirs = socket.socketpair()
        self.line.settimeout(PATIENCE)
        with log.open("ab") as file, theirs:
            self.child = server.start(
                [],
                environment=os.environ | environment,
                report=theirs,
                log=file.fileno(),
                command=["/bin/sh", "-c", script],
            )


@pytest.fixture
def server():
    made = process_launcher.ForkServer()
    yield made
    made.close()


def test_a_process_has_the_folder_environment_log_and_line_of_who_asked(server, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    log = tmp_path / "log"
    shell = Shell(server, log, 'echo "$PWD $GREETING"; eval "echo heard >&$LATHE_REPORT_FD"', GREETING="hello")
    assert shell.child.wait(PATIENCE) == 0
    assert log.read_text() == f"{tmp_path} hello\n"
    assert shell.line.recv(100) == b"heard\n"
    assert shell.line.recv(100) == b""  # nobody else holds the other end


@pytest.mark.parametrize(("script", "code"), [("exit 3", 3), ("kill -SEGV $$", -signal.SIGSEGV)])
def test_how_a_process_ended_is_known(server, tmp_path, script, code):
    child = Shell(server, tmp_path / "log", script).child
    assert child.wait(PATIENCE) == code
    assert child.poll() == code
    child.kill()  # which has ended: no other process that has its number now


def test_without_the_server_its_processes_are_killed_and_another_server_starts_others(tmp_path, monkeypatch):
    process_launcher._server_of.cache_clear()
    first = process_launcher.server()
    child = Shell(first, tmp_path / "log", "exec sleep 1000").child
    with pytest.raises(subprocess.TimeoutExpired):
        child.wait(0.0)
    first._process.kill()
    assert child.wait(PATIENCE) == -signal.SIGKILL
    for _ in range(2):
        with pytest.raises(LatheError, match="the process that starts the nodes has ended"):
            Shell(first, tmp_path / "log", "true")
    second = process_launcher.server()
    assert second is not first
    assert Shell(second, tmp_path / "log", "true").child.wait(PATIENCE) == 0


def test_the_server_ends_with_the_process_that_started_it():
    code = """if True:
        import os, signal
        from lathe_rc import process_launcher
        print(process_launcher.server()._process.pid, flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    told = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=False).stdout
    process = Path("/proc", told.strip(), "cmdline")  # the number may be another's by now
    while process.exists() and b"fork_server" in process.read_bytes():
        os.sched_yield()


@pytest.mark.system
def test_separate_interpreters_give_the_bits_of_forked_processes():
    cell = scenario()
    runs = [harness.run(cell, mode="composed", start=start) for start in ("fork", "spawn")]
    assert runs[0].digest == runs[1].digest


STUCK = """
import os, socket, sys, time
from lathe_rc import process_launcher
ours, theirs = socket.socketpair()
child = process_launcher.server().start(
    [], environment=dict(os.environ), report=theirs, log=2,
    command=["/bin/sh", "-c", "trap '' TERM HUP; exec sleep 1000"],
)
print(child.pid, flush=True)
time.sleep(1000.0)
"""


@pytest.mark.system
def test_a_process_that_does_not_end_by_itself_is_killed_when_nobody_is_left_to_do_it():
    """Its harness has been killed, and it takes no signal that it can ignore."""
    with subprocess.Popen([sys.executable, "-c", STUCK], stdout=subprocess.PIPE) as harness_process:
        descriptor = os.pidfd_open(int(harness_process.stdout.readline()))
        harness_process.kill()
    assert select.select([descriptor], [], [], 60.0)[0], "readable when the process has ended"
    os.close(descriptor)
