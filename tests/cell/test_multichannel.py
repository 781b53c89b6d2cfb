# SPDX-License-Identifier: Apache-2.0
"""Cells with two channels: the structures of paper 001, in every host, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from cells import in_two, of_nodes
from machines import line_of

from lathe_papers import cells
from lathe_rc import harness
from lathe_rc.cell import scenario
from lathe_rc.cell.wiring import Cell

CONFIG = Path(__file__).parents[2] / "config"
SHORT = {"spindle_encoder": {"revolutions": 4.0}}


def error(result):
    return result.recording.dense["/tool"]["error"]


@pytest.mark.parametrize(
    "structure",
    ["direct_compensation", *(pytest.param(each, marks=pytest.mark.system) for each in ("two_channel", "series"))],
)
def test_processes_give_the_digests_of_the_offline_run(structure):
    """Processes give the offline bits also with a channel more, or a drive that compensates within the sample."""
    loaded = cells.load(structure, **SHORT)
    offline, processes = harness.run(loaded), harness.run(loaded, mode="processes", groups=in_two(loaded))
    assert processes.digest == offline.digest
    assert offline.dropped == processes.dropped == 0


def test_series_drive_with_a_light_tool_is_the_two_drives():
    """The same topics, so the same controllers; what remains is the tool's inertia, which bends the piezo a little."""
    apart = harness.run(cells.load("two_channel", **SHORT))
    series = harness.run(series_cell(mass_ratio=1e-9))
    assert np.abs(error(series) - error(apart)).max() < 1e-3 * np.abs(error(apart)).max()


def series_cell(mass_ratio):
    """The two-channel cell with both drives as one mechanical system."""
    nodes = cells.load("two_channel", **SHORT).nodes
    kept = {name: table for name, table in nodes.items() if name not in ("electrodynamic_actuator", "piezo_actuator")}
    common = {name: getattr(nodes["tool"], name) for name in ("sample_rate", "block_size", "nominal_rpm", "run_id")}
    table = scenario.TABLES["series_drive"].read("series_drive", {**common, "mass_ratio": mass_ratio})
    return of_nodes("series", {**kept, "series_drive": table})


def test_undamped_piezo_in_a_learning_channel_is_refused_with_the_worst_frequency():
    bare = {"damping": 0.02, "amplifier_lag": 40e-6}
    loaded = cells.load("two_channel", piezo_actuator=bare)
    refusal = line_of(lambda: harness.run(loaded))
    told = refusal
    assert told.startswith("fine_controller: learning diverges with piezo_actuator: sup|Q - Z| = 2")
    frequency = float(told.split(" rad/s", maxsplit=1)[0].rsplit(" ", 1)[1])
    assert frequency == pytest.approx(14600.0, rel=0.01)


def test_fine_channel_waits_until_the_error_before_it_is_within_its_stroke():
    result = cells.run("two_channel", spindle_encoder={"revolutions": 8.0})
    status = result.recording.sparse["/fine/learning"].values
    within = [largest <= 15e-6 for largest in status["max_error"]]
    joined = status["joined"].index(True)
    assert 0 < joined == within.index(True)
    assert result.recording.sparse["/fine_controller/events"].values["action"] == ["joined"]


def test_coarse_channel_learns_from_its_own_error():
    """Fed with the total it would leave to the piezo what the piezo does (spec/learning.md)."""
    shared, longer = {}, {"spindle_encoder": {"revolutions": 40.0}}
    own = cells.run("direct_compensation", shared, **longer)
    total = cells.run("direct_compensation", shared, **longer, learning_controller={"finer": []})
    assert own.errors.rms[-1] < 0.1 * total.errors.rms[-1]


def test_vibration_is_cancelled_by_direct_compensation_two_to_three_times_and_more():
    def rms(compensates):
        loaded = cells.load("vibration", piezo_actuator={"compensates": compensates})
        signals = harness.run(loaded).recording
        return np.std(signals.dense["/tool"]["error"][-4 * 3840 :])

    assert rms(["coarse"]) > 2 * rms(["coarse", "vibration"])


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.yaml")), ids=lambda path: path.stem)
def test_every_scenario_passes_its_check(path):
    Cell(scenario.load(path).nodes).check()
