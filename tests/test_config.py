# SPDX-License-Identifier: Apache-2.0
"""Every scenario that comes with lathe_rc runs, and gives the same bits in one process of nodes as offline."""

from pathlib import Path

import pytest

from lathe_rc import harness
from lathe_rc.cell import scenario

SCENARIOS = sorted((Path(__file__).parents[1] / "config").glob("*.yaml"))


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_composed_nodes_give_the_digests_of_the_offline_run(path):
    loaded = scenario.load(path, ["spindle_encoder.revolutions=3.0"])
    assert harness.run(loaded, mode="composed").digest == harness.run(loaded).digest


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_whole_scenario_cuts_the_form_error(path):
    """To its end, with its events."""
    result = harness.run(scenario.load(path))
    assert result.errors.rms[-1] < 0.01 * result.errors.rms[0]
