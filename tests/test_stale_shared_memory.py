# SPDX-License-Identifier: Apache-2.0
"""Shared memory of DDS that killed processes leave: removed before it is in the way, and never under anybody's feet."""

import contextlib
import fcntl
import mmap
import os
import re
import select
import signal
import subprocess
import sys
from pathlib import Path

import posix_ipc
import pytest
from cells import scenario

from lathe_rc import harness
from lathe_rc.nodes import stale_shared_memory

SEGMENT = "fastrtps_0123456789abcdef"
PORT = f"fastrtps_port{70_000 + os.getpid() % 30_000}"  # no domain has it; its semaphore is the machine's
MUTEX = f"/{PORT}_mutex"


@pytest.fixture
def domain(monkeypatch):
    """A domain of which nothing is in this process's memory, where nodes of other tests stay until collected."""
    with contextlib.ExitStack() as held:
        while True:
            number = held.enter_context(harness.free_domain())
            ports = range(7400 + 250 * number, 7650 + 250 * number)
            used = re.findall(r"fastrtps_port(\d+)", Path("/proc/self/maps").read_text(encoding="utf-8"))
            if not any(int(port) in ports for port in used):
                break
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield number


@pytest.fixture
def port(tmp_path):
    file = tmp_path / PORT
    file.write_bytes(b"broken")
    yield file
    with contextlib.suppress(posix_ipc.ExistentialError):
        posix_ipc.unlink_semaphore(MUTEX)


def test_what_nobody_uses_is_removed_and_nothing_else(port, tmp_path):
    others = {f"sem.{PORT}_mutex", "fastrtps_0123456789abcdef0", "fastrtps_without_a_lock", "port99999"}
    for name in others | {f"{PORT}_el", SEGMENT, f"{SEGMENT}_el"}:
        (tmp_path / name).touch()
    assert stale_shared_memory.sweep(tmp_path) == [port.name, SEGMENT]
    # A lock that stays would make DDS take what comes next for a port of a dead process.
    assert {file.name for file in tmp_path.iterdir()} == others
    assert stale_shared_memory.sweep(tmp_path) == []


def test_the_segment_of_a_living_process_is_left_alone(tmp_path):
    segment, lock = tmp_path / SEGMENT, tmp_path / f"{SEGMENT}_el"
    segment.touch()
    assert stale_shared_memory.sweep(tmp_path) == [], "whose lock is not there yet, or has just been removed"
    with lock.open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert stale_shared_memory.sweep(tmp_path) == []
    assert stale_shared_memory.sweep(tmp_path) == [SEGMENT]


@pytest.mark.parametrize("end", ["_el", "_sl"])
def test_who_listens_is_left_alone(port, end):
    with port.with_name(port.name + end).open("ab") as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        assert stale_shared_memory.sweep(port.parent) == []
    assert stale_shared_memory.sweep(port.parent) == [port.name]


def test_who_is_about_to_listen_is_left_alone(port):
    """DDS holds a semaphore while it makes a port and its lock; a lock of somebody else's would be an error to it."""
    mutex = posix_ipc.Semaphore(MUTEX, posix_ipc.O_CREAT, initial_value=1)
    with mutex:
        assert stale_shared_memory.sweep(port.parent) == []
        assert [file.name for file in port.parent.iterdir()] == [port.name]
    assert stale_shared_memory.sweep(port.parent) == [port.name]
    mutex.acquire(timeout=0)  # the sweep has left it free
    mutex.release()
    mutex.close()


def test_who_was_killed_while_it_made_a_port_keeps_nobody_from_it(port):
    """Nobody has the semaphore in memory that it has left taken: it is as good as free."""
    posix_ipc.Semaphore(MUTEX, posix_ipc.O_CREAT, initial_value=0).close()
    assert stale_shared_memory.sweep(port.parent) == [port.name]
    with posix_ipc.Semaphore(MUTEX, posix_ipc.O_CREAT, initial_value=1) as mutex:
        assert mutex.value == 0, "the next one can take it"
    mutex.close()


def test_who_has_it_in_memory_is_left_alone(port):
    with port.open("r+b") as stream, mmap.mmap(stream.fileno(), 0):
        assert stale_shared_memory.sweep(port.parent) == []
        assert [file.name for file in port.parent.iterdir()] == [port.name]
    assert stale_shared_memory.sweep(port.parent) == [port.name]


def test_sweeps_wait_for_one_another(port, monkeypatch):
    """One would take a port that the other holds for one at which somebody listens, and leave it in the way."""

    def is_mapped(_):
        other = os.open(port.parent, os.O_RDONLY)
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.close(other)
        return False

    monkeypatch.setattr(stale_shared_memory, "_is_mapped", is_mapped)
    assert stale_shared_memory.sweep(port.parent) == [port.name]


