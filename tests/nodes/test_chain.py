# SPDX-License-Identifier: Apache-2.0
"""Nodes of one process compute as one program; what that changes for a sample is nothing."""

from pathlib import Path

import numpy as np
import pytest
from cells import announced

from lathe_rc import harness, resources
from lathe_rc.bag import reader
from lathe_rc.cell import scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import LatheError
from lathe_rc.nodes.chain import _groups

LAWS = ["spindle_encoder", "learning_controller", "fine_controller", "electrodynamic_actuator", "piezo_actuator"]
LOOPS = ["force_controller", "position_controller", "decoupler", "longitudinal", "cross"]
CUT = ["tool", "cutting_process"]


def full_cell(*overrides, revolutions=3):
    path = resources.find(Path("full_cell.yaml"))
    return scenario.load(path, [f"spindle_encoder.revolutions={revolutions}", *overrides])


@pytest.mark.parametrize(
    ("here", "groups"),
    [
        (LAWS + LOOPS + CUT, [LAWS + LOOPS + CUT]),
        (LAWS, [LAWS]),
        (LOOPS + CUT, [LOOPS + CUT]),
        ([*LAWS, "tool"], [LAWS, ["tool"]]),  # the slides are between them
        ([*LOOPS, "cutting_process"], [LOOPS, ["cutting_process"]]),  # and here the tool
        (["spindle_encoder", "tool"], [["spindle_encoder"], ["tool"]]),
        (["learning_controller", "cutting_process"], [["learning_controller"], ["cutting_process"]]),
        (["learning_controller", "force_controller"], [["learning_controller", "force_controller"]]),
    ],
)
def test_what_comes_back_without_a_delay_cuts_a_chain(here, groups):
    found = _groups(Cell(full_cell().nodes), dict.fromkeys(here))
    assert list(map(sorted, found)) == list(map(sorted, groups))


@pytest.mark.parametrize(
    ("unknown", "here", "groups"),
    [
        (
            ["learning_controller"],
            ["spindle_encoder", "electrodynamic_actuator", "tool"],
            [["spindle_encoder"], ["electrodynamic_actuator", "tool"]],
        ),
        (["tool"], LAWS, [LAWS]),  # what they read of it is late
        (
            ["electrodynamic_actuator"],
            ["spindle_encoder", "learning_controller", "tool"],
            [["spindle_encoder", "learning_controller"], ["tool"]],
        ),
    ],
)
def test_what_is_read_of_a_member_that_nobody_knows_cuts_a_chain(unknown, here, groups):
    """Nodes of one process wait for a third-party member between them.

    A member may need in each block what the chain has computed of that block.
    """
    found = _groups(announced(full_cell(), *unknown), dict.fromkeys(here))
    assert list(map(sorted, found)) == list(map(sorted, groups))


@pytest.mark.parametrize(
    ("split", "chains"),
    [
        (None, [LAWS + LOOPS + CUT]),
        ([[*LAWS, "tool"], [*LOOPS, "cutting_process", "recorder"]], [LAWS, LOOPS]),
    ],
    ids=["composed", "two processes that wait for each other in each block"],
)
def test_chains_give_the_digests_of_the_offline_run(split, chains):
    """With an event, a fault, and a block that divides neither the run nor the feedback."""
    events = "learning_controller.events=['revolution 1.5: freeze', 'revolution 2: learn']"
    faults = "electrodynamic_actuator.faults=['revolution 1.2 to 1.7: coarse/state.measured_position wrong scale=1.01']"
    cell = full_cell("block_size=48", "allow_faults=true", events, faults)
    told = []
    mode = "composed" if split is None else "processes"
    result = harness.run(cell, mode=mode, groups=split, watch=told.append)
    assert result.digest == harness.run(cell).digest
    assert sorted(map(sorted, chains)) == sorted(sorted(e["nodes"]) for e in told if e["event"] == "chain")


def test_a_chain_that_is_given_up_goes_on_with_the_same_bits(tmp_path):
    """A node fails in its midst: until then, and what does not depend on it after that, is as in a run without."""
    path, lost, told = resources.find(Path("supervised.yaml")), tmp_path / "nowhere" / "memory", []
    broken = [f"learning_controller.memory_file={lost}", "learning_controller.events=['revolution 5: save']"]
    with pytest.raises(LatheError, match="cannot be saved"):
        harness.run(
            scenario.load(path, ["spindle_encoder.revolutions=20", *broken]),
            mode="composed",
            bag=tmp_path / "bag",
            watch=told.append,
        )
    assert [event["event"] for event in told if event["event"] in ("chain", "safe")] == ["chain", "safe"]
    whole = harness.run(scenario.load(path, ["spindle_encoder.revolutions=20"])).recording.dense
    found = reader.read_bag(tmp_path / "bag", whole=True).dense
    angle = found["/encoder"]["angle"]
    at = int(np.searchsorted(angle, 5 * 2 * np.pi)) - 2048  # it fails with all that it computes in one go
    assert 0 < at < angle.size - 3000
    assert np.array_equal(angle, whole["/encoder"]["angle"][: angle.size])
    for topic, signals in found.items():
        for name, array in signals.items():
            assert np.array_equal(array[:at], whole[topic][name][:at]), f"{topic}.{name}"
