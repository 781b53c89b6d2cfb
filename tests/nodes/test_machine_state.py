# SPDX-License-Identifier: Apache-2.0
"""Standard messages of a cell: joints and force at their samples, the picture of the lathe, nobody is delayed."""

import itertools
import threading
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")

import rclpy
from cells import config, until
from geometry_msgs.msg import WrenchStamped
from numpy.testing import assert_allclose
from sensor_msgs.msg import JointState

from lathe_rc import harness, messages
from lathe_rc.bag import reader
from lathe_rc.blocks.block import Block
from lathe_rc.cell.beside import MachineStateParameters
from lathe_rc.nodes.machine_state import MachineState
from lathe_rc.view.machine_state import BED, EDGE, JOINTS, Force, Joints, Machine, source

URDF = Path(__file__).parents[2] / "urdf" / "lathe.urdf"
STEP_NS, PERIOD = 15625, 1280  # of 50 messages a second


@pytest.fixture(scope="module")
def turned():
    """A short run of the whole lathe, and what its topics tell about the machine."""
    result = harness.run(config("full_cell", "spindle_encoder.revolutions=3.0"))
    types = {topic: kind for topic, kind in result.recording.types.items() if kind in messages.block_types()}
    told = {topic: origin for topic, kind in types.items() if (origin := source(topic, kind))}
    return result, told


def blocks(signals, size):
    samples = next(iter(signals.values())).size
    for first in range(0, samples, size):
        cut = {name: array[first : first + size] for name, array in signals.items()}
        yield Block("run", "", first, STEP_NS, first + size >= samples, 0, min(size, samples - first), 0, cut)


def assembled(result, told, size, lost=()):
    """Joints and forces from blocks in rounds, without the lost ones."""
    machine = Machine(50.0)
    machine.sources = set(told.values()) - {"cut"}
    streams = {topic: list(blocks(result.recording.dense[topic], size)) for topic in sorted(told)}
    found = []
    for number in range(max(map(len, streams.values()))):
        for topic, stream in streams.items():
            if (topic, number) not in lost:
                found += machine.take(told[topic], stream[number])
    return machine, found


def test_joints_and_force_are_the_samples_of_the_cell(turned):
    """The joints have the signs of the picture, velocities in SI units, and no sample that is not in the signals."""
    result, told = turned
    assert sorted(told.values()) == ["cross", "cut", "encoder", "longitudinal", "tool"]
    dense = {origin: result.recording.dense[topic] for topic, origin in told.items()}
    (_, found), (_, of_others) = (assembled(result, told, size) for size in (64, 1000))
    assert found == sorted(of_others, key=lambda each: (each.sample, isinstance(each, Joints)))
    joints, forces = ([each for each in found if isinstance(each, kind)] for kind in (Joints, Force))
    at = np.arange(0, result.samples, PERIOD)
    assert [each.sample for each in joints] == [each.sample for each in forces] == at.tolist()
    position, velocity = (dict(zip(JOINTS, np.transpose(list(each)), strict=True)) for each in (
        [each.position for each in joints], [each.velocity for each in joints]
    ))  # fmt: skip
    assert (position["spindle"] == dense["encoder"]["angle"][at]).all()
    assert (position["tool"] == dense["tool"]["displacement"][at]).all()
    assert (position["z"] == dense["longitudinal"]["position"][at]).all()
    assert (position["x"] == -dense["cross"]["position"][at]).all()
    assert (velocity["x"] == -dense["cross"]["velocity"][at]).all()
    moved = np.diff(dense["tool"]["displacement"])[at[1:] - 1] / (STEP_NS * 1e-9)
    assert_allclose(velocity["tool"], [0.0, *moved], rtol=1e-9, atol=1e-12)
    assert [each.newton for each in forces] == dense["cut"]["measured_force"][at].tolist()


