# SPDX-License-Identifier: Apache-2.0
"""Publishers that do not belong to a cell, on its topics: refused, counted, named, and the cell goes on."""

import contextlib
import itertools
import os
import re
import signal
import threading

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from cells import STEP, Seen, block, held, scenario
from lathe_rc_msgs.msg import CellState, EncoderBlock, Member, Progress, ToolBlock
from mcap.reader import make_reader
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from lathe_rc import harness, messages
from lathe_rc.bag import reader
from lathe_rc.nodes.ports import latched_qos


def uneven(msgtype, source, run_id):
    made = messages.decode(msgtype, block(msgtype, 0, source, run_id))
    name = next(iter(messages.sample_fields(msgtype)))
    setattr(made, name, getattr(made, name)[:1])
    return messages.encode(msgtype, made)


def foreign(msgtype, own):
    """Blocks that do not belong, on a topic of the node ``own`` in the run 'test'."""
    return [
        block(msgtype, 0, "/other", "test"),
        block(msgtype, 0, own, "elsewhere"),
        block(msgtype, 64, "/step", "test", step=20_000),
        block(msgtype, 0, "/long", "test", size=8192),
        uneven(msgtype, "/uneven", "test"),
        block(msgtype, 0, "/nan", "test", fill=np.nan),
        block(msgtype, 2**40, "/jump", "test"),
        b"\0\1\0\0" + b"\xff" * 1000,
    ]


def joint_state(sample):
    """One with a time of this run; none is due at the samples that are used here."""
    sec, nanosec = divmod(messages.START_NS + sample * STEP, 10**9)
    return JointState(header=Header(stamp=Time(sec=sec, nanosec=nanosec)), position=[1.0])


def senders(topic, own):
    """The names of the refused messages of `foreign`."""
    sources = ["/other", "/step", "/long", "/uneven", "/nan", "/jump"]
    return {f"{source} of run 'test' on {topic}" for source in sources} | {
        f"{own} of run 'elsewhere' on {topic}",
        f"an unknown sender of run '' on {topic}",
    }


@contextlib.contextmanager
def all_the_time(sends, pause=0.002):
    """Publishes the messages of ``sends``, pairs of publisher and message, again and again."""
    over = threading.Event()

    def work():
        for publisher, message in itertools.cycle(sends):
            publisher.publish(message)
            if over.wait(pause):
                return

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def refused_by_a_node(event):
    """The sender of the message that an event reports as refused, as the counts of refused messages name it."""
    if event["event"] != "foreign_message":
        return None
    topic, run, source = re.match(r"(\S+): message of run ('.*?') from (\S+);", event["message"]).groups()
    return f"{'an unknown sender' if source == '?' else source} of run {run} on {topic}"


def diagnostics(bag):
    """Of each node, the last report in a bag."""
    with next(bag.glob("*.mcap")).open("rb") as stream:
        told = [message.data for _, _, message in make_reader(stream).iter_messages(topics=["/diagnostics"])]
    arrays = [messages.decode("diagnostic_msgs/msg/DiagnosticArray", data) for data in told]
    return {status.name: status for array in arrays for status in array.status}


