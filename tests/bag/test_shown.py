# SPDX-License-Identifier: Apache-2.0
"""Scenarios, results and recordings at a prompt or in a notebook, and the figure of a run."""

import warnings
from xml.etree import ElementTree as ET

import pytest
from cells import SCENARIOS, config, run, scenario

from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.cell.scenario import Scenario, load
from lathe_rc.errors import InputError

LONGEST = 200  # characters of a line that a prompt shows


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return harness.run(scenario(), bag=tmp_path_factory.mktemp("shown") / "bag")


def rows(html):
    """The texts in the cells of a table, by row."""
    whole = ET.fromstring(f"<div>{html}</div>")  # noqa: S314 - our own
    return [["".join(cell.itertext()) for cell in row] for row in whole.iter("tr")]


def test_a_result_is_a_line_with_host_errors_and_bag(result):
    first, *_, last = result.errors.rms * 1e6
    assert repr(result) == (
        f"<Result of test: offline, 3 revolutions, form error {first:.4g} to {last:.4g} µm RMS, bag {result.bag}>"
    )


def test_a_result_in_a_notebook_says_the_same_and_draws_the_errors(result):
    html = result._repr_html_()
    told = dict(rows(html))
    assert (told["scenario"], told["host"], told["bag"]) == ("test", "offline", str(result.bag))
    assert f"form error {told['form error']}" in repr(result)
    assert html.count('<img alt="form error by revolution" src="data:image/png;base64,') == 1
    assert len(html) < 40_000


def test_what_has_no_revolution_says_so():
    short = run(spindle_encoder={"revolutions": 0.5})
    assert repr(short) == "<Result of test: offline, 0 revolutions, no bag>"
    assert "<img" not in short._repr_html_()
    alone = harness.run(Scenario("spindle", {"spindle_encoder": scenario().nodes["spindle_encoder"]}))
    assert "3 revolutions" in repr(alone.recording)
    for made, why in ((short, "no complete revolution; let it run longer"), (alone, "no tool; record both")):
        with pytest.raises(InputError, match=f"^nothing to draw: the recording has {why}"):
            made.plot()


def test_what_has_no_part_tells_the_errors_of_its_loops():
    """Two revolutions of three are complete with their measurements."""
    held = harness.run(config("approach", "spindle_encoder.revolutions=3"))
    first, last = held.loops["position_controller"].found.errors.rms * 1e6
    error = f"{first:.4g} to {last:.4g} µm RMS"
    assert repr(held) == f"<Result of approach: offline, 3 revolutions, position error {error}, no bag>"
    assert dict(rows(held._repr_html_()))["position error"] == error


def test_a_recording_lists_its_topics_with_units(result):
    recording = reader.read_bag(result.bag)
    assert repr(recording) == repr(result.recording)
    assert len(repr(recording)) < LONGEST
    told = {row[0]: row[1:] for row in rows(recording._repr_html_())}
    assert told["/tool"][0] == f"{result.samples} samples"
    assert "error [m]" in told["/tool"][1]
    assert told["/coarse/learning"][0] == "2 messages"


def test_every_scenario_is_a_line_and_a_table_of_what_is_set():
    for path in SCENARIOS:
        loaded = load(path)
        assert repr(loaded).startswith(f"<Scenario {path.stem}: ")
        assert len(repr(loaded)) < 2 * LONGEST
        assert [row[0] for row in rows(loaded._repr_html_())[1:]] == ["all nodes", *loaded.nodes]
        assert str(path.parents[1]) not in loaded._repr_html_()  # files by their names


def test_a_scenario_shows_what_is_set_and_only_that():
    """Names that look like HTML too."""
    made = scenario(edge={"stage": "tool", "feed": 1e-4}, other={"stage": "tool", "remap": ["tool:=a<b>"]})
    head, *told = rows(Scenario("<b>&", made.nodes)._repr_html_())
    assert head[0] == "<b>&"
    assert ["all nodes", "", "run_id = test"] in told
    assert ["tool", "", ""] in told
    assert told[-2:] == [["edge", "tool", "feed = 0.0001 m/rev"], ["other", "tool", "remap = ['tool:=a<b>']"]]


class TestPlot:
    def test_has_the_errors_of_the_run(self, result):
        drawn = result.plot()
        form, over_angle, curve = drawn.axes
        assert drawn.get_suptitle() == "test"
        largest, rms = (line.get_ydata().tolist() for line in curve.get_lines())
        assert largest == (result.errors.largest * 1e6).tolist()
        assert rms == (result.errors.rms * 1e6).tolist()
        first, last = over_angle.get_lines()
        assert max(first.get_ydata()) == pytest.approx(result.errors.largest[0] * 1e6)
        assert max(last.get_ydata()) == pytest.approx(result.errors.largest[-1] * 1e6)
        assert len(form.get_lines()) == 2

    def test_of_a_bag_is_that_of_its_run_and_shown_by_a_notebook_without_pyplot(self, result):
        png = result.plot()._repr_png_()
        assert png.startswith(b"\x89PNG")
        assert reader.read_bag(result.bag).plot("test")._repr_png_() == png

    def test_of_a_snapshot_counts_the_revolutions_of_the_run(self, tmp_path):
        recorder = {"mode": "both", "pre": 0.03, "post": 0.15, "triggers": ["*: freeze"]}
        events = {"events": ["sample 9000: freeze"]}
        cell = scenario(spindle_encoder={"revolutions": 5.0}, learning_controller=events, recorder=recorder)
        snapshot = reader.read_bag(harness.run(cell, bag=tmp_path / "bag").snapshots[0])
        _, over_angle, curve = snapshot.plot().axes
        assert curve.get_lines()[0].get_xdata().tolist() == [3, 4]
        assert over_angle.get_lines()[0].get_label().startswith("revolution 3: ")

    def test_of_a_round_part_that_is_met_at_once(self):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            run(tool={"harmonic_order": [1], "harmonic_amplitude": [0.0], "harmonic_phase": [0.0]}).plot()._repr_png_()
