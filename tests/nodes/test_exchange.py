# SPDX-License-Identifier: Apache-2.0
"""Blocks that the nodes of one process hand over to each other."""

import numpy as np
import pytest

pytest.importorskip("rclpy")

import leading

from lathe_rc.nodes.spindle_role import SpindleRole
from lathe_rc.protocol import Progress


@pytest.fixture
def spindle():
    """A spindle of a short run with one member, in a process with an exchange; not yet running."""
    with leading.time_master("spindle_encoder", SpindleRole, window=3, speed_factor=0.0, revolutions=0.3) as node:
        yield node


def begin(spindle):
    """Let the run begin, as if its member were ready."""
    leading.begin(spindle)
    while spindle.protocol.credit and not spindle.protocol.failure:  # it looks at its members between two bursts
        spindle.attempt(spindle.role.release)


def test_a_member_that_completes_a_block_at_once_does_not_get_it_twice(spindle):
    """A member that completes a block at once gets it once.

    It tells the spindle while the spindle is still at that very block.
    """
    seen = []

    def complete(delivery):
        seen.append(delivery.block.first_index)
        spindle.exchange.master(Progress("", "/eager", len(seen), 64 * len(seen)))

    spindle.exchange.listen("/encoder", "/eager", complete)
    begin(spindle)
    while spindle.due:  # as the loop of its process
        spindle.due = False
        spindle.work()
    assert spindle.protocol.done
    assert seen == list(range(0, 64 * len(seen), 64))


def test_what_is_handed_over_is_not_written_to_again(spindle):
    """Arrays that a node has handed to the nodes of its process never change."""
    blocks = []
    spindle.exchange.listen("/encoder", "/eager", blocks.append)
    begin(spindle)
    angle = np.concatenate([run.block.signals["angle_true"] for run in blocks])
    assert len(blocks) == 3  # the window
    assert np.all(np.diff(angle) > 0.0)


def test_blocks_that_may_go_at_once_go_in_one_piece(spindle):
    """Released blocks go to the nodes of the same process in one piece.

    Half of what the window lets go, so that others can begin with it.
    """
    runs = []
    spindle.exchange.listen("/encoder", "/eager", runs.append)
    spindle.role.together = 2
    begin(spindle)
    assert [(run.block.first_index, run.block.samples) for run in runs] == [(0, 128), (128, 64)]
    assert [len(run.companions) for run in runs] == [2, 1]
    assert spindle.role.blocks == 3


def test_a_sample_that_is_not_finite_is_refused_where_it_is_made(spindle, monkeypatch):
    spindle.exchange.listen("/encoder", "/eager", list)

    def spoil(first, inputs, outputs):
        outputs[0]["speed"][:] = 1.0
        for name in ("angle", "angle_true", "speed_true"):
            outputs[0][name][:] = 1.0
        outputs[0]["speed"][5] = np.nan
        return []

    monkeypatch.setattr(spindle.role.stage, "process", spoil)
    begin(spindle)
    wrong = "/encoder: /spindle_encoder sends speed = nan at sample 5; allowed: finite"
    assert str(spindle.protocol.failure).startswith(wrong)


def test_a_transition_that_breaks_fails_the_node(spindle, monkeypatch):
    """rclpy swallows what a transition raises; the others would wait for a node that never comes."""

    def breaks():
        raise StopIteration("no types")

    monkeypatch.setattr(spindle.role, "activate", breaks)
    spindle.trigger_activate()
    assert str(spindle.protocol.failure) == "spindle_encoder: StopIteration: no types"
