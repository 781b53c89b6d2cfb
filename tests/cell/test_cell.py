# SPDX-License-Identifier: Apache-2.0
"""One law, many hosts: real processes over real DDS give the bits of the offline engine."""

import os
import signal
from pathlib import Path

import pytest
import rclpy
from cells import PATIENCE, Seen, all_but, until
from lathe_rc_msgs.srv import Schedule
from rosbags.highlevel import AnyReader

from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.bag.repairing import recover
from lathe_rc.cell.scenario import load

PISTON = Path(__file__).parents[2] / "config" / "piston.yaml"
SHORT = ["spindle_encoder.revolutions=6.0", "learning_controller.events=['revolution 4: freeze']"]
SIGNALS = ("EncoderBlock", "ActuatorCommand", "ActuatorState", "ToolBlock", "LearningStatus", "Event", "JointState")


def piston(*overrides: str):
    return load(PISTON, [*SHORT, *overrides])


@pytest.fixture(scope="module")
def offline() -> dict[str, str]:
    return harness.run(piston()).digest


def signal_messages(bag: Path) -> list[tuple[str, int, bytes]]:
    with AnyReader([bag]) as bags:
        return [
            (connection.topic, stamp, bytes(data))
            for connection, stamp, data in bags.messages()
            if connection.msgtype.rpartition("/")[2] in SIGNALS
        ]


#: mode, overrides and groups of processes; blocks of any length offline: test_engine.py
HOSTS = {
    "composed": ("composed", ["block_size=256", "window=1"], None),
    "processes": ("processes", ["block_size=32", "spindle_encoder.speed_factor=1.0"], [["recorder", "tool"]]),
}


@pytest.mark.parametrize(("mode", "overrides", "groups"), HOSTS.values(), ids=HOSTS)
def test_host_block_size_window_pace_and_grouping_change_no_bit(offline, tmp_path, mode, overrides, groups):
    result = harness.run(piston(*overrides), mode=mode, groups=groups, bag=tmp_path / "bag")
    assert result.digest == offline
    if groups:
        assert harness.run(piston("block_size=32"), bag=tmp_path / "offline").digest == offline
        found = signal_messages(tmp_path / "bag")
        assert found == signal_messages(tmp_path / "offline"), "messages and their order in the bag"
        assert [stamp for _, stamp, _ in found] == sorted(stamp for _, stamp, _ in found)
    paced = "spindle_encoder.speed_factor=1.0" in overrides
    assert (result.lateness is not None) == paced
    assert not paced or result.real_time_factor <= 1.0


def test_a_stopped_process_changes_no_bit(offline, tmp_path):
    nodes, stopped = ["tool", "recorder", "spindle_encoder"], piston("spindle_encoder.speed_factor=0.2")
    cell = harness.with_recorder(stopped, tmp_path / "bag", keep=True)
    with harness.Processes(cell, all_but(cell, *nodes)) as processes:
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


@pytest.mark.system
def test_the_graph_forgets_who_is_killed_or_stopped_for_long_and_the_stopped_one_goes_on(
    offline, ghost, domain, tmp_path
):
    """A process that the others have dropped, since it was stopped for more than 10 s, goes on without another bit."""

    def wait_until_gone(name):
        until(lambda: name not in ghost.get_node_names())

    cell = harness.with_recorder(piston("spindle_encoder.speed_factor=0.2"), tmp_path / "bag", keep=True)
    with harness.Processes(cell, [[name] for name in cell.nodes], domain=domain) as processes:
        processes.wait_for("cycle")
        os.kill(processes.pids["tool"], signal.SIGSTOP)
        wait_until_gone("tool")
        os.kill(processes.pids["tool"], signal.SIGCONT)
        processes.wait_for_end()
    assert reader.read_bag(tmp_path / "bag").digests() == offline
    with harness.Processes(cell, [["spindle_encoder"]], domain=domain) as processes:
        processes.wait_for("active")
        until(lambda: "spindle_encoder" in ghost.get_node_names())
        os.kill(processes.pids["spindle_encoder"], signal.SIGKILL)
        wait_until_gone("spindle_encoder")


def test_events_by_service_are_recorded_at_the_index_that_was_promised(ghost, domain, tmp_path):
    slow = load(PISTON, ["spindle_encoder.revolutions=1e4", "spindle_encoder.speed_factor=0.5", "allow_faults=true"])
    cell = harness.with_recorder(slow, tmp_path / "bag", keep=True)
    done = ["freeze", "fault tool.measured_error noisy rms=1e-7", "repair tool.measured_error"]

    def schedule(node, *actions):
        client = ghost.create_client(Schedule, f"/{node}/schedule")
        assert client.wait_for_service(20.0)
        for action in actions:
            future = client.call_async(Schedule.Request(action=action, not_before=15000))
            rclpy.spin_until_future_complete(ghost, future, timeout_sec=PATIENCE)
            yield future.result()

    with harness.Processes(cell, all_but(cell, "recorder"), domain=domain) as processes:
        processes.wait_for("cycle")
        *accepted, unknown, wrong = schedule("learning_controller", *done, "jump", "fault tool off")
        (of_another,) = schedule("tool", "freeze")
        promised = [answer.sample_index for answer in accepted]
        # Until all members have computed and recorded what was promised.
        while processes.wait_for("progress")["samples"] <= max(promised):
            pass
    recover.mend(tmp_path / "bag")
    assert of_another.message == "tool: event 'freeze'; allowed: none (tool has no events)"
    assert [answer.accepted for answer in (*accepted, unknown, wrong)] == [True] * 3 + [False] * 2
    assert min(promised) >= 15000
    assert "allowed: freeze, learn, clear" in unknown.message
    assert unknown.sample_index == 0
    assert "no such target for it; allowed for off: " in wrong.message
    events = reader.read_bag(tmp_path / "bag").sparse["/learning_controller/events"]
    assert events.values["action"] == done
    assert events.values["sample_index"] == promised
