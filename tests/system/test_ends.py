# SPDX-License-Identifier: Apache-2.0
"""Ends of live cells with real processes: by a signal, by a service, and of members that pause."""

import json
import os
import re
import signal

import pytest
import rclpy
from cells import NODES, SCENARIOS, assert_resimulated, scenario, started
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from std_srvs.srv import Trigger

from lathe_rc import harness
from lathe_rc.bag.check import check
from lathe_rc.bag.loss import HELD
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.errors import LatheError

pytestmark = pytest.mark.system
TROUBLE = re.compile(r"ERROR|Traceback|rror:|died|exception", re.IGNORECASE)  #: in a log


@pytest.fixture
def ask(ghost):
    """Call a service once."""

    def call(kind, name, request):
        client = ghost.create_client(kind, name)
        assert client.wait_for_service(20.0)
        future = client.call_async(request)
        rclpy.spin_until_future_complete(ghost, future, timeout_sec=60.0)
        return future.result()

    return call


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_an_endless_cell_in_a_container_with_a_whole_bag_and_exit_code_0(number, domain, tmp_path):
    """The profile that comes with lathe_rc is in the bag: it is re-simulated elsewhere."""
    file, bag = SCENARIOS[0].with_stem("piston"), tmp_path / "bag"
    values = ("-p", "spindle_encoder:revolutions:=0.0", "-p", f"recorder:bag:={bag}")
    with started("container", *NODES, "recorder", "--ros-args", "--params-file", file, *values) as process:
        said = []
        for line in process.stdout:
            said.append(line)
            if "begins with" in line:
                process.send_signal(number)
        assert process.wait() == 0
    assert not TROUBLE.search("".join(said)), said
    assert check(bag).digests == json.loads((bag / "digests.json").read_text())["digest"]
    assert_resimulated(bag)


@pytest.fixture
def endless(domain, tmp_path):
    """Processes of an endless cell that turns as fast as its members compute."""
    cell = harness.with_recorder(scenario(spindle_encoder={"revolutions": 0.0}), tmp_path / "bag", keep=True)
    with harness.Processes(cell, [[name] for name in cell.nodes], domain=domain) as processes:
        processes.wait_for("progress")
        yield processes


def test_a_service_ends_an_endless_cell_while_a_member_is_inactive(endless, ask, tmp_path):
    """The harness waits for the inactive member and names it; the member resumes for the end."""
    assert ask(
        ChangeState,
        "/recorder/change_state",
        ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE)),
    ).success
    assert endless.wait_for("paused")["missing"] == ["/recorder, which is inactive"]
    answer = ask(Trigger, "/spindle_encoder/end", Trigger.Request())
    assert answer.success
    assert answer.message.startswith("/spindle_encoder was ended by its service; it ends at sample")
    endless.wait_for_end()
    assert check(tmp_path / "bag").digests
    assert_resimulated(tmp_path / "bag")


def test_a_stopped_member_is_named_and_the_end_does_not_wait_for_it(endless):
    os.kill(endless.pids["tool"], signal.SIGSTOP)
    assert "/tool, which is silent" in endless.wait_for("paused", "spindle_encoder")["missing"]
    for node in endless.pids:
        os.kill(endless.pids[node], signal.SIGTERM)
    with pytest.raises(
        LatheError, match=r"ended by SIGTERM in the middle of a run; it ends at sample \d+; /tool has not"
    ):
        endless.wait_for_end()


def test_a_member_that_alone_gets_a_signal_is_lost_and_named(endless, tmp_path):
    """The others go to the safe state, and the bag says from which sample on the member's topics are held."""
    os.kill(endless.pids["tool"], signal.SIGINT)
    with pytest.raises(LatheError, match="/tool was ended by SIGINT in the middle of a run: safe state from sample"):
        endless.wait_for_end()
    with BagSource(tmp_path / "bag") as bag:
        assert '"/tool"' in bag.about[HELD]
