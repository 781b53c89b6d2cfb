# SPDX-License-Identifier: Apache-2.0
"""Accidents beside a running cell and in its first moments, with real nodes; simulation.py plays them at any."""

import os
import signal
import subprocess
import sys

import pytest
from cells import Seen, all_but, held, scenario, until

pytest.importorskip("rclpy")

import rclpy
from lathe_rc_msgs.msg import CellState, Member, SafetyStatus, ToolBlock
from lifecycle_msgs.msg import Transition
from rclpy.executors import SingleThreadedExecutor
from test_lifecycle import Manager

from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.blocks.ports import signal_depth
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import LatheError
from lathe_rc.nodes.ports import latched_qos

#: keeps all messages, takes none, until its input is closed
DEAF = """
import rclpy, sys
from lathe_rc_msgs.msg import ToolBlock
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile
rclpy.init()
qos = QoSProfile(history=HistoryPolicy.KEEP_ALL, durability=DurabilityPolicy.TRANSIENT_LOCAL)
subscription = rclpy.create_node("deaf").create_subscription(ToolBlock, "/tool", print, qos)
while not subscription.get_publisher_count():
    pass
print("matched", flush=True)
sys.stdin.read()
"""
STRANGERS = [
    "/members: message of run 'test' from /second_spindle; the time master is /spindle_encoder",
    "/tool: message of run '' from /haunted/ghost; a publisher offers a quality of service that does not fit",
]
REFUSED = {
    "tool": "/tool: process {tool} has this name already; give this node another one",
    "second_recorder": "/second_recorder: the cell is running already; start a recorder before it, or use lathe record",
}


def beside(cell: Scenario, bag) -> Scenario:
    """Nodes that are started beside a cell: one with a member's name, a second spindle and a second recorder."""
    spindle, recorder = ({"stage": kind} for kind in ("spindle_encoder", "recorder"))
    return Scenario(
        "beside",
        {
            "tool": cell.nodes["tool"],
            "second_spindle": cell.nodes["spindle_encoder"].model_copy(update=spindle),
            "second_recorder": cell.nodes["recorder"].model_copy(update={**recorder, "bag": str(bag)}),
        },
    )


def refuses(event, text):
    return event["event"] == "foreign_message" and event["message"].startswith(text)


@pytest.mark.system
def test_a_running_cell_survives_what_is_started_beside_it(ghost, domain, tmp_path):
    """Listeners, deaf ones too, a default publisher, a namesake, a late recorder and a second spindle change no bit.

    The newcomers refuse themselves in one line; a late reader learns the state of the cell and its members.
    """
    watched = {"error_limit": 1e-12, "error_after": 0.0, "error_reaction": "warn"}
    cell = scenario(spindle_encoder={"revolutions": 60.0, "speed_factor": 1.0}, supervisor=watched)
    recorded = harness.with_recorder(cell, tmp_path / "bag", keep=True)
    full = 2 * signal_depth(cell.shared.window) * cell.shared.block_size  # more samples than a queue holds
    manager, heard = Manager(ghost), {}
    deaf, pipes, blocks = [sys.executable, "-c", DEAF], dict.fromkeys(("stdin", "stdout"), subprocess.PIPE), []
    ear = ghost.create_subscription(ToolBlock, "/tool", blocks.append, 10)
    with held(recorded, domain) as (processes, begin), subprocess.Popen(deaf, **pipes) as listener:
        manager.processes, seen = processes, Seen(processes)
        assert listener.stdout.readline() == b"matched\n"
        until(ear.get_publisher_count)
        assert not manager.change("electrodynamic_actuator", Transition.TRANSITION_ACTIVATE), "from now on it answers"
        begin()
        until(lambda: blocks and blocks[-1].block.first_index > full, lambda: rclpy.spin_once(ghost, timeout_sec=1.0))
        listener.kill()
        assert manager.change("electrodynamic_actuator", Transition.TRANSITION_DEACTIVATE)  # the cell waits for it
        ghost.create_publisher(ToolBlock, "/tool", 10)  # as ``ros2 topic pub`` does
        newcomers = beside(recorded, tmp_path / "late")
        with harness.Processes(newcomers, [[name] for name in REFUSED], domain=domain) as others:
            said, events = {}, others.events(60.0)
            while said.keys() < REFUSED.keys():
                event = next(events)
                said |= {event["node"]: event["message"]} if event["event"] == "error" else {}
            others._start(["second_spindle"])
            seen.until(lambda events: all(any(refuses(event, text) for event in events) for text in STRANGERS))
        ghost.create_subscription(CellState, "/cell_state", lambda told: heard.update(state=told), latched_qos(1))
        ghost.create_subscription(Member, "/members", lambda told: heard.update({told.name: told}), latched_qos(256))
        ghost.create_subscription(SafetyStatus, "/safety/status", lambda told: heard.update(alarm=told), latched_qos(1))
        executor = SingleThreadedExecutor()
        executor.add_node(ghost)
        late = {"state", "alarm", *(f"/{name}" for name in recorded.nodes)}
        until(lambda: heard.keys() >= late, lambda: executor.spin_once(timeout_sec=1.0))
        executor.shutdown()
        assert manager.change("electrodynamic_actuator", Transition.TRANSITION_ACTIVATE)
        processes.wait_for_end()
    assert said == {name: text.format(tool=processes.pids["tool"]) for name, text in REFUSED.items()}
    assert (heard["state"].run_id, heard["state"].state) == ("test", CellState.RUNNING)
    assert (heard["alarm"].source, heard["alarm"].monitor, heard["alarm"].subject) == ("/supervisor", "error", "tool")
    assert all(heard[f"/{name}"].state == Member.READY for name in recorded.nodes)
    assert reader.read_bag(tmp_path / "bag").digests() == harness.run(cell).digest


@pytest.mark.parametrize(
    ("node", "number", "at"),
    [("tool", signal.SIGTERM, None), ("recorder", signal.SIGINT, "active")],
    ids=["as it starts", "as it waits"],
)
def test_a_member_that_is_ended_before_the_run_is_named_and_the_others_end(node, number, at, tmp_path):
    """A signal may come before the process handles signals, and before its node has heard of the cell."""
    cell = harness.with_recorder(scenario(), tmp_path / "bag", keep=True)
    with harness.Processes(cell, all_but(cell, node)) as processes:
        if at:
            processes.wait_for(at, node)
        os.kill(processes.pids[node], number)
        with pytest.raises(LatheError, match=f"{node} was (ended|killed) by {number.name}"):
            processes.wait_for_end()
