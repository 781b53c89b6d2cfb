# SPDX-License-Identifier: Apache-2.0
"""The protocol of a cell without ROS: simulated cells under thousands of schedules, and single rules."""

import numpy as np
import pytest
from deliberate_faults import FAULTS, faulty
from simulation import play

from lathe_rc import messages
from lathe_rc.errors import LatheError
from lathe_rc.protocol import (
    SILENCE,
    Announcement,
    BlockOrder,
    CellState,
    ForeignMessage,
    MemberProtocol,
    MemberState,
    Pace,
    Phase,
    Progress,
    Reactions,
    TimeMasterProtocol,
    actions,
)

MASTERS = ("spindle_encoder",)
SHARE = 300  # schedules of one test: the workers of the suite share them


@pytest.mark.parametrize("first", range(0, 3000, SHARE))
def test_cells_keep_their_promises_under_random_schedules(first):
    """Each block once, values as offline, the right member named, every survivor ends; a failing seed plays again."""
    for seed in range(first, first + SHARE):
        cell, broken = play(seed)
        assert not broken, f"schedule {seed}: {cell.plan}: {'; '.join(broken)}"


def test_a_schedule_is_the_same_each_time():
    one, other = play(7)[0], play(7)[0]
    assert one.reports == other.reports
    assert one.now == other.now


# ---- single rules


def member(name="/tool", state=MemberState.WIRED, **fields) -> Announcement:
    return Announcement(run_id="", name=name, stage=fields.pop("stage", "tool"), state=state, **fields)


@pytest.fixture
def tool() -> MemberProtocol:
    """An active tool that reads a drive and the spindle."""
    own = member(
        publishes=("/tool",), types=(messages.TOOL,), sparse=(False,), subscribes=("/coarse/state", "/encoder"), pid=7
    )
    protocol = MemberProtocol(own, 64, masters=MASTERS)
    protocol.activate(100.0)
    return protocol


SPINDLE = member("/spindle", stage="spindle_encoder", members=("/spindle", "/drive", "/recorder", "/tool"))


def reports(protocol: MemberProtocol) -> list[str]:
    """Take the actions, and return the events that were reported."""
    events = [action.event for action in protocol.actions if isinstance(action, actions.Report)]
    protocol.actions.clear()
    return events


def test_a_waiting_member_names_each_member_and_topic_that_is_missing(tool):
    tool.unmatched = ["/coarse/state", "/encoder"]
    assert tool.missing() == ["a time master", "a publisher of /coarse/state", "a publisher of /encoder"]
    tool.hear_member(member("/drvie"), 0.0)
    tool.hear_member(SPINDLE, 0.0)
    assert tool.missing() == ["/drive (/drvie is there)", "/recorder"]
    for name in ("/drive", "/recorder"):
        tool.hear_member(member(name, MemberState.JOINING), 0.0)
    assert tool.missing() == ["/drive to join", "/recorder to join"]
    publishes = {"publishes": ("/coarse/state",), "types": (messages.STATE,), "sparse": (False,)}
    tool.hear_member(member("/drive", MemberState.READY, **publishes), 0.0)
    tool.hear_member(member("/recorder", subscribes=("/tool",)), 0.0)
    assert tool.expected_writers("/coarse/state") == {"/drive"}
    assert tool.expected_readers("/tool") == {"/recorder"}
    tool.hear_cell_state(CellState("", Phase.WAITING, 0), 0.0)
    tool.matched(["/tool to /recorder"])
    assert tool.missing() == ["/tool to /recorder"]
    tool.matched([])
    tool.begun(0.0)
    assert tool.missing() == ["/spindle to be ready", "/recorder to be ready"]
    tool.deactivate()
    assert tool.missing() == ["its own activation"]
    tool.activate(0.0)
    tool.hear_cell_state(CellState("", Phase.RUNNING, 0), 0.0)
    assert tool.missing() == []


def test_waiting_is_reported_ever_more_seldom(tool):
    tool.unmatched = ["/encoder"]
    times = []
    for second in range(101):
        tool.look(100.0 + second, {}, ())
        times += [second] * reports(tool).count("waits")
    assert times == [2, 10, 40, 70, 100]


def test_a_second_time_master_is_a_stranger(tool):
    """Unless it alone names this member: a master of other members may have been heard first."""
    tool.hear_member(member("/other", stage="spindle_encoder", members=("/other", "/its")), 0.0)
    tool.hear_member(SPINDLE, 0.0)
    assert tool.master == SPINDLE
    with pytest.raises(ForeignMessage, match="the time master is /spindle"):
        tool.hear_member(member("/second", stage="spindle_encoder", members=("/second", "/tool")), 0.0)


def test_the_newcomer_of_two_namesakes_gives_up_and_names_the_other(tool):
    ready = member("/tool", MemberState.READY, pid=6)
    tool.hear_member(ready, 0.0)
    assert str(tool.failure) == "/tool: process 6 has this name already; give this node another one"
    assert tool.done
    announced = [action.member.state for action in tool.actions if isinstance(action, actions.Announce)]
    assert MemberState.FAILED not in announced  # the others would take it for the failure of the established one


def test_an_established_member_refuses_its_namesake(tool):
    tool.ready = True
    with pytest.raises(ForeignMessage, match="this node, process 7, has that name"):
        tool.hear_member(member("/tool", pid=8), 0.0)
    assert tool.failure is None


