# SPDX-License-Identifier: Apache-2.0
"""Each scenario of config/ runs, and gives the same bits in one process of nodes as offline."""

import pytest
from cells import EVERY_KIND, SCENARIOS, every_scenario

from lathe_rc import harness
from lathe_rc.cell import scenario
from lathe_rc.cell.wiring import Cell


@pytest.mark.parametrize("path", every_scenario())
def test_composed_nodes_and_blocks_of_another_length_give_the_digests_of_the_offline_run(path):
    short = ["spindle_encoder.revolutions=3.0"]
    offline = harness.run(scenario.load(path, short))
    size = min(17, offline.scenario.shared.block_size - 1)
    other = scenario.load(path, [*short, f"block_size={size}"])
    assert harness.run(other, mode="composed").digest == offline.digest


def test_the_scenarios_of_the_ordinary_tests_have_every_kind_of_node_and_signal():
    """The other scenarios run with ``--system``."""
    found = {
        path.stem: {
            (loaded.kind(node), port.type)
            for loaded in [scenario.load(path)]
            for node, stage in Cell(loaded.nodes).stages.items()
            for port in stage.outputs
        }
        for path in SCENARIOS
    }
    assert set.union(*found.values()) == set.union(*(found[name] for name in EVERY_KIND))


WITH_A_TOOL = [path for path in SCENARIOS if "\n/tool:" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", WITH_A_TOOL, ids=lambda path: path.stem)
def test_whole_scenario_cuts_the_form_error(path):
    """To its end and with its events, a scenario cuts the form error to a hundredth.

    What scenarios without a tool promise is in test_feed_cell.py.
    """
    result = harness.run(scenario.load(path))
    assert result.errors.rms[-1] < 0.01 * result.errors.rms[0]
