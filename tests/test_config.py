# SPDX-License-Identifier: Apache-2.0
"""Each scenario of config/ runs, and gives the same bits in one process of nodes as offline."""

from collections import Counter

import pytest
from cells import SCENARIOS

from lathe_rc import harness
from lathe_rc.cell import scenario
from lathe_rc.cell.wiring import Cell

#: scenarios that differ from another by numbers alone: the same topics, and the same compiled steps
LIKE = {
    "adaptive_inverse": "piston",
    "exact_invariance": "piston",
    "one_channel": "piston",
    "speed_deviation": "piston",
    "interrupted_cut": "force_turning",
    "lead_lag": "two_channel",
}
BY_NAME = {path.stem: path for path in SCENARIOS}


@pytest.mark.parametrize("name", [name for name in BY_NAME if name not in LIKE])
def test_composed_nodes_give_the_digests_of_the_offline_run(name):
    loaded = scenario.load(BY_NAME[name], ["spindle_encoder.revolutions=3.0"])
    assert harness.run(loaded, mode="composed").digest == harness.run(loaded).digest


def form(name):
    """Kind, topics and compiled step of each node of a scenario, in any order."""
    loaded = scenario.load(BY_NAME[name])
    return Counter(
        (
            loaded.kind(node),
            *(tuple(port.topic for port in ports) for ports in (stage.inputs, stage.outputs)),
            stage.native().name if stage.is_compiled else "",
        )
        for node, stage in Cell(loaded.nodes).stages.items()
    )


@pytest.mark.parametrize(("name", "other"), LIKE.items())
def test_a_scenario_that_does_not_run_composed_differs_from_one_that_does_by_numbers_alone(name, other):
    assert other not in LIKE
    assert form(name) == form(other)


WITH_A_TOOL = [path for path in SCENARIOS if "\n/tool:" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", WITH_A_TOOL, ids=lambda path: path.stem)
def test_whole_scenario_cuts_the_form_error(path):
    """To its end and with its events, a scenario cuts the form error to a hundredth.

    What scenarios without a tool promise is in test_feed_cell.py.
    """
    result = harness.run(scenario.load(path))
    assert result.errors.rms[-1] < 0.01 * result.errors.rms[0]
