# SPDX-License-Identifier: Apache-2.0
"""A cell over two machines, which are two network namespaces, with a bad wire between them; one must be root.

The wire is a TAP device in each namespace and a thread that carries Ethernet frames from one to the other: it loses
and delays them on any kernel, where netem is a module that not all have.
"""

import collections
import fcntl
import itertools
import os
import select
import struct
import subprocess
import threading
import time

import numpy as np
import pytest
from cells import scenario, told_until_all_have_ended
from rosbags.highlevel import AnyReader

from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.bag.repairing import recover

pytestmark = pytest.mark.system

_TUNSETIFF, _TAP, _NO_PI = 0x400454CA, 0x0002, 0x1000
GROUPS = [["spindle_encoder"], ["learning_controller"], ["electrodynamic_actuator"], ["tool"], ["recorder"]]
FAR = ("electrodynamic_actuator", "recorder")
CELL = scenario(spindle_encoder={"revolutions": 30.0})
CAUTIOUS = scenario(spindle_encoder={"revolutions": 30.0, "stall_reaction": "safe", "stall_time": 2.0})


def ip(*words):
    subprocess.run(["ip", *words], check=True)


class Wire:
    """Two network namespaces and what connects them.

    Attributes:
        loss: part of the frames that is lost; 1: the wire is cut.
        delay: of each frame [s].
        carried: frames so far.
    """

    def __init__(self, name, loss, delay):
        self.loss, self.delay, self.carried = loss, delay, 0
        self.spaces = [f"{name}{side}" for side in "ab"]
        self._ends, self._random, self._over = [], np.random.default_rng(1), threading.Event()
        self._thread = threading.Thread(target=self._carry)

    def __enter__(self):
        for number, space in enumerate(self.spaces, 1):
            ip("netns", "add", space)
            end = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
            self._ends.append(end)
            fcntl.ioctl(end, _TUNSETIFF, struct.pack("16sH22x", space.encode(), _TAP | _NO_PI))
            ip("link", "set", space, "netns", space)
            ip("-n", space, "addr", "add", f"10.77.0.{number}/24", "dev", space)
            ip("-n", space, "link", "set", "lo", "up")
            ip("-n", space, "link", "set", space, "up")
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()
        for end in self._ends:
            os.close(end)
        for space in self.spaces:
            subprocess.run(["ip", "netns", "del", space], check=False)

    def _carry(self):
        under_way = collections.deque()
        other = dict(itertools.permutations(self._ends))
        while not self._over.is_set():
            wait = under_way[0][0] - time.monotonic() if under_way else 0.1
            for end in select.select(self._ends, [], [], max(min(wait, 0.1), 0.0))[0]:
                frame = os.read(end, 65536)
                if self._random.random() >= self.loss:
                    under_way.append((time.monotonic() + self.delay, other[end], frame))
            while under_way and under_way[0][0] <= time.monotonic():
                _, end, frame = under_way.popleft()
                os.write(end, frame)
                self.carried += 1


@pytest.fixture
def wire(request, monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    with Wire(f"lathe{os.getpid() % 10000}", *getattr(request, "param", (0.0, 0.0))) as made:
        yield made


@pytest.fixture
def processes(request, wire, tmp_path):
    """The cell's processes: the spindle here, the drive and the recorder at the far end."""
    here, there = ([*["ip", "netns", "exec"], space] for space in wire.spaces)
    prefix = {name: there if name in FAR else here for (name,) in GROUPS}
    cell = harness.with_recorder(getattr(request, "param", CELL), tmp_path / "bag", keep=True)
    with harness.Processes(cell, GROUPS, prefix=prefix) as made:
        yield made


@pytest.mark.parametrize("wire", [(0.0, 0.0), (0.02, 0.005)], indirect=True, ids=["clean", "loss"])
def test_a_cell_over_two_machines_gives_the_same_bits(wire, processes, tmp_path):
    processes.wait_for_end()
    assert reader.read_bag(tmp_path / "bag").digests() == harness.run(CELL).digest
    assert wire.carried > 1000


def test_a_cut_wire_that_is_mended_costs_nothing_but_time(wire, processes, tmp_path):
    processes.wait_for("cycle")
    wire.loss = 1.0
    assert processes.wait_for("stall", node="spindle_encoder")["member"].removeprefix("/") in FAR
    wire.loss = 0.0
    processes.wait_for_end()
    assert reader.read_bag(tmp_path / "bag").digests() == harness.run(CELL).digest


def test_when_the_wire_stays_cut_the_silent_are_named_and_the_bag_is_readable(wire, processes, tmp_path):
    processes.wait_for("cycle")
    wire.loss = 1.0
    assert processes.wait_for("stall", node="spindle_encoder")["member"].removeprefix("/") in FAR
    processes.stop()
    recover.mend(tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as found:
        assert sum(1 for _ in found.messages()) > 100


@pytest.mark.parametrize("processes", [CAUTIOUS], indirect=True)
def test_when_the_wire_stays_cut_both_sides_stop_if_the_cell_shall_not_wait(wire, processes, tmp_path):
    processes.wait_for("cycle")
    wire.loss = 1.0
    told = told_until_all_have_ended(processes)
    # DDS may miss one of them a moment before the other; then the time master says so twice, of one safe state.
    *_, safe = said = [event for event in told if event["event"] == "safe"]
    assert {name.removeprefix("/") for name in safe["lost"]} == set(FAR)
    assert "fell silent: safe state from sample" in safe["why"]
    assert len({event["end"] for event in said}) == 1
    # Its process may end, which the two name spaces hide from neither side, before it has been silent for so long.
    gone = {event["node"] for event in told if event["event"] in ("masterless", "abandoned")}
    assert gone == set(FAR), "their time master is gone"
    with AnyReader([tmp_path / "bag"]) as found:
        assert sum(1 for _ in found.messages()) > 100