def test_a_machine_without_shared_memory(tmp_path):
    assert stale_shared_memory.sweep(tmp_path / "nowhere") == []


def locked_by(pid):
    """Ports at which a process listens, and its segment: those whose lock it has open."""
    links = []
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # it has been closed
            links.append(str(link.readlink()))
    return {found[1] for link in links if (found := re.search(r"/(fastrtps_(?:port\d+|[0-9a-f]{16}))_el$", link))}


def there(names):
    return {name for name in names if (stale_shared_memory.FOLDER / name).exists()}


def test_an_error_of_dds_is_told_on_the_error_stream(domain):
    """Programs read what a command prints: here DDS complains that another process holds the lock of its port."""
    lock = stale_shared_memory.FOLDER / f"fastrtps_port{7400 + 250 * domain + 11}_el"
    # It is killed once it has told: as it ends by itself, Fast DDS may wait for itself.
    node = "import rclpy, signal; rclpy.init(); rclpy.create_node('x'); print('made', flush=True); signal.pause()"
    with lock.open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with subprocess.Popen([sys.executable, "-c", node], text=True, **pipes) as process:
            assert process.stdout.readline() == "made\n"
            assert any("open_and_lock_file failed" in line for line in process.stderr)
            process.kill()
            assert process.stdout.read() == ""
    lock.unlink(missing_ok=True)


def test_what_a_killed_node_has_left_is_removed_and_what_a_living_one_has_is_not(domain):
    nodes = ["tool", "learning_controller"]  # without a time master, the one does not mind the death of the other
    with harness.Processes(scenario(), [[name] for name in nodes], domain=domain) as processes:
        for _ in nodes:
            processes.wait_for("active")
        left, used = (locked_by(processes.pids[name]) for name in nodes)
        assert left
        assert used
        dead = os.pidfd_open(processes.pids["tool"])
        signal.pidfd_send_signal(dead, signal.SIGKILL)
        select.select([dead], [], [])  # until it has ended
        os.close(dead)
        stale_shared_memory.sweep()
        # The living one still has those in memory to which it has sent.
        assert there(used) == used
    stale_shared_memory.sweep()
    # Ports below are shared by all domains: other tests may use them meanwhile.
    own = {name for name in left | used if "port" not in name or int(name.removeprefix("fastrtps_port")) >= 7400}
    assert len({name for name in own if "port" not in name}) == len(nodes)
    assert len(own) > len(nodes)
    assert not there(own)


@pytest.mark.parametrize("content", [b"", bytes(52400), b"\1".ljust(52400, b"\0")])
def test_a_port_that_nobody_makes_any_more_is_given_up_and_no_other(port, content):
    made = port.with_name(f"{PORT}0")
    made.write_bytes(b"\2".ljust(52400, b"\0"))
    port.write_bytes(content)
    assert stale_shared_memory.release(port.parent) == [], "somebody may be making it"
    for file in (made, port):
        os.utime(file, (0.0, 0.0))
    with port.open("rb") as waits:
        assert stale_shared_memory.release(port.parent) == [PORT]
        assert waits.read(4) == b"\3\0\0\0", "whoever has opened it sees that it is corrupted"
    assert [file.name for file in port.parent.iterdir()] == [made.name]


@pytest.mark.parametrize("size", [0, 52400])
def test_who_waits_for_a_port_that_nobody_makes_any_more_is_let_go(domain, monkeypatch, size):
    """Killed processes leave such ports at any time: here after the harness has looked for them, before the start."""
    ports = [stale_shared_memory.FOLDER / f"fastrtps_port{7400 + 250 * domain + 11 + 2 * k}" for k in range(2)]

    def sweep():
        for file in ports:
            file.write_bytes(bytes(size))

    monkeypatch.setattr(stale_shared_memory, "sweep", sweep)
    cell = scenario(spindle_encoder={"revolutions": 5.0})
    assert harness.run(cell, mode="processes", domain=domain).digest == harness.run(cell).digest


def test_a_cell_runs_where_killed_ones_have_left_broken_ports(domain):
    """Without the sweep it stands still before the first block, as it does with those of processes that were killed."""
    for participant in range(8):
        port = 7400 + 250 * domain + 11 + 2 * participant  # of its messages (DDSI-RTPS 2.5, 9.6.2)
        (stale_shared_memory.FOLDER / f"fastrtps_port{port}").write_bytes(bytes(52400))
        if participant % 2:  # as a process leaves it that is killed while it makes the port
            posix_ipc.Semaphore(f"/fastrtps_port{port}_mutex", posix_ipc.O_CREAT, initial_value=0).close()
    cell = scenario(spindle_encoder={"revolutions": 5.0})
    assert harness.run(cell, mode="processes", domain=domain).digest == harness.run(cell).digest
