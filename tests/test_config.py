# SPDX-License-Identifier: Apache-2.0
"""Every scenario that comes with lathe_rc runs, and gives the same bits in one process of nodes as offline."""

import pytest
from cells import SCENARIOS

from lathe_rc import harness
from lathe_rc.cell import scenario


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_composed_nodes_give_the_digests_of_the_offline_run(path):
    loaded = scenario.load(path, ["spindle_encoder.revolutions=3.0"])
    assert harness.run(loaded, mode="composed").digest == harness.run(loaded).digest


WITH_A_TOOL = [path for path in SCENARIOS if "\n/tool:" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", WITH_A_TOOL, ids=lambda path: path.stem)
def test_whole_scenario_cuts_the_form_error(path):
    """To its end and with its events, a scenario cuts the form error to a hundredth.

    What scenarios without a tool promise is in test_feed_cell.py.
    """
    result = harness.run(scenario.load(path))
    assert result.errors.rms[-1] < 0.01 * result.errors.rms[0]
