# SPDX-License-Identifier: Apache-2.0
"""The protocol of a cell without ROS: simulated cells under thousands of schedules, and single rules."""

import re
from dataclasses import replace

import numpy as np
import pytest
import simulation
from schedules import play, violations
from simulation import Design, Simulation

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
from lathe_rc.protocol.leading_run import LeadingRun
from lathe_rc.protocol.member_host import MemberHost
from lathe_rc.protocol.stage_run import StageRun

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


# ---- schedules with one disturbance


DESIGNS = (
    Design("/spindle"),
    Design("/controller", (("/spindle", 0), ("/tool", 1)), restarts=True),
    Design("/drive", (("/controller", 0),)),
    Design("/tool", (("/spindle", 0), ("/drive", 0))),
    Design("/recorder", (("/spindle", 0), ("/controller", 0), ("/drive", 0), ("/tool", 0))),
)


def piston(disturb, at=5, *, stalls="wait", window=4, length=20) -> Simulation:
    """A cell after its run, in which ``disturb(cell)`` was called once when some blocks had been released.

    No wait without a deadline, values as offline up to the safe state, and the cause named: as in all schedules.
    """
    cell = Simulation(1, DESIGNS, window, length, stalls)
    for design in DESIGNS:
        cell.start(design)
    cell.at_block[at] = [lambda: disturb(cell)]
    cell.run()
    assert violations(cell) == []
    return cell


def told(cell: Simulation, event: str) -> list[tuple[str, dict]]:
    return [(name, values) for _, name, kind, values in cell.reports if kind == event]


def stopped(cell: Simulation, name: str, seconds: float) -> None:
    cell.culprits.add(name)
    cell.stop(cell.process_of(name), seconds)


def killed(cell: Simulation, name: str) -> None:
    cell.culprits.add(name)
    cell.kill(cell.process_of(name))


def exit_codes(cell: Simulation) -> dict[str, int]:
    return {member.full_name: member.protocol.exit_code for member in cell.gone}


def test_a_member_that_stalls_is_lost_if_the_cell_shall_not_wait():
    cell = piston(lambda cell: stopped(cell, "/tool", 5.0), stalls="safe")
    ((_, safe),) = told(cell, "safe")
    assert safe["lost"] == ["/tool"]
    assert safe["why"].startswith("/tool fell silent: safe state from sample ")
    assert told(cell, "abandoned")[0][0] == "/tool", "it resumes, and learns that the cell has lost it"


def test_a_member_that_stalls_is_named_and_waited_for_if_the_cell_shall_wait():
    cell = piston(lambda cell: stopped(cell, "/tool", 5.0))
    assert {values["member"] for _, values in told(cell, "stall")} == {"/tool"}
    assert not told(cell, "safe")
    assert set(exit_codes(cell).values()) == {0}


def test_a_member_that_stalls_is_named_before_the_end_although_the_window_holds_the_whole_run():
    """No credit is missing then: the time master names it by its liveliness."""
    cell = piston(lambda cell: stopped(cell, "/tool", 0.5), window=64)
    assert [values["member"] for _, values in told(cell, "stall")] == ["/tool"]


def test_a_time_master_that_stalls_is_given_up_by_name_and_says_so_when_it_resumes():
    """If the cell shall not wait: after 2 s each member gives up."""
    cell = piston(lambda cell: stopped(cell, "/spindle", 3.0), stalls="safe")
    given_up = {values["message"] for _, values in told(cell, "masterless")}
    assert given_up == {"/spindle, the time master, has been silent for 2 s: no sample follows"}
    assert {name for name, _ in told(cell, "masterless")} == {design.name for design in DESIGNS[1:]}
    ((name, error),) = told(cell, "error")
    assert name == "/spindle"
    assert re.fullmatch(r"/spindle stood still at sample \d+: the others have given it up", error["message"])
    assert not told(cell, "safe")
    assert not told(cell, "dead")


def test_the_members_end_by_themselves_when_their_time_master_has_died():
    cell = piston(lambda cell: killed(cell, "/spindle"))
    assert {values["message"] for _, values in told(cell, "abandoned")} == {
        "/spindle, the time master, is lost: no sample follows"
    }
    assert exit_codes(cell) == dict.fromkeys([design.name for design in DESIGNS[1:]], 1)


