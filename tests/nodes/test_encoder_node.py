# SPDX-License-Identifier: Apache-2.0
"""A real encoder as time master of a cell of nodes: by a serial line, by a topic, by a file at a pace."""

import os
import pty
import re
import threading
from contextlib import contextmanager

import numpy as np
import pytest
from cells import until
from test_counts import COUNTS, TURN, follower, write_counts, write_edges

from lathe_bagtools.resimulation.resim import resimulate
from lathe_machine.nodes import encoder_role
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuatorParameters
from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.bag.check import check
from lathe_rc.errors import LatheError

pytest.importorskip("rclpy")

import leading
from sensor_msgs.msg import JointState

from lathe_rc.protocol import Phase

SAFE = ElectrodynamicActuatorParameters().safe_position
PATIENT = {"max_lag": 60.0, "max_silence": 60.0}  # no test may depend on the wall clock


def device(**changed):
    """The smallest cell with a live encoder."""
    return follower("", **{"source": "line", "counts_file": "", "revolutions": 2.0, **PATIENT, **changed})


def readings(path):
    return [tuple(map(int, line.split(","))) for line in path.read_text().splitlines()[1:]]


@contextmanager
def serial_line(text):
    """A terminal on which text comes when the cell has begun: its path, and what watches the cell."""
    ours, theirs = pty.openpty()
    begun, told = threading.Event(), []

    def watch(event):
        told.append(event)
        if event["event"] == "block0":
            begun.set()

    def write():
        begun.wait()
        rest = text.encode()
        while rest:
            rest = rest[os.write(ours, rest[:512]) :]

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    yield os.ttyname(theirs), watch, told
    begun.set()
    os.close(theirs)
    writer.join(10.0)
    os.close(ours)


def lines(path):
    """As an encoder that has been sending all the time: the first line is not whole."""
    return "23,4\n" + "".join(f"{','.join(map(str, reading))}\n" for reading in readings(path))


@pytest.mark.parametrize(("mode", "edge_clock"), [("composed", 1e-6), ("processes", 0.0)])
def test_a_serial_line_leads_a_cell_and_gives_the_bits_of_a_file_of_its_counts(tmp_path, mode, edge_clock):
    """A serial line leads a cell with the bits of a file of its counts; its bag is simulated again to the bit.

    The received readings are in the bag: run again from that, every bit comes out.
    """
    path = tmp_path / "counts.csv"
    if edge_clock:
        write_edges(path, 200_000)
    else:
        write_counts(path, 0.2)
    with serial_line(lines(path)) as (line, watch, _):
        live = harness.run(device(device=line, edge_clock=edge_clock), mode=mode, bag=tmp_path / "bag", watch=watch)
    of_file = harness.run(follower(path, revolutions=2.0, edge_clock=edge_clock))
    assert live.digest == of_file.digest
    assert live.samples == of_file.samples
    assert live.lateness.blocks == live.blocks
    assert not resimulate(tmp_path / "bag").different


def test_a_topic_leads_a_cell(tmp_path, ghost, domain):
    """A topic of joint states leads a cell.

    An angle within a revolution of the second joint, told by name; joint states without it are others'.
    """
    path = tmp_path / "counts.csv"
    write_counts(path, 0.2)
    publisher = ghost.create_publisher(JointState, "/lathe/joints", 1000)

    def publish():
        begun.wait()
        until(publisher.get_subscription_count)
        for time, count in readings(path):
            publisher.publish(JointState(name=["gripper"], position=[0.01]))
            publisher.publish(JointState(name=["x", "spindle"], position=[0.0], velocity=[0.0, 104.7]))
            joints = JointState(name=["x", "spindle"], position=[0.0, TURN * (count % COUNTS) / COUNTS])
            joints.header.stamp.sec, joints.header.stamp.nanosec = divmod(time, 10**9)
            publisher.publish(joints)

    begun = threading.Event()
    writer = threading.Thread(target=publish, daemon=True)
    writer.start()

    def watch(event):
        if event["event"] == "block0":
            begun.set()

    given = {"topic": "/lathe/joints", "joint": "spindle", "counter_range": COUNTS, "device": "", "source": "topic"}
    live = harness.run(device(**given), mode="composed", watch=watch, domain=domain)
    of_file = harness.run(follower(path, revolutions=2.0))
    assert live.samples == of_file.samples
    angle, expected = (run.recording.dense["/encoder"]["angle"] for run in (live, of_file))
    assert np.abs(angle - expected).max() < 1e-9
    assert live.errors.rms[-1] == pytest.approx(of_file.errors.rms[-1], rel=1e-3)


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        ("", r"encoder_device: the line ends at 0\.0995 s, after 1\.6\d* revolutions"),
        ("1,x\n", r".*pipe: '1,x'; allowed: a time and a counter, as time_ns,counts"),
        ("800000000000000000,9\n", r"encoder_device: no counts from 0.0995 to .*allowed: up to max_gap = 10 ms"),
    ],
)
def test_when_the_encoder_is_lost_the_others_come_to_their_safe_state(tmp_path, rest, message):
    """A cell that has lost its real encoder goes to the safe state.

    Missing and wrong readings are reported; the drive retracts while the spindle seems to keep its last speed.
    """
    path, pipe = tmp_path / "counts.csv", tmp_path / "pipe"
    write_counts(path, 0.1)
    os.mkfifo(pipe)
    begun, turns, told = threading.Event(), threading.Event(), []

    def write():
        begun.wait()
        with pipe.open("w") as writer:
            writer.write(lines(path).partition("\n")[2])
            writer.flush()
            turns.wait()
            writer.write(rest)

    threading.Thread(target=write, daemon=True).start()

    def watch(event):
        told.append(event)
        if event["event"] == "block0":
            begun.set()
        if event["event"] == "progress" and event["samples"]:
            turns.set()

    with pytest.raises(LatheError, match=rf"^{message}.*: safe state from sample \d+ on$"):
        harness.run(device(device=str(pipe)), mode="composed", watch=watch, bag=tmp_path / "bag")
    (safe,) = [event for event in told if event["event"] == "safe"]
    assert (safe["lost"], safe["end"]) == ([], safe["sample"] + 12_800)
    found = check(tmp_path / "bag")
    why = f"samples from {safe['sample']} on are held or guessed, or may rest on such: the cell went to its safe state"
    assert (found.wrong, found.lost) == ([], [why])
    assert reader.read_bag(tmp_path / "bag").samples == safe["sample"], "later angles are guessed"
    recording = reader.read_bag(tmp_path / "bag", whole=True)
    assert {signals.size for fields in recording.dense.values() for signals in fields.values()} == {safe["end"]}
    speed = recording.dense["/encoder"]["speed"]
    assert np.ptp(speed[-10_000:]) < 1e-6 * speed[-1]
    assert recording.dense["/coarse/state"]["position"][-1] == pytest.approx(SAFE, abs=1e-6)


