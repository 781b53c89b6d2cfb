# SPDX-License-Identifier: Apache-2.0
"""``lathe compare``: the figures of several runs share their scales, a revolution and a tolerance."""

import base64
import re
from types import SimpleNamespace

import numpy as np
import pytest
from bags import lathe
from cells import config, scenario
from numpy.testing import assert_allclose
from shown_page import ShownPage

from lathe_rc import harness
from lathe_rc.analysis.tolerance import judge
from lathe_rc.drawing.charts import Charts, chart, rows
from lathe_rc.judge.part import Tolerances
from lathe_rc.view import compare_figures as figures
from lathe_rc.view.report_gather import gather


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Two runs of which the second learns more slowly and ends earlier, their results and their page."""
    folder = tmp_path_factory.mktemp("compare")
    results = {}
    for name, gain, revolutions in (("fast", 1.0, 9.2), ("slow", 0.4, 7.2)):
        cell = scenario(
            spindle_encoder={"revolutions": revolutions},
            learning_controller={"learning_gain": gain},
            tool={"tolerance": 3e-6},
        )
        results[name] = harness.run(cell, bag=folder / name)
    done = lathe("compare", folder / "fast", folder / "slow", "-o", folder / "page.html")
    assert done.exit_code == 0, done.output
    page = ShownPage((folder / "page.html").read_text(encoding="utf-8"))
    forms = {name: gather(folder / name).forms[0] for name in results}
    return SimpleNamespace(folder=folder, results=results, page=page, forms=forms)


def test_the_page_names_the_parameters_that_differ_and_no_others(compared):
    assert [row[0] for row in compared.page.rows("Parameters that differ")] == [
        "learning_controller.learning_gain",
        "spindle_encoder.revolutions",
    ]


def test_the_maps_are_those_of_the_runs_and_their_difference(compared):
    found = figures.compared(compared.forms, 0.0)
    for name, result in compared.results.items():
        profiles = result.part.profile.reshape(len(result.part.profile), 128, -1).mean(axis=-1) * 1e6
        assert_allclose(found.maps[name][: len(profiles)], profiles, rtol=1e-12, atol=1e-9)
        assert np.isnan(found.maps[name][len(profiles) :]).all()
    assert_allclose(found.differences["slow − fast"], found.maps["slow"] - found.maps["fast"])
    itself = figures.compared({"a": compared.forms["fast"], "b": compared.forms["fast"]}, 0.0)
    assert not itself.differences["b − a"].any()


def test_a_long_run_is_averaged_together_with_a_short_one(compared, monkeypatch):
    monkeypatch.setattr(figures, "_FIELDS", 4 * 3 * 128)  # 4 rows a map
    found = figures.compared(compared.forms, 0.0)
    assert found.step == 3
    fine = compared.results["fast"].part.profile.reshape(9, 128, -1).mean(axis=-1) * 1e6
    assert_allclose(found.maps["fast"], fine.reshape(3, 3, 128).mean(axis=1), atol=1e-9)


@pytest.mark.parametrize(("tolerance", "doubt"), [(0.5, 0.0), (3.0, 0.0), (12.0, 0.0), (12.0, 8.0), (500.0, 0.0)])
def test_the_strip_tells_the_verdict_of_any_tolerance(compared, tolerance, doubt, monkeypatch):
    charts = Charts()
    monkeypatch.setattr(compared.forms["slow"], "tolerances", Tolerances(doubt=doubt * 1e-6))
    together = figures.compared(compared.forms, tolerance * 1e-6)
    charts.data.update(together.data)
    (place,) = charts.place([figures.verdicts(together)])
    drawn = base64.b64decode(charts.picture(place, 1).partition(",")[2]).decode()
    for name, result in compared.results.items():
        since = judge(result.part.form.largest, tolerance * 1e-6, doubt=compared.forms[name].tolerances.doubt).since
        told = f"within the tolerance from revolution {since} on" if since else "not within the tolerance at the end"
        assert re.search(f">{name}: {told}<", drawn)


def test_a_static_picture_stays_small_however_many_marks_it_has():
    """A few are drawn as SVG, many as JPEG, so that a page is smaller than 3 MB whatever the run."""
    for count, kind in ((100, "svg+xml"), (20_000, "jpeg")):
        data = {"values": rows(x=np.arange(count), y=np.random.default_rng(1).standard_normal(count))}
        encoding = {"x": {"field": "x", "type": "quantitative"}, "y": {"field": "y", "type": "quantitative"}}
        charts = Charts()
        (place,) = charts.place([chart(200, data=data, mark="line", encoding=encoding)])
        picture = charts.picture(place, 1)
        assert picture.startswith(f"data:image/{kind};base64,")
        assert len(picture) < 300_000


def test_a_scenario_runs_first_and_nodes_that_only_it_has_are_folded(compared, tmp_path):
    page = tmp_path / "page.html"
    (tmp_path / "short.yaml").write_text(config("supervised", "spindle_encoder.revolutions=5").to_yaml())
    done = lathe("compare", tmp_path / "short.yaml", compared.folder / "fast", "-o", page)
    assert done.exit_code == 0, done.output
    shown = ShownPage(page.read_text(encoding="utf-8"))
    assert [row[:2] for row in shown.rows("")] == [["short", "5"], ["fast", "9"]]
    common, folded = shown.source.split("<details>")
    assert "spindle_encoder.revolutions" in common
    assert "supervisor.force_limit" in folded
    assert "supervisor.force_limit" not in common