def test_each_survivor_of_a_lost_member_says_so_by_its_exit_code():
    cell = piston(lambda cell: killed(cell, "/tool"))
    assert [values["lost"] for _, values in told(cell, "safe")] == [["/tool"]]
    assert exit_codes(cell) == dict.fromkeys(["/spindle", "/controller", "/drive", "/recorder"], 1)


@pytest.mark.parametrize("event", ["shut_down", "interrupt"])
def test_a_member_that_is_ended_in_the_middle_of_a_run_is_lost_and_named(event):
    """By ``ros2 lifecycle set NODE shutdown``, or by SIGTERM."""

    def end(cell):
        cell.culprits.add("/tool")
        tool = cell.process_of("/tool")
        tool.attempt(getattr(tool.protocol, event), cell.now if event == "shut_down" else "SIGTERM")
        tool.process.turn()

    ((_, safe),) = told(piston(end), "safe")
    how = "/tool was shut down" if event == "shut_down" else "/tool was ended by SIGTERM"
    assert safe["why"].startswith(f"/tool failed: {how} in the middle of a run: safe state from sample ")


@pytest.mark.parametrize("kept", [True, False])
def test_a_controller_that_is_restarted_is_waited_for_unless_its_state_is_lost(kept):
    """A new process without a state gives up: the cell goes to its safe state at once, not after ``restart_time``."""

    def kill(cell):
        killed(cell, "/controller")
        if not kept:
            cell.files.clear()
        cell.at(cell.now + 0.1, lambda: cell.start(DESIGNS[1]))

    cell = piston(kill)
    assert [values["restarts"] for _, values in told(cell, "dead")] == [True]
    assert bool(told(cell, "back")) == kept
    lost = [] if kept else ["/controller failed: /controller: no state to go on from"]
    assert [values["why"].partition(": safe state")[0] for _, values in told(cell, "safe")] == lost


# ---- single rules


def member(name="/tool", state=MemberState.WIRED, **fields) -> Announcement:
    return Announcement(run_id="", name=name, stage=fields.pop("stage", "tool"), state=state, **fields)


@pytest.fixture
def tool() -> MemberProtocol:
    """An active tool that reads a drive and the spindle."""
    own = member(
        publishes=("/tool",), types=(messages.TOOL,), sparse=(False,), subscribes=("/coarse/state", "/encoder"), pid=7
    )
    protocol = MemberProtocol(own, 64)
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


def test_silences_of_a_member_are_logged_once_and_counted(tool):
    for second in range(5):
        tool._tell_stall("/spindle", 64 * second, 100.0 + second)
    tool.leave()
    said = [action.text for action in tool.actions if isinstance(action, actions.Log)]
    assert said == ["/spindle has been silent for 80 ms at block 0", "/spindle has been silent for 80 ms 5 times"]


def test_a_second_time_master_is_a_stranger(tool):
    """Unless it alone names this member: a master of other members may have been heard first."""
    tool.hear_member(member("/other", stage="spindle_encoder", members=("/other", "/its")), 0.0)
    tool.hear_member(SPINDLE, 0.0)
    assert tool.master == SPINDLE
    with pytest.raises(ForeignMessage, match="the time master is /spindle"):
        tool.hear_member(member("/second", stage="spindle_encoder", members=("/second", "/tool")), 0.0)


def test_one_of_two_established_namesakes_stays(tool):
    """Both may be ready, on two machines or as two processes that resumed; the other one hears it and gives up."""
    other = member("/tool", MemberState.READY, host="elsewhere", pid=6)
    protocol = MemberProtocol(other, 64)
    tool.ready = protocol.ready = True
    with pytest.raises(ForeignMessage, match="this node, process 7, has that name"):
        tool.hear_member(other, 0.0)
    answer = next(action.member for action in tool.actions if isinstance(action, actions.Announce))
    protocol.hear_member(replace(answer, state=MemberState.READY), 0.0)
    assert protocol.done
    assert "/tool: process 7 of another machine has this name already" in str(protocol.failure)