def test_a_cell_goes_on_among_foreign_messages(ghost, domain, tmp_path):
    """Foreign messages are refused, counted and named, and the cell gives the bits that it has alone."""
    cell = scenario(spindle_encoder={"revolutions": 12.0, "speed_factor": 0.2})  # while all is said several times
    on = {"/encoder": (EncoderBlock, "/spindle_encoder"), "/tool": (ToolBlock, "/tool")}
    sends = []
    for topic, (kind, own) in on.items():
        publisher = ghost.create_publisher(kind, topic, latched_qos(10))
        sends += [(publisher, message) for message in foreign(f"lathe_rc_msgs/msg/{kind.__name__}", own)]
    members = ghost.create_publisher(Member, "/members", latched_qos(10))
    states = ghost.create_publisher(CellState, "/cell_state", latched_qos(10))
    progress = ghost.create_publisher(Progress, "/progress", latched_qos(10))
    joints = ghost.create_publisher(JointState, "/electrodynamic_actuator/joint_states", latched_qos(10))
    sends += [
        (members, Member(run_id="elsewhere", name="/tool", state=Member.FAILED, message="no")),
        (members, Member(run_id="test", name="/made_up", publishes=["/a"])),
        (members, Member(run_id="test", name="/made_up", publishes=["/a"], types=["a/b/c"], sparse=[False])),
        (members, Member(run_id="test", name="/usurper", members=["/usurper"], parameters="{}")),
        (members, b"\0\1\0\0" + b"\xff" * 100),
        (states, CellState(run_id="x", state=CellState.FAILED)),
        (progress, Progress(run_id="x", name="/tool", blocks=2**40)),
        (progress, Progress(run_id="test", name="/made_up", blocks=2**40)),
        *((joints, joint_state(sample)) for sample in range(100, 46_080, 4_000)),
    ]
    expected = set.union(*(senders(topic, own) for topic, (_, own) in on.items())) | {
        "/electrodynamic_actuator of run 'test' on /electrodynamic_actuator/joint_states",
        "/tool of run 'elsewhere' on /members",
        "/haunted/ghost of run 'test' on /members",
        "an unknown sender of run 'x' on /cell_state",
        "/tool of run 'x' on /progress",
    }
    recorded = harness.with_recorder(cell, tmp_path / "bag", keep=True)
    nodes = [[name] for name in recorded.nodes]
    with all_the_time(sends), harness.Processes(recorded, nodes, domain=domain) as processes:
        seen = Seen(processes)
        seen.wait_for("cycle")
        os.kill(processes.pids["electrodynamic_actuator"], signal.SIGSTOP)  # the cell waits until all are refused
        seen.until(lambda events: expected <= {refused_by_a_node(event) for event in events})
        os.kill(processes.pids["electrodynamic_actuator"], signal.SIGCONT)
        processes.wait_for_end()
    assert reader.read_bag(tmp_path / "bag").digests() == harness.run(cell).digest
    assert expected <= set(processes.refused)
    values = {pair.key: pair.value for pair in diagnostics(tmp_path / "bag")["/learning_controller"].values}
    assert "from /nan of run 'test' on /tool" in values["refused"]
    assert "/haunted/ghost" in values["publishers of /tool"]


@pytest.mark.system
def test_a_cell_begins_in_a_flood_of_announcements(ghost, domain, tmp_path):
    """A cell begins in a flood that pushes its own announcements out of the readers of nodes that start."""
    sends = [(ghost.create_publisher(Member, "/members", latched_qos(10)), Member(run_id="elsewhere", name="/x"))]
    cell = scenario(spindle_encoder={"revolutions": 2.0})
    recorded = harness.with_recorder(cell, tmp_path / "bag", keep=True)

    def in_the_flood(events):
        return {each["node"] for each in events if refused_by_a_node(each)} >= recorded.nodes.keys() - {"recorder"}

    with all_the_time(sends, pause=0.0005), held(recorded, domain) as (processes, begin):
        Seen(processes).until(in_the_flood)
        begin()
        processes.wait_for_end()
    assert reader.read_bag(tmp_path / "bag").digests() == harness.run(cell).digest
    assert processes.refused["/x of run 'elsewhere' on /members"] > 256


@pytest.mark.system
def test_nobody_speaks_in_the_name_of_a_member(ghost, domain, tmp_path):
    """A block, announcement, state, progress or joint state is from the node that DDS names, or it is refused."""
    # Long enough for all nodes to discover all publishers of the ghost while other tests keep the machine busy.
    cell = scenario(spindle_encoder={"revolutions": 24.0, "speed_factor": 0.2})
    joints = [(sample, joint_state(sample)) for sample in range(0, 92_160, 640)]
    forged = {
        "/members": (Member, [Member(run_id="test", name="/tool", state=Member.FAILED, message="no")]),
        "/cell_state": (
            CellState,
            [CellState(run_id="test", state=CellState.SAFE, lost=["/tool"]), CellState(run_id="test", state=77)],
        ),
        "/progress": (Progress, [Progress(run_id="test", name="/tool", blocks=2**40)]),
        "/electrodynamic_actuator/joint_states": (JointState, [message for _, message in joints]),
        "/tool": (ToolBlock, [block(messages.TOOL, first, "/tool", "test") for first in range(0, 92_160, 64)]),
    }
    sends = []
    for topic, (kind, those) in forged.items():
        publisher = ghost.create_publisher(kind, topic, latched_qos(10))
        sends += [(publisher, each) for each in those]
    recorded = harness.with_recorder(cell, tmp_path / "bag", keep=True)
    nodes = [[name] for name in recorded.nodes]
    with all_the_time(sends, 0.001), harness.Processes(recorded, nodes, domain=domain) as processes:
        processes.wait_for_end()
    assert reader.read_bag(tmp_path / "bag").digests() == harness.run(cell).digest
    on = {sender.rpartition(" on ")[2] for sender in processes.refused}
    assert on >= forged.keys(), processes.refused
