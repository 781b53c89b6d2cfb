# SPDX-License-Identifier: Apache-2.0
"""Every transition of a node's lifecycle, and what a node says that waits."""

import contextlib
import os
import signal
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
from cells import Seen, scenario, until

pytest.importorskip("rclpy")

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.lifecycle import TransitionCallbackReturn

from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.messages import ALIVE
from lathe_rc.nodes import cell_node
from lathe_rc.nodes.cell_node import CellNode
from lathe_rc.nodes.liveliness import has_ended, this_host
from lathe_rc.nodes.report import Reporter
from lathe_rc.nodes.stage_role import StageRole
from lathe_rc.protocol import Announcement
from lathe_rc.protocol.exchange import Exchange

WALK = [  # transition, whether it is possible, and where the node is then
    (Transition.TRANSITION_ACTIVATE, False, "active"),
    (Transition.TRANSITION_CLEANUP, False, "active"),
    (Transition.TRANSITION_DEACTIVATE, True, "inactive"),
    (Transition.TRANSITION_CONFIGURE, False, "inactive"),
    (Transition.TRANSITION_ACTIVATE, True, "active"),
    (Transition.TRANSITION_DEACTIVATE, True, "inactive"),
    (Transition.TRANSITION_CLEANUP, True, "unconfigured"),
    (Transition.TRANSITION_ACTIVATE, False, "unconfigured"),
    (Transition.TRANSITION_CONFIGURE, True, "inactive"),
    (Transition.TRANSITION_CLEANUP, True, "unconfigured"),
    (Transition.TRANSITION_CONFIGURE, True, "inactive"),
    (Transition.TRANSITION_ACTIVATE, True, "active"),
]
LOGGED = [
    *("unconfigured -> inactive", "inactive -> active", "active -> inactive", "inactive -> active"),
    *("active -> inactive", "inactive -> unconfigured", "unconfigured -> inactive", "inactive -> unconfigured"),
    *("unconfigured -> inactive", "inactive -> active"),
]
LAST = "electrodynamic_actuator"  # is told to start by the tests