def test_the_newcomer_of_two_namesakes_gives_up_and_names_the_other(tool):
    ready = member("/tool", MemberState.READY, pid=6)
    tool.hear_member(ready, 0.0)
    assert str(tool.failure) == "/tool: process 6 has this name already; give this node another one"
    assert tool.done
    announced = [action.member.state for action in tool.actions if isinstance(action, actions.Announce)]
    assert MemberState.FAILED not in announced  # the others would take it for the failure of the established one


def test_a_newcomer_in_a_running_cell_waits_for_its_namesake_to_be_heard(tool):
    """It cannot go on in mid-run in any case: after a second it says that, and names nobody."""
    for name in ("/drive", "/recorder"):
        tool.hear_member(member(name, MemberState.READY), 100.0)
    tool.hear_member(replace(SPINDLE, state=MemberState.READY), 100.0)
    tool.hear_cell_state(CellState("", Phase.RUNNING, 0), 100.0)
    for now, wants in ((100.9, False), (101.1, True)):
        tool.look(now, {}, ())
        assert tool.wants_match == wants


def test_an_established_member_refuses_its_namesake(tool):
    tool.ready = True
    with pytest.raises(ForeignMessage, match="this node, process 7, has that name"):
        tool.hear_member(member("/tool", pid=8), 0.0)
    assert tool.failure is None


def leads(window=4, first=0, **reactions) -> TimeMasterProtocol:
    """A time master whose run has begun, with a controller and a recorder."""
    own = member("/spindle", stage="spindle_encoder", members=("/spindle", "/c", "/recorder"), session=5)
    values = {"stall_reaction": "safe", "stall_time": 0.1, "restart_time": 30.0, "safe_samples": 8, "block_size": 4}
    protocol = TimeMasterProtocol(own, window, Reactions(**values | reactions), first=first)
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


def test_a_run_from_a_checkpoint_counts_its_blocks_from_there():
    """Samples keep their numbers, in what the time master says, in its simulated time and up to the end."""
    protocol = leads(first=1001)
    protocol.know_end(1010)
    assert protocol.blocks_in_run == 3
    protocol.release(3, 0.0)
    protocol.computed(3, 1010, 0.0, last=True)
    for name in ("/c", "/recorder"):
        protocol.hear_progress(Progress("", name, 2, 1009, 5), 0.0)
        protocol.hear_progress(Progress("", name, 3, 1010, 5), 0.0)
    said = [action.state for action in protocol.actions if isinstance(action, actions.Say)]
    assert [(state.state, state.first_index) for state in said] == [
        (Phase.WAITING, 1001), (Phase.RUNNING, 1001), (Phase.ENDED, 1010),
    ]  # fmt: skip
    assert [action.samples for action in protocol.actions if isinstance(action, actions.TellTime)] == [1009, 1010]


@pytest.mark.parametrize("stalls", ["wait", "safe"])
def test_a_run_that_is_held_goes_on_with_the_same_values_and_nobody_was_silent(stalls):
    """Held for longer than any patience, twice in a row; the stand-still is the time master's own will."""

    def hold(cell):
        spindle = cell.process_of("/spindle")

        def to(blocks):
            spindle.attempt(spindle.protocol.hold, blocks, cell.now)
            spindle.process.turn()

        to(8)
        cell.at(cell.now + 20.0, lambda: to(12))
        cell.at(cell.now + 40.0, lambda: to(None))

    cell = piston(hold, stalls=stalls)
    assert cell.now > 40.0
    assert not told(cell, "stall")
    assert not told(cell, "safe")


def test_the_safe_state_ends_a_hold():
    protocol = leads()
    release(protocol, 2)
    protocol.hold(2, 0.0)
    assert protocol.credit == 0
    protocol.declare_safe("the encoder is lost", 1.0)
    assert (protocol.held_at, protocol.credit) == (None, 2)
    protocol.hold(2, 2.0)
    assert protocol.held_at is None, "the members shall reach their safe state"


