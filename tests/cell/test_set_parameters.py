# SPDX-License-Identifier: Apache-2.0
"""``ros2 param set``: what acts in a run, what is read-only and why, and what an unconfigured node takes."""

import pytest
from cells import assert_resimulated, scenario, until

pytest.importorskip("rclpy")

import rclpy
from rcl_interfaces.srv import SetParameters
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter

from lathe_bagtools.nodes.replayer import _Pace
from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.cell.beside import ReplayerParameters
from lathe_rc.nodes import declare
from lathe_rc.nodes.cell_node import CellNode
from lathe_rc.nodes.report import Reporter
from lathe_rc.nodes.stage_role import StageRole
from lathe_rc.nodes.standalone_node import StandaloneNode
from lathe_rc.protocol.exchange import Exchange

DONE, REFUSED = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
CONTROLLER = "learning_controller"


class Client:
    """Sets parameters as ``ros2 param set`` does."""

    def __init__(self, ghost):
        self._ghost, self._clients = ghost, {}

    def set(self, node, name, value):
        """Whether the value was taken, and the reason."""
        if node not in self._clients:
            self._clients[node] = self._ghost.create_client(SetParameters, f"/{node}/set_parameters")
            assert self._clients[node].wait_for_service(60.0)
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])

        def answer():
            future = self._clients[node].call_async(request)
            rclpy.spin_until_future_complete(self._ghost, future, timeout_sec=2.0)
            return future.result()

        (result,) = until(answer).results  # a node that has not discovered the client yet cannot answer
        return result.successful, result.reason


# --- in a run


@pytest.mark.parametrize(
    "together", [True, pytest.param(False, marks=pytest.mark.system)], ids=["composed", "processes"]
)
def test_parameters_act_in_a_run_and_a_gain_gives_the_bits_of_the_same_event(ghost, domain, tmp_path, together):
    """A gain set in a run gives the digest of the event that the bag records; a re-simulation repeats it."""
    # Five blocks a second: the run reaches its end only if the pace that is set acts.
    nodes = scenario(spindle_encoder={"revolutions": 12.0, "speed_factor": 5e-3})
    cell = harness.with_recorder(nodes, tmp_path / "bag", keep=True)
    client = Client(ghost)
    groups = [list(cell.nodes)] if together else [[name] for name in cell.nodes]
    with harness.Processes(cell, groups, domain=domain) as processes:
        processes.wait_for("block0")

        def halve():
            taken, why = client.set(CONTROLLER, "learning_gain", 0.5)
            return why if taken or not why.endswith("lets parameters be set before it") else None

        assert until(halve) == f"from revolution 1 on, as an event on /{CONTROLLER}/events"
        taken, why = client.set(CONTROLLER, "lead_time", 3e-3)
        assert not taken
        assert "learning diverges with electrodynamic_actuator" in why
        for name, value, said in (
            ("learning_gain", 5.0, "learning_controller.learning_gain = 5.0; allowed: a finite number above 0 up to 2"),
            ("gain", 1.0, "learning_controller.gain: unknown parameter; did you mean learning_gain"),
            (
                "feedback_delay",
                64,
                (
                    "learning_controller.feedback_delay is read-only: the node is configured with it; allowed now: "
                    "learning_gain, lead_time, q_time; before a run, 'ros2 lifecycle set "
                    "/learning_controller cleanup' lets it be set, 'lathe resim BAG --set "
                    "learning_controller.feedback_delay=VALUE' shows its effect on a recorded run"
                ),
            ),
            ("events", ["sample 9: freeze"], "read-only: the service /learning_controller/schedule schedules an event"),
            ("block_size", 32, "read-only: it is the same in all nodes of the cell; before a run"),
        ):
            taken, why = client.set(CONTROLLER, name, value)
            assert (taken, said in why) == (False, True), why
        assert client.set("recorder", "chunk_size", 4096)[1].endswith(
            "'ros2 lifecycle set /recorder cleanup' lets it be set"
        )
        assert client.set("recorder", "split_duration", 0.1) == (True, "from the next message on")
        taken, why = client.set("spindle_encoder", "speed_factor", 0)
        assert taken, why
        processes.wait_for_end()
    assert len([*(tmp_path / "bag").glob("bag*.mcap")]) == 8  # 0.72 s, and the messages before the first of 0.1 s
    recording = reader.read_bag(tmp_path / "bag")
    said = recording.sparse[f"/{CONTROLLER}/events"].values
    assert said["action"] == ["set learning_gain 0.5"]
    events = [f"sample {sample}: set learning_gain 0.5" for sample in said["sample_index"]]
    alike = scenario(spindle_encoder={"revolutions": 12.0}, learning_controller={"events": events})
    assert recording.digests() == harness.run(alike).digest
    assert_resimulated(tmp_path / "bag")


