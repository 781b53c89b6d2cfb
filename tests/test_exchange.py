# SPDX-License-Identifier: Apache-2.0
"""Blocks that the nodes of one process hand over to each other."""

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from lathe_rc.harness import free_domain  # noqa: E402
from lathe_rc.nodes.cell_node import CellNode  # noqa: E402
from lathe_rc.nodes.exchange import Exchange  # noqa: E402
from lathe_rc.nodes.report import Reporter  # noqa: E402
from lathe_rc.nodes.spindle_role import SpindleRole  # noqa: E402
from lathe_rc.protocol import Progress  # noqa: E402


@pytest.fixture
def spindle(monkeypatch):
    """A spindle of a short run with one member, in a process with an exchange; not yet running."""
    given = ["members:=['eager']", "window:=3", "speed_factor:=0.0", "revolutions:=0.3"]
    with free_domain() as domain:
        rclpy.init(args=["test", "--ros-args", *(part for text in given for part in ("-p", text))], domain_id=domain)
        try:
            node = CellNode("spindle_encoder", "spindle_encoder", SpindleRole, Reporter(), Exchange())
            node.trigger_configure()
            node.exchange.join(node.protocol.own.publishes)
            yield node
            # Left alive, it would hand its blocks to the next cell in this domain.
            node.destroy_node()
        finally:
            rclpy.shutdown()


def begin(spindle):
    """Let the run begin, as if its member were ready."""
    spindle.trigger_activate()
    spindle.protocol.begun(0.0)
    spindle.attempt(lambda: spindle.protocol.start(0.0))
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