@pytest.mark.parametrize("blocks", [None, 2])
def test_a_hold_does_not_change_an_early_end(blocks):
    """A reader that had not heard of the end yet rejected the last block, and its sender was lost."""
    protocol = leads()
    release(protocol, 2)
    protocol.hold(2, 0.0)
    protocol.end_run("asked to end", 1.0)
    protocol.hold(blocks, 1.01)
    assert protocol.credit == 0, "the members hear of the end first"
    protocol.look(1.06, {}, ())
    assert protocol.credit > 0, "then the last block follows"


def test_a_run_that_is_ended_in_its_last_block_says_why_it_waits():
    protocol = leads(stall_reaction="wait")
    protocol.know_end(8)
    release(protocol, 1)
    protocol.end_run("/spindle was ended by SIGTERM", 0.0)
    release(protocol, 1)
    for now in np.arange(0.05, 2.2, 0.05).tolist():
        protocol.look(now, {}, ())
    assert str(protocol.failure).startswith("/spindle was ended by SIGTERM; /c has not completed its blocks within")


@pytest.mark.parametrize("waits", ["for its own input", "for a report"])
def test_a_silent_member_is_lost_although_the_window_is_not_used_up(waits):
    """A time master in a chain with a controller waits for the feedback of the member, shorter than the window."""
    protocol = leads(window=64)
    release(protocol, 17 if waits == "for a report" else 3)
    protocol.hear_progress(Progress("", "/recorder", protocol.blocks, 4 * protocol.blocks, 5), 0.0)
    protocol.starved = waits == "for its own input"
    for now in (0.05, 0.1, 0.15, 0.2):
        protocol.look(now, {"/c": 0.01}, ())
    assert protocol.without == {"/c"}
    assert protocol.failure is None


def test_a_member_that_is_slow_to_confirm_the_safe_state_is_waited_for():
    protocol = leads()
    release(protocol, 2)
    protocol.declare_safe("the encoder is lost", 0.0)
    for now in np.arange(0.05, 2.2, 0.05).tolist():
        protocol.look(now, {}, ())
        assert (protocol.failure is None) == (now < 2.01), "both are given up then, and nobody is left"


@pytest.mark.parametrize("session", [0, 5])
def test_progress_of_another_start_of_the_scenario_is_a_stranger(session):
    """Equal scenarios have equal run ids: "/c claims 7472 blocks; 0 were sent" ended a cell beside one that ended."""
    protocol = leads()
    with pytest.raises(ForeignMessage, match="expected session 5"):
        protocol.hear_progress(Progress("", "/c", 7472, 29888, 4), 0.0)
    release(protocol, 1)
    protocol.hear_progress(Progress("", "/c", 1, 4, session), 0.0)
    assert protocol.completed["/c"] == 1


def test_a_time_master_that_hears_its_own_progress_after_the_end_refuses_nothing():
    """One process publishes the progress of all its nodes, and DDS brings it to them as well."""
    protocol = leads()
    protocol.know_end(4)
    release(protocol, 1)
    for name in ("/c", "/recorder"):
        protocol.hear_progress(Progress("", name, 1, 4, 5), 0.0)
    assert not protocol.running
    protocol.hear_progress(Progress("", "/spindle", 1, 4, 0), 0.0)
    with pytest.raises(ForeignMessage, match="it is over"):
        protocol.hear_progress(Progress("", "/c", 1, 4, 5), 0.0)


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
    assert pace.figures().late == 1


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


def test_the_simulation_has_no_second_version_of_what_ships():
    """Hosts, roles and restart of simulated members are the shipped ones, extended by what the simulation records."""
    for simulated, shipped, extended in (
        (simulation.Member, MemberHost, {"activate"}),
        (simulation.Stage, StageRun, {"lose"}),
        (simulation.Recorder, StageRun, {"members_changed"}),
        (simulation.Spindle, LeadingRun, {"perform"}),
    ):
        hooks = {name for name, value in vars(shipped).items() if getattr(value, "__isabstractmethod__", False)}
        again = {name for name in vars(simulated).keys() & vars(shipped).keys() - hooks if name[:2] != "__"}
        assert {name for name in again - {"become_safe"} if callable(vars(shipped)[name])} == extended