def leads(window=4, **reactions) -> TimeMasterProtocol:
    """A time master whose run has begun, with a controller and a recorder."""
    own = member("/spindle", stage="spindle_encoder", members=("/spindle", "/c", "/recorder"), session=5)
    values = {"stall_reaction": "safe", "stall_time": 0.1, "restart_time": 30.0, "safe_samples": 8, "block_size": 4}
    protocol = TimeMasterProtocol(own, window, Reactions(**values | reactions), masters=MASTERS)
    protocol.activate(0.0)
    for name in own.members[1:]:
        protocol.hear_member(member(name, MemberState.READY, parameters='{"restart_file": "x"}'), 0.0)
    protocol.matched([])
    protocol.begun(0.0)
    assert isinstance(protocol.actions[-1], actions.CheckCell)
    protocol.start(0.0)
    return protocol


def release(protocol: TimeMasterProtocol, blocks: int, now: float = 0.0) -> None:
    protocol.release(blocks, now)
    protocol.computed(protocol.blocks + blocks, 4 * (protocol.blocks + blocks), now, last=False)


def test_the_window_bounds_the_blocks_in_flight_and_the_slowest_member_gives_credit():
    protocol = leads()
    release(protocol, 4)
    assert protocol.credit == 0
    protocol.hear_progress(Progress("", "/c", 3, 12, 5), 0.0)
    assert protocol.credit == 0
    protocol.hear_progress(Progress("", "/recorder", 1, 4, 0), 0.0)  # a third-party member need not know the session
    assert protocol.credit == 1


@pytest.mark.parametrize("session", [0, 5])
def test_progress_of_another_start_of_the_scenario_is_a_stranger(session):
    """Equal scenarios have equal run ids: "/c claims 7472 blocks; 0 were sent" ended a cell beside one that ended."""
    protocol = leads()
    with pytest.raises(ForeignMessage, match="expected session 5"):
        protocol.hear_progress(Progress("", "/c", 7472, 29888, 4), 0.0)
    release(protocol, 1)
    protocol.hear_progress(Progress("", "/c", 1, 4, session), 0.0)
    assert protocol.completed["/c"] == 1


def test_a_member_that_claims_blocks_that_were_not_sent_is_lost():
    protocol = leads()
    release(protocol, 1)
    protocol.hear_progress(Progress("", "/c", 9, 36, 5), 0.0)
    assert protocol.without == {"/c"}
    assert protocol.failure is None
    assert any(isinstance(action, actions.Lose) for action in protocol.actions)


def test_the_slowest_member_is_named_and_not_its_waiters():
    """Members tell how far they are when they pass a multiple of a quarter of the window, some a block later."""
    protocol = leads(window=64)
    protocol.completed = {"/learning_controller": 17, "/tool": 17, "/recorder": 16}
    assert protocol.slowest == "/learning_controller"
    protocol.completed["/recorder"] = 15
    assert protocol.slowest == "/recorder"


@pytest.mark.parametrize("restarts", [True, False])
def test_a_member_that_computes_blocks_once_more_is_not_silent(restarts):
    """With ``stall_reaction: safe`` the cell would lose a controller that has just come back."""
    protocol = leads()
    release(protocol, 4)
    protocol.hear_progress(Progress("", "/c", 4, 16, 5), 0.0)
    if not restarts:
        protocol.hear_member(member("/c", MemberState.READY), 0.0)
    protocol.look(0.07, {}, ())
    protocol.hear_progress(Progress("", "/c", 2, 8, 5), 0.07)
    protocol.look(0.13, {}, ())
    assert ("stall" in reports(protocol)) == (not restarts)


def test_a_silent_time_master_is_named_as_soon_as_the_blocks_in_flight_are_over(tool):
    """The node looks again at that moment, and not at its next period."""
    tool.hear_member(SPINDLE, 100.0)
    tool.hear_cell_state(CellState("", Phase.RUNNING, 0), 100.0)
    tool.computed(1, 64, 100.05, last=False)
    tool.look(100.1, {"/spindle": 100.08}, ())
    assert "stall" not in reports(tool)
    assert tool.look_due == pytest.approx(100.05 + SILENCE)
    tool.look(tool.look_due + 1e-6, {"/spindle": 100.08}, ())
    assert "stall" in reports(tool)


def test_the_schedule_makes_up_half_a_window_and_slips_by_more():
    pace = Pace(block=1.0, window=3)
    pace.schedule = 100.0
    assert (pace.due(0), pace.due(1)) == (101.0, 102.0)
    assert pace.most_late == 1.0
    pace.count(1.1, 1)
    pace.slip(1.1)
    assert (pace.due(1), pace.slipped) == (103.1, 1.1)
    assert pace.figures()["late"] == 1


def test_a_pace_that_is_lost_is_known_after_the_first_second():
    pace = Pace(block=0.1, window=3, judged=10)
    for _ in range(9):
        pace.count(0.2, 1)
        pace.slip(0.1)
        assert pace.lag() == 0.0
    pace.count(0.2, 1)
    assert pace.lag() == pytest.approx(0.9 / 1.9)
    assert pace.lag() == 0.0  # said once


def test_blocks_come_in_order_whatever_is_repeated():
    """After a restart a source repeats blocks; each counts once."""
    draw, order = np.random.default_rng(3), BlockOrder("/t", "run")
    order.expect("/a")
    order.repeats = True
    taken, first = [], 0
    while len(taken) < 200:
        if order.missing("/a", first, 4) is not None:
            order.append(first + 4, last=False)
            taken.append(first)
        first = first + 4 if draw.random() < 0.9 else max(0, first - 4 * int(draw.integers(5)))
    assert taken == list(range(0, 800, 4))
    with pytest.raises(LatheError, match="/t: /a goes from sample 800 to 808: 8 samples are missing"):
        order.missing("/a", 808, 4)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.mistake)
def test_a_deliberate_fault_has_its_place_in_the_protocol(fault):
    """`./lathe test --system` plays schedules with each of them; here it only has to fit the code as it is."""
    compile(faulty(fault), fault.module, "exec")