@contextmanager
def leads(**parameters):
    """A time master of its own kind in this process, as soon as its run has begun."""
    given = {"counts_per_revolution": COUNTS, "revolutions": 2.0, **PATIENT, **parameters}
    with leading.time_master("encoder_device", encoder_role.EncoderRole, **given) as node:
        leading.begin(node)
        yield node


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"max_gap": 2e-4}, "no counts from 0 to 0.0005 s, for 0.5 ms; allowed: up to max_gap = 0.2 ms$"),
        # More comes at once than this window lets the cell fall behind.
        ({"max_lag": 1e-9, "window": 2}, "the cell is .* s behind the encoder at sample 0; allowed: up to max_lag = "),
    ],
)
def test_an_encoder_that_is_lost_before_the_first_sample_ends_the_cell_at_once(tmp_path, changed, message):
    """There is nothing yet that could come to a safe state: the time master fails, and the cell with it."""
    path = tmp_path / "counts.csv"
    write_counts(path, 0.2)
    pipe = tmp_path / "pipe"
    pipe.write_text(lines(path).partition("\n")[2])
    with leads(source="line", device=str(pipe), **changed) as node:
        for _ in range(100):
            node.tick(node.next_tick)
        assert re.match(f"encoder_device: {message}", str(node.protocol.failure))
        assert node.protocol.phase == Phase.FAILED


@pytest.mark.parametrize("others", [False, True])
def test_silence_is_an_error_that_names_the_topic_and_what_came_of_others(others):
    """Nobody publishes the topic, or joint states of others come on it."""
    given = {"joint": "spindle"} if others else {}
    why = "; nobody publishes /spindle/joint_states"
    with leads(source="topic", max_silence=0.2, **given) as node:
        if others:
            node.role._on_joints(JointState(name=["gripper", "wrist"], position=[0.01, 0.2]))
            why = (
                "; 1 messages on /spindle/joint_states have no position of joint 'spindle', the last of gripper, wrist"
            )
        node.role._listens = others
        node.role._came -= 1.0  # as if a second had passed
        node.tick(node.next_tick)
        assert re.search(f"no counts for .* max_silence = 0.2 s{why}", str(node.protocol.failure))


@pytest.mark.parametrize(
    ("joint", "names", "positions", "place"),
    [
        ("", ["x", "y"], [0.1, 0.2], 0),
        ("", [], [0.1], 0),
        ("", [], [], None),
        ("", ["x"], [], None),
        ("spindle", ["spindle"], [0.1], 0),
        ("spindle", ["x", "spindle"], [0.1, 0.2], 1),
        ("spindle", ["x", "spindle"], [0.1], None),
        ("spindle", ["spindle", "x"], [0.1], 0),
        ("spindle", ["spindle"], [], None),
        ("spindle", ["Spindle"], [0.1], None),
        ("spindle", [], [0.1], None),
        ("spindle", ["gripper"], [0.1], None),
    ],
)
def test_a_joint_state_without_the_spindle_s_position_is_another_s(joint, names, positions, place):
    assert encoder_role._place(JointState(name=names, position=positions), joint) == place


def test_a_line_that_cannot_be_opened_is_refused_before_the_cell_begins():
    with leading.time_master("encoder_device", encoder_role.EncoderRole, source="line", device="/dev/no_such") as node:
        refusal = str(node.protocol.failure)
    assert "/dev/no_such: cannot be opened (No such file or directory); check the path" in refusal


def test_a_file_keeps_a_pace_among_nodes_and_how_well_is_told(tmp_path):
    path = tmp_path / "counts.csv"
    write_counts(path, 0.1)
    paced = harness.run(follower(path, revolutions=1.0, speed_factor=1.0), mode="composed")
    assert paced.digest == harness.run(follower(path, revolutions=1.0)).digest
    assert paced.lateness.blocks == paced.blocks