# --- of an unconfigured node


@pytest.fixture
def node(ghost):
    """A controller in this process that a client configures."""
    made = CellNode(CONTROLLER, CONTROLLER, StageRole, Reporter(), Exchange())
    made._starts = False
    yield made
    made.destroy_node()


def set_in(node, name, value):
    result = node.set_parameters_atomically([Parameter(name, value=value)])
    return result.successful, result.reason


def test_an_undeclared_parameter_is_refused(node):
    taken, why = set_in(node, "lead", 1e-3)
    assert not taken
    assert why.startswith("learning_controller.lead: unknown parameter; did you mean ")
    assert set_in(node, "lead_time", "long") == (
        False, "learning_controller.lead_time = 'long'; allowed: a finite number from 0 up to 1 [s]",
    )  # fmt: skip
    assert not node.has_parameter("lead")


def test_a_configure_that_is_refused_leaves_the_node_unconfigured_and_alive(node):
    """Its parameters can be set then, as after a cleanup, and an integer may stand for a double."""
    assert set_in(node, "q_time", 0.05) == (True, "")
    assert node.trigger_configure() == REFUSED
    assert node.protocol.failure is None
    assert node._state_machine.current_state[1] == "unconfigured"
    assert set_in(node, "q_time", 60e-6) == set_in(node, "learning_gain", 1) == (True, "")
    assert node.trigger_configure() == DONE
    assert node.table.learning_gain == 1.0
    assert node.describe_parameter("feedback_delay").read_only
    assert not node.describe_parameter("learning_gain").read_only
    taken, why = set_in(node, "learning_gain", 0.5)
    assert (taken, why.partition(";")[0]) == (False, "/learning_controller: the run has not begun")
    assert node.trigger_cleanup() == DONE
    assert set_in(node, "feedback_delay", 1024) == set_in(node, "learning_gain", 0.5) == (True, "")
    assert node.trigger_configure() == DONE
    assert (node.table.feedback_delay, node.table.learning_gain) == (1024, 0.5)


# --- of a node outside of the cell


def test_a_node_outside_of_the_cell_takes_the_parameters_that_it_can_change(ghost):
    node = StandaloneNode("replayer", ReplayerParameters)
    try:
        declare.declare(node, ReplayerParameters)
        rates = []
        node.tunes("rate", rates.append)
        assert set_in(node, "rate", 2) == set_in(node, "rate", 0.5) == (True, "")
        assert rates == [2.0, 0.5] == [2.0, node.get_parameter("rate").value]
        assert set_in(node, "rate", -1.0) == (False, "replayer.rate = -1.0; allowed: a finite number from 0")
        assert set_in(node, "rat", 1.0)[1] == "replayer.rat: unknown parameter; did you mean rate?"
        why = (
            "replayer.end is read-only: the node is made with it; allowed now: rate; start it again with "
            "-p replayer:end:=VALUE"
        )
        assert set_in(node, "end", 1.0) == (False, why)
    finally:
        node.destroy_node()


def test_the_rate_of_a_replay_changes_from_where_it_is():
    """A replay that changes its rate neither jumps nor waits, also in a pause and without a pace before."""
    pace, second = _Pace(2.0), 10**9
    pace.begin()
    began = pace.due(5 * second)
    assert pace.due(9 * second) - began == pytest.approx(2.0)
    pace.change(0.5, began + 1.0, 6 * second)  # 2 s of the bag have passed
    assert pace.due(7 * second) == pytest.approx(began + 1.0)
    assert pace.due(8 * second) == pytest.approx(began + 3.0)
    pace.hold(10.0)
    assert pace.due(8 * second) == pytest.approx(began + 13.0)
    pace.change(0.0, began + 11.0, 7 * second)
    assert pace.due(100 * second) == pytest.approx(began + 11.0)
    pace.change(1.0, began + 20.0, 50 * second)
    assert pace.due(51 * second) == pytest.approx(began + 21.0)