class Manager:
    """Asks nodes for transitions, as ``ros2 lifecycle`` does."""

    def __init__(self, ghost):
        self._ghost, self._clients = ghost, {}
        self.processes = None  # of the cell, once there are any

    def _ask(self, service, kind, request):
        if service not in self._clients:
            client = self._clients[service] = self._ghost.create_client(kind, service)
            assert client.wait_for_service(60.0)
            # A node that has not discovered yet who asks cannot answer: ask until it does what changes nothing.
            nothing = GetState.Request() if kind is GetState else ChangeState.Request(transition=Transition(id=255))
            until(lambda: self._answer(client, nothing, 0.5) is not None)
        answer = self._answer(self._clients[service], request, 60.0)
        assert answer is not None, f"{service} does not answer{self._place_of(service.split('/')[1])}"
        return answer

    def _place_of(self, node):
        child = next((child for child in self.processes._children if node in child.split("+")), None)
        if not child:
            return ""
        place, code = self.processes._place(child), self.processes._children[child].poll()
        said = "\n".join(self.processes._log(child))
        return f"; {child} {'stands' if code is None else f'has ended with {code}'}{place}; it said:\n{said}"

    def _answer(self, client, request, seconds):
        future = client.call_async(request)
        rclpy.spin_until_future_complete(self._ghost, future, timeout_sec=seconds)
        return future.result()

    def change(self, node, transition):
        """Ask for a transition; returns whether it was made."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return self._ask(f"/{node}/change_state", ChangeState, request).success

    def state(self, node):
        return self._ask(f"/{node}/get_state", GetState, GetState.Request()).current_state.label


@pytest.fixture
def manager(ghost):
    return Manager(ghost)


@contextlib.contextmanager
def waiting(manager, domain, cell, together=()):
    """The processes of a cell that waits for its drive, and what lets that start."""
    groups = [list(together), *([name] for name in cell.nodes if name not in together)]
    with harness.Processes(cell, [group for group in groups if group], domain=domain) as processes:
        manager.processes = processes

        def begin():
            assert manager.change(LAST, Transition.TRANSITION_CONFIGURE)
            assert manager.change(LAST, Transition.TRANSITION_ACTIVATE)

        yield processes, begin


def test_the_whole_state_machine_is_walked_and_the_cell_gives_its_bits(manager, domain, tmp_path):
    """A node takes every transition before the run, stands still in its middle, and no bit of the run is changed."""
    nodes, together = ["spindle_encoder", "recorder", "tool"], ("learning_controller", "tool")
    alone = scenario(spindle_encoder={"speed_factor": 0.1}, electrodynamic_actuator={"autostart": False})
    cell = harness.with_recorder(alone, tmp_path / "bag", keep=True)
    with waiting(manager, domain, cell, together) as (processes, begin):
        seen = Seen(processes)
        for node in nodes:  # once its services answer, it is there
            until(lambda node=node: manager.state(node) == "active")
            for transition, possible, then in WALK:
                assert (manager.change(node, transition), manager.state(node)) == (possible, then)
        begin()
        seen.wait_for("progress")
        for node in nodes:
            assert manager.change(node, Transition.TRANSITION_DEACTIVATE)
            if node != "spindle_encoder":
                seen.wait_for("stall", member=f"/{node}")
            assert (manager.change(node, Transition.TRANSITION_CLEANUP), manager.state(node)) == (False, "inactive")
            assert manager.change(node, Transition.TRANSITION_ACTIVATE)
        processes.wait_for_end()
        said = {node: processes._log("+".join(together) if node in together else node) for node in nodes}
    for node, lines in said.items():
        found = [line.rpartition("]: ")[2] for line in lines if f"[{node}]" in line and " -> " in line]
        assert found == [*LOGGED, "active -> inactive", "inactive -> active"]
    assert reader.read_bag(tmp_path / "bag").digests() == harness.run(alone).digest


def test_a_waiting_cell_names_a_misspelt_member_and_a_node_that_is_shut_down_leaves_it(manager, domain, tmp_path):
    """Each member says for which nodes it waits, and which node of nearly that name is there."""
    cell = harness.with_recorder(scenario(electrodynamic_actuator={"autostart": False}), tmp_path / "bag", keep=True)
    misspelt = ["tol" if name == "tool" else name for name in cell.nodes["spindle_encoder"].members]
    cell.nodes["spindle_encoder"] = cell.nodes["spindle_encoder"].model_copy(update={"members": misspelt})
    with waiting(manager, domain, cell) as (processes, _):
        missing = processes.wait_for("waits", "spindle_encoder")["missing"]
        assert missing[:2] == [f"/{LAST}", "/tol (/tool is there)"]
        assert manager.change("learning_controller", Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert processes.wait_for("exit", "learning_controller")["code"] == 0
        said = [line for line in processes._log("spindle_encoder") if "waits for " in line]
        assert any(f"/{LAST}" in line and "(/tool is there)" in line for line in said)


@pytest.fixture
def tool(ghost):
    """A tool that has been activated in this process."""
    node = CellNode("tool", "tool", StageRole, Reporter(), Exchange())
    assert node.trigger_configure() == node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    yield node
    node.destroy_node()


def test_a_member_that_is_stopped_is_silent_whatever_dds_says_of_it(tool):
    """Fast DDS takes it for alive for ever if its last sign of life comes when its lease runs out."""
    watch = tool.watch
    with subprocess.Popen(["/bin/sleep", "1000"]) as child:
        watch.follow(Announcement("", "/stopped", "tool", pid=child.pid, host=this_host()))
        for number, change, silent in (
            (signal.SIGSTOP, os.WSTOPPED, ["/stopped"]),
            (signal.SIGCONT, os.WCONTINUED, []),
        ):
            child.send_signal(number)
            os.waitid(os.P_PID, child.pid, change)
            watch.look()
            assert list(watch.silent) == silent
        child.kill()


def status(signs):
    with signs:
        return signs.take_event()


def test_a_member_of_another_machine_is_silent_when_its_lease_has_run_out(tool):
    """Its liveliness is polled, as an event of DDS can make a node stand still."""
    code = (
        "import rclpy, signal; from lathe_rc.nodes.liveliness import *; rclpy.init(); node = rclpy.create_node('far');"
        f"node.create_publisher(Empty, '/far/{ALIVE}', liveliness()); signal.pause()"
    )
    tool.watch.follow(Announcement("", "/far", "tool", pid=1, host="another machine"))
    with subprocess.Popen([sys.executable, "-c", code]) as process:
        try:
            inlet = next(each for each in tool.subscriptions if each.topic_name == f"/far/{ALIVE}")
            until(inlet.get_publisher_count)
            until(lambda: status(tool.watch._signs["/far"]).alive_count)  # it has shown a sign of life
            for number, silent in ((signal.SIGSTOP, ["/far"]), (signal.SIGCONT, [])):
                process.send_signal(number)
                until(lambda silent=silent: list(tool.watch.silent) == silent, tool.watch.look)
        finally:
            process.kill()


def test_a_reader_that_is_stuck_costs_the_nodes_of_a_process_their_patience_once(tool, monkeypatch):
    """A stopped panel acknowledges no status and no event, which each node publishes on topics of its own."""
    clock, waits = [0.0], []

    def wait(duration):
        waits.append(duration.nanoseconds * 1e-9)
        clock[0] += waits[-1]
        return False

    monkeypatch.setattr(cell_node.time, "monotonic", lambda: clock[0])
    stuck = [SimpleNamespace(topic="/events", wait_for_all_acked=wait)] * 5
    for _ in range(3):  # nodes
        tool._wait_for_acknowledgement(stuck, 2.0)
    assert (waits[0], sum(waits)) == (2.0, pytest.approx(2.0 + 14 * 0.05))


def test_an_ended_process_is_known_by_its_announcement():
    """A late announcement of the previous process of a restarted member is none of a namesake."""
    with subprocess.Popen(["sleep", "100"]) as process:
        announced = Announcement("run", "/tool", "tool", host=this_host(), pid=process.pid)
        assert not has_ended(announced)
        process.kill()
    assert has_ended(announced)
    assert not has_ended(replace(announced, host="another machine"))
