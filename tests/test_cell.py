# SPDX-License-Identifier: Apache-2.0
"""One law, many hosts: real processes over real DDS give the bits of the offline engine."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import rclpy
from cells import Seen, held
from lathe_rc_msgs.srv import Schedule
from rosbags.highlevel import AnyReader

from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.bag.repairing import recover
from lathe_rc.cell.scenario import load

PISTON = Path(__file__).parents[1] / "config" / "piston.yaml"
SHORT = ["spindle_encoder.revolutions=6.0", "learning_controller.events=['revolution 4: freeze']"]
SIGNALS = ("EncoderBlock", "ActuatorCommand", "ActuatorState", "ToolBlock", "LearningStatus", "Event", "JointState")


def piston(*overrides: str):
    return load(PISTON, [*SHORT, *overrides])


@pytest.fixture(scope="module")
def offline() -> dict[str, str]:
    return harness.run(piston()).digest


# Blocks of 64: offline in the fixture, composed and in processes below.
HOSTS = [("offline", 32), ("offline", 256), ("composed", 256), ("processes", 32)]


@pytest.mark.parametrize(("mode", "block_size"), HOSTS)
def test_every_host_and_block_size_gives_the_same_bits(offline, mode, block_size):
    assert harness.run(piston(f"block_size={block_size}"), mode=mode).digest == offline


@pytest.mark.parametrize(
    "groups",
    [
        [["spindle_encoder", "tool"], ["learning_controller", "electrodynamic_actuator"]],
        [["recorder", "spindle_encoder", "tool"]],
    ],
)
def test_grouping_changes_no_bit(offline, groups):
    assert harness.run(piston(), mode="processes", groups=groups).digest == offline


def test_pace_changes_no_bit(offline):
    result = harness.run(piston("spindle_encoder.speed_factor=1.0"), mode="processes")
    assert result.digest == offline
    assert result.real_time_factor <= 1.0


@pytest.mark.parametrize("window", [1, 500])
def test_window_changes_no_bit(offline, window):
    assert harness.run(piston(f"window={window}"), mode="composed").digest == offline


# The largest window is longer than the run: nobody waits, and still the stopped one is named before the end.
@pytest.mark.parametrize(("nodes", "window"), [(["tool", "recorder", "spindle_encoder"], 64), (["tool"], 4096)])
def test_a_stopped_process_changes_no_bit(offline, nodes, window, tmp_path):
    stopped = piston("spindle_encoder.speed_factor=0.2", f"window={window}")
    cell = harness.with_recorder(stopped, tmp_path / "bag", keep=True)
    with harness.Processes(cell, [[name] for name in cell.nodes]) as processes:
        seen = Seen(processes)
        seen.wait_for("cycle")
        for node in nodes:
            os.kill(processes.pids[node], signal.SIGSTOP)
            # The spindle names the silent one, and the others the spindle, whomever else a busy machine delays; only
            # then does it go on.
            seen.wait_for("stall", member=f"/{node}")
            os.kill(processes.pids[node], signal.SIGCONT)
        processes.wait_for_end()
    assert reader.read_bag(tmp_path / "bag").digests() == offline


STRANGER = """
import sys, rclpy
from rclpy.node import Node
from lathe_rc_msgs.msg import EncoderBlock, ToolBlock
rclpy.init()
node = Node("stranger")
heard = []
ears = [
    node.create_subscription(EncoderBlock, "encoder", lambda m: None, 10),
    node.create_subscription(ToolBlock, "tool", heard.append, 10),
]
print("there", flush=True)
while not all(ear.get_publisher_count() for ear in ears):
    rclpy.spin_once(node, timeout_sec=0.02)
print("matched", flush=True)
while not heard:
    rclpy.spin_once(node, timeout_sec=0.1)
print("heard", flush=True)
rclpy.spin(node)
"""


def test_a_stranger_that_listens_from_the_start_changes_no_bit(offline, tmp_path):
    cell = harness.with_recorder(piston("spindle_encoder.speed_factor=0.5"), tmp_path / "bag", keep=True)
    with harness.free_domain() as domain:
        environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_LOG_DIR": str(tmp_path),
        }
        with subprocess.Popen([sys.executable, "-c", STRANGER], env=environment, stdout=subprocess.PIPE) as stranger:
            try:
                assert stranger.stdout.readline() == b"there\n"
                with held(cell, domain) as (processes, begin):
                    assert stranger.stdout.readline() == b"matched\n"
                    begin()
                    processes.wait_for_end()
                assert stranger.stdout.readline() == b"heard\n"
            finally:
                stranger.kill()
    assert reader.read_bag(tmp_path / "bag").digests() == offline


def signal_messages(bag: Path) -> list[tuple[str, int, bytes]]:
    with AnyReader([bag]) as bags:
        return [
            (connection.topic, stamp, bytes(data))
            for connection, stamp, data in bags.messages()
            if connection.msgtype.rpartition("/")[2] in SIGNALS
        ]


def test_bags_of_two_process_runs_and_of_an_offline_run_hold_the_same_messages(offline, tmp_path):
    for name, mode in (("a", "processes"), ("b", "processes"), ("c", "offline")):
        assert harness.run(piston(), mode=mode, bag=tmp_path / name).digest == offline
    first = signal_messages(tmp_path / "a")
    assert first == signal_messages(tmp_path / "b")
    assert first == signal_messages(tmp_path / "c")
    order = [(stamp, topic) for topic, stamp, _ in first]
    assert order == sorted(order)


def test_events_by_service_are_recorded_at_the_index_that_was_promised(ghost, domain, tmp_path):
    slow = load(PISTON, ["spindle_encoder.revolutions=1e4", "spindle_encoder.speed_factor=0.5", "allow_faults=true"])
    cell = harness.with_recorder(slow, tmp_path / "bag", keep=True)
    asked = [
        "freeze",
        "fault tool.measured_error noisy rms=1e-7",
        "repair tool.measured_error",
        "jump",
        "fault tool off",
    ]
    client, answers = ghost.create_client(Schedule, "/learning_controller/schedule"), []
    of_another = ghost.create_client(Schedule, "/tool/schedule")
    with harness.Processes(cell, [[name] for name in cell.nodes], domain=domain) as processes:
        processes.wait_for("cycle")
        assert client.wait_for_service(20.0)
        for action in asked:
            future = client.call_async(Schedule.Request(action=action, not_before=15000))
            rclpy.spin_until_future_complete(ghost, future)
            answers.append(future.result())
        assert of_another.wait_for_service(20.0)
        future = of_another.call_async(Schedule.Request(action="freeze"))
        rclpy.spin_until_future_complete(ghost, future)
        # Until all members have computed and recorded what was promised.
        while processes.wait_for("progress")["samples"] <= max(answer.sample_index for answer in answers):
            pass
    recover.mend(tmp_path / "bag")
    assert future.result().message == "tool: event 'freeze'; allowed: none (tool has no events)"
    promised = [answer.sample_index for answer in answers[:3]]
    assert [answer.accepted for answer in answers] == [True] * 3 + [False] * 2
    assert min(promised) >= 15000
    assert "allowed: freeze, learn, clear" in answers[3].message
    assert answers[3].sample_index == 0
    assert "no such target for it; allowed for off: " in answers[4].message
    events = reader.read_bag(tmp_path / "bag").sparse["/learning_controller/events"]
    assert events.values["action"] == asked[:3]
    assert events.values["sample_index"] == promised
