# SPDX-License-Identifier: Apache-2.0
"""Cells of real processes that lose a member, by a signal or by a bad block: the drive ends at its safe position.

A second recorder proves it where the first is lost.
"""

import os
import signal
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from bags import some
from cells import all_but
from spoiled import KINDS, spoil

from lathe_rc import harness, load, messages, read_bag
from lathe_rc.bag.check import check
from lathe_rc.cell.scenario import Scenario

pytestmark = pytest.mark.system
MASTER, DRIVE, SAFE_POSITION = "spindle_encoder", "electrodynamic_actuator", 0.3e-3
RECORDERS = ("recorder", "witness")
MEMBERS = ("spindle_encoder", "learning_controller", "electrodynamic_actuator", "tool", "supervisor", "recorder")
DEADLINE = 120.0  #: [s] without any event, on a busy machine too
AT = 20_000  #: sample from which on the member is disturbed


def cell_of(name: str, reaction: str, folder, *settings: str) -> Scenario:
    """A scenario with two recorders, of which a wall clock says nothing."""
    changes = [f"spindle_encoder.stall_reaction={reaction}", "spindle_encoder.stall_time=0.5"]
    changes += ["spindle_encoder.safe_time=0.1", "spindle_encoder.revolutions=1000.0", "recorder.chunk_size=65536"]
    cell = load(name, [*changes, *settings])
    witness = cell.recorder[1].model_copy(update={"stage": "recorder", "bag": str(folder / "witness")})
    nodes = {**cell.nodes, "witness": witness}
    return harness.with_recorder(Scenario(cell.name, nodes), folder / "recorder", keep=True)


def events_of(processes: harness.Processes, disturb=None) -> Iterator[harness.Event]:
    """The events up to the end of the last process; ``disturb`` is called once, at some progress of the run."""
    running = set(processes.pids)
    for event in processes.events(DEADLINE):
        yield event
        if disturb and event["event"] == "progress" and event["samples"] >= AT:
            disturb()
            disturb = None
        if event["event"] == "exit":
            running -= set(event["node"].split("+"))
            if not running:
                return
        yield {"event": "running", "node": "", "nodes": frozenset(running)}


def assert_safe(folder, events: Sequence[harness.Event], lost: set[str]) -> None:
    """The members that are lost are named, and what is left of the cell is at its safe position, as the bags say."""
    declared = [event for event in events if event["event"] == "safe"]
    assert {name for event in declared for name in event["lost"]} == {f"/{name}" for name in lost}, declared
    for bag in (folder / name for name in RECORDERS if name not in lost):
        found = check(bag)
        assert not found.wrong
        recording = read_bag(bag, whole=True)
        assert {signals.size for topic in recording.dense.values() for signals in topic.values()} == {
            declared[-1]["end"]
        }
        position = recording.of_type(messages.STATE)["position"]
        if DRIVE not in lost:
            assert position[-1] == pytest.approx(SAFE_POSITION, abs=1e-6)
        else:
            assert np.ptp(position[declared[0]["sample"] :]) == 0.0, "it is held"


def rounds() -> list[tuple[str, str, str, str, str]]:
    """Cell, reaction, member, signal and grouping."""
    found = []
    for name, groupings in {
        "piston": ["", "spindle_encoder+learning_controller+recorder", "learning_controller+tool", "*"],
        "supervised": ["", "spindle_encoder+learning_controller+tool+supervisor+recorder"],
    }.items():
        for reaction in ("safe", "wait"):
            for number in ("STOP", "KILL", "TERM", "INT"):
                members = [each for each in MEMBERS if each != "supervisor" or name == "supervised"]
                those = [each for each in groupings if (number, each) != ("STOP", "*")]  # a cell that stops as a whole
                found += [(name, reaction, each, number, together) for together in those for each in members]
    order = np.random.default_rng(6).permutation(len(found))
    return [found[place] for place in order]


@pytest.mark.parametrize(("name", "reaction", "member", "number", "together"), some(rounds(), 32))
def test_a_cell_that_loses_a_process_ends_at_its_safe_position(name, reaction, member, number, together, tmp_path):
    """Whatever the signal and the grouping; if the time master is lost no sample follows, and every process ends."""
    cell = cell_of(name, reaction, tmp_path)
    groups = [list(cell.nodes)] if together == "*" else cell.processes([together.split("+")] if together else [])
    (lost,) = (set(group) for group in groups if member in group)
    signum, events = signal.Signals[f"SIG{number}"], []
    with harness.Processes(cell, groups) as processes:
        pid = processes.pids[member]
        for event in events_of(processes, lambda: os.kill(pid, signum)):
            events.append(event)
            named = event["event"] == "stall" and event["member"].removeprefix("/") in lost
            only_it = event["event"] == "running" and event["nodes"] == lost
            if number == "STOP" and ((reaction == "wait" and named) or only_it):
                os.kill(pid, signal.SIGCONT)
                if reaction == "wait":
                    processes._children["+".join(next(g for g in groups if MASTER in g))].send_signal(signal.SIGTERM)
    told = {event["event"] for event in events}
    if number == "STOP" and reaction == "wait":
        assert "safe" not in told
    elif MASTER in lost and number in ("TERM", "INT"):
        assert not told & {"safe", "abandoned", "masterless"}, "the run ends early, for all members"
    elif MASTER in lost:
        given_up = [event for event in events if event["event"] in ("abandoned", "masterless", "error")]
        causes = {event["node"]: event["message"] for event in given_up if event["node"] not in lost}
        assert causes.keys() == cell.nodes.keys() - lost
        assert all(f"/{MASTER}" in cause for cause in causes.values()), causes
    else:
        assert_safe(tmp_path, events, lost)
    for bag in (tmp_path / each for each in RECORDERS if each not in lost):
        assert not check(bag).wrong


SPOILED = [(kind, member) for member in ("learning_controller", DRIVE, "tool") for kind in KINDS]


@pytest.mark.parametrize(("kind", "member"), some(SPOILED, 16))
def test_the_sender_of_a_bad_block_is_lost_and_its_readers_retract(kind, member, tmp_path, monkeypatch):
    """A reader of a bad block goes on: it is the sender that is named, and held from the block before on."""
    monkeypatch.setenv("PYTHONPATH", spoil(tmp_path, f"/{member}", kind, AT))
    cell = cell_of("piston", "wait", tmp_path)
    with harness.Processes(cell, all_but(cell, member), start="spawn") as processes:
        events = list(events_of(processes))
    assert_safe(tmp_path, events, {member})
    assert any(" is rejected by /" in event.get("why", "") for event in events), "by a reader"