def test_an_instant_that_lacks_a_block_is_left_out(turned):
    result, told = turned
    lost = {("/tool", 2 * PERIOD // 64), ("/encoder", 4 * PERIOD // 64), ("/tool", 6 * PERIOD // 64 - 1)}
    machine, found = assembled(result, told, 64, lost)
    missing = set(range(0, result.samples, PERIOD)) - {each.sample for each in found if isinstance(each, Joints)}
    assert missing == {2 * PERIOD, 4 * PERIOD, 6 * PERIOD}, "the last one lacks the sample before it"
    assert machine.left_out == 3


def test_the_picture_of_the_lathe_moves_as_the_joints_say():
    """Rerun reads it as robot_state_publisher does: edge and part are where the joints put them."""
    urdf = pytest.importorskip("rerun.urdf")
    tree = urdf.UrdfTree.from_file_path(URDF)
    assert tree.root_link().name == BED
    values = dict(zip(JOINTS, (0.3, 0.04, 0.002, 3e-4), strict=True))
    joints = {joint.name: joint for joint in tree.joints()}
    assert joints.keys() == values.keys()
    assert {name: joint.joint_type for name, joint in joints.items()} == {"spindle": "continuous"} | dict.fromkeys(
        ("z", "x", "tool"), "prismatic"
    )
    place, link = np.zeros(3), EDGE
    parents = {joint.child_link: joint for joint in joints.values()}
    while link != BED:
        joint = parents[link]
        place += joint.compute_transform(values[joint.name], clamp=False).translation.as_arrow_array().to_pylist()[0]
        link = joint.parent_link
    assert_allclose(place, [0.05 + 0.002 + 3e-4, 0.0, 0.04], atol=1e-12)
    assert joints["spindle"].axis == (0.0, 0.0, 1.0)


def test_the_node_publishes_the_joints_and_the_force_of_a_running_cell(turned, ghost, domain, tmp_path):
    """It reads the cell from outside: the run has the digest of one without it."""
    slow = config("full_cell", "spindle_encoder.revolutions=3.0", "spindle_encoder.speed_factor=0.2")
    cell = harness.with_recorder(slow, tmp_path / "bag", keep=True)
    node = rclpy.create_node("machine_state")
    machine = MachineState(node, MachineStateParameters(frame_prefix="left/"))
    ears = [
        ghost.create_subscription(kind, topic, print, 1000)
        for topic, kind in (("/joint_states", JointState), ("/wrench", WrenchStamped))
    ]
    work = threading.Thread(target=machine.run)
    work.start()
    try:
        with harness.Processes(cell, [[name for name in cell.nodes if name != "recorder"]], domain=domain) as processes:
            until(lambda: sum(inlet.get_publisher_count() for inlet, _, _ in list(machine.inlets.values())) >= 5)
            processes._start(["recorder"])
            processes.wait_for_end()
    finally:
        machine.stopped.set()
        work.join()
    assert all(publisher.wait_for_all_acked() for publisher in (machine.joints, machine.wrench))
    joints, forces = ([*iter(lambda ear=ear: ear.handle.take_message(ear.msg_type, ear.raw), None)] for ear in ears)
    node.destroy_node()
    assert reader.read_bag(tmp_path / "bag").digests() == turned[0].digest
    assert len(joints) >= 5, "of nine; a block that a busy machine loses is not sent again"
    assert len(forces) >= 5
    dense = turned[0].recording.dense
    for (joint, _), (force, _) in itertools.product(joints, forces):
        at, when = ((messages.stamp_ns(each) - messages.START_NS) // STEP_NS for each in (joint, force))
        assert (at % PERIOD, when % PERIOD) == (0, 0)
        assert (joint.header.frame_id, joint.name) == (f"left/{BED}", list(JOINTS))
        assert joint.position[0] == dense["/encoder"]["angle"][at]
        assert joint.position[3] == dense["/tool"]["displacement"][at]
        assert (force.header.frame_id, force.wrench.force.y) == (f"left/{EDGE}", dense["/cut"]["measured_force"][when])
