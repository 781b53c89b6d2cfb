# SPDX-License-Identifier: Apache-2.0
"""``lathe sweep show``: the page and the pictures of a sweep, and the numbers on them."""

import json
import math
import re
from pathlib import Path

import altair as alt
import numpy as np
import pyarrow as pa
import pytest
from click.testing import CliRunner
from matplotlib.image import imread
from numpy.testing import assert_allclose
from shown_page import ShownPage

from lathe_rc import cli, resources
from lathe_rc.cell import scenario
from lathe_rc.errors import InputError, LatheError
from lathe_rc.sweep import page, row
from lathe_rc.sweep.effects import Axis, Yield, bins, effect, is_grid
from lathe_rc.sweep.folder import Folder
from lathe_rc.sweep.page_data import PageData
from lathe_rc.sweep.space import Space
from lathe_rc.view import charts

LEAD, Q = "learning_controller.lead_time", "learning_controller.q_time"
DAMPING, LAW = "electrodynamic_actuator.damping", "learning_controller.lead_law"
PISTON = scenario.load(resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=10"])
EXTERNAL = re.compile(r"""(?:src|href|action)=["'](?!data:)|url\((?!data:)|@import""")
LARGEST = 3_000_000  # [B] of a page


def shown_page(folder):
    return ShownPage((folder.path / "page.html").read_text(encoding="utf-8"))


def swept(place, space, outcome, cell=PISTON):
    """A folder whose cells came to what a function of their values says: an error [m], or a status and a reason."""
    folder = Folder.begin(place, cell, space, [])
    rows = []
    for number, values in enumerate(space.cells(cell)):
        came = outcome(values)
        row = {"cell": number, "key": f"{number:032d}", "limits": "", **values, "seed": values.get("seed", 0)}
        if isinstance(came, tuple):
            row |= dict(zip(("status", "reason"), came, strict=True))
        else:
            row |= {"status": "done", "tool.max_error": came, "tool.rms_error": came / 3, "margin": 0.5 - came * 1e3}
        rows.append(row)
    folder.write([pa.Table.from_pylist(rows, folder.schema)])
    return folder


def bowl(values):
    """Best at a lead of 1.4 ms; a lead from 2.5 ms on is refused."""
    if values[LEAD] > 2.5e-3:
        return "refused", f"learning_controller: grows {values[LEAD]:.6g} times a cycle; allowed: below 1"
    return 1e-7 * (1.0 + (values[LEAD] / 1.4e-4 - 10.0) ** 2) * (1.0 + abs(math.log(values.get(Q, 6e-5) / 6e-5)))


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    space = Space(grid={LEAD: "1e-3:3e-3:9", Q: "1e-5:1e-3:7:log", LAW: ["constant_angle", "variable"]})
    folder = swept(tmp_path_factory.mktemp("grid") / "sweep", space, bowl)
    return folder, page.write(folder), shown_page(folder)


@pytest.fixture(autouse=True)
def no_library(monkeypatch):
    """Pages of single tests do without the scripts, which take seconds; that of the grid has them."""
    monkeypatch.setattr(charts, "library", lambda: "")


class TestEffects:
    def ishigami(self, count=4096):
        """Points of a sample, and Ishigami's function with a = 7, b = 0.1 there."""
        from scipy.stats import qmc

        x = (qmc.Sobol(3, rng=1).random(count) * 2.0 - 1.0) * np.pi
        y = np.sin(x[:, 0]) + 7.0 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
        return [Axis(f"x{place}", f"x{place}", column) for place, column in enumerate(x.T)], y

    def test_shares_of_a_known_function(self):
        """Its first-order indices are 0.3139, 0.4424 and 0 (Ishigami and Homma 1990)."""
        axes, y = self.ishigami()
        assert_allclose([effect(axis, y).share for axis in axes], [0.3139, 0.4424, 0.0], atol=0.02)

    def test_ranks_of_a_known_function(self):
        """x1 rises with it over half its range alone; x2 and x3 enter as even functions."""
        axes, y = self.ishigami()
        assert_allclose([effect(axis, y).rank for axis in axes[1:]], [0.0, 0.0], atol=0.03)
        rising = effect(axes[0], np.exp(axes[0].values))
        assert rising.rank == pytest.approx(1.0)

    def test_chance_explains_nothing(self):
        """The share of noise is 0 but for its own spread, however many bins; the raw one would be m/n."""
        noise = np.random.default_rng(3)
        shares = [effect(Axis("x", "x", noise.random(100)), noise.random(100)).share for _ in range(200)]
        assert abs(np.mean(shares)) < 0.01

    def test_a_grid_has_exact_main_effects(self):
        """y = 2a + b + 3ab on -1, 1: the shares are 4, 1 and 9 of 14."""
        a, b = (side.ravel() for side in np.meshgrid([-1.0, 1.0], [-1.0, 1.0], indexing="ij"))
        a, b = np.tile(a, 3), np.tile(b, 3)
        axes = [Axis("a", "a", a), Axis("b", "b", b)]
        y = 2 * a + b + 3 * a * b
        assert is_grid(axes, y)
        assert_allclose([effect(axis, y, exact=True).share for axis in axes], [4 / 14, 1 / 14], rtol=1e-12)
        assert not is_grid(axes, np.where(np.arange(12) == 5, np.nan, y))
        assert not is_grid([Axis("a", "a", a[:11]), Axis("b", "b", b[:11])], y[:11])

    def test_too_few_cells_say_nothing(self):
        assert effect(Axis("x", "x", np.arange(7.0)), np.arange(7.0)).share is None
        assert effect(Axis("x", "x", np.arange(9.0)), np.ones(9)).share is None

    def test_bins_of_a_log_range_are_wide_in_the_logarithm(self):
        values = np.geomspace(1.0, 1e4, 1000)
        found = bins(Axis("x", "x", values, log=True), exact=10, most=4)
        assert_allclose(found.low, [1.0, 10.0, 100.0, 1000.0])
        assert_allclose(np.bincount(found.index), [250, 250, 250, 250], atol=1)
        single = bins(Axis("x", "x", np.array([1.0, 100.0, 10.0]), log=True), exact=3, most=2)
        assert single.index.tolist() == [0, 2, 1]
        assert_allclose(single.high[:2], single.low[1:])


class TestYield:
    def test_points_and_shares(self):
        found = Yield(np.arange(1.0, 99.0), 100)  # two cells have no goal
        assert found.share(50.0) == 0.5
        assert found.share(0.0) == 0.0
        assert found.point(0.95) == 95.0
        assert found.point(0.99) is None
        assert found.share(found.point(0.98)) == 0.98

    def test_of_what_is_to_be_large(self):
        found = Yield(np.arange(1.0, 101.0), 100, above=True)
        assert found.share(51.0) == 0.5
        assert found.point(0.95) == 6.0
        limits, shares = found.curve(7)
        assert [found.share(limit) for limit in limits] == shares.tolist()

    def test_a_thinned_curve_lies_on_the_whole_one(self):
        found = Yield(np.sort(np.random.default_rng(0).random(1000)), 1100)
        limits, shares = found.curve(40)
        assert [found.share(limit) for limit in limits] == shares.tolist()
        assert (limits[0], limits[-1]) == (found.goal[0], found.goal[-1])

    def test_interval_is_that_of_wilson(self):
        """99 of 100: 0.9455 to 0.9982."""
        assert_allclose(Yield(np.arange(100.0), 100).interval(98.0), (0.9455, 0.9982), atol=5e-5)


class TestPage:
    def test_needs_nothing_else_and_is_small(self, grid):
        _, written, shown = grid
        body = shown.source[: shown.source.index("<script>")]
        assert not EXTERNAL.search(body)
        assert "default-src 'none'" in body
        assert "window.vegaEmbed=" in shown.source
        assert written.page.stat().st_size < LARGEST

    def test_has_a_figure_and_a_picture_of_each_kind(self, grid):
        folder, written, shown = grid
        names = {"heat-map", "lines", "sensitivity", "parallel-coordinates", "yield"}
        assert set(shown.specs) == names
        assert {path.stem for path in (folder.path / "figures").iterdir()} == names
        for path in written.figures:
            pixels = imread(path)[..., :3]
            assert min(pixels.shape[:2]) > 200
            assert pixels.std() > 0.02, f"{path.name} is blank"

    def test_specifications_are_those_of_vega_lite(self, grid):
        shown = grid[2]
        for name, specs in shown.specs.items():
            for spec in specs.values() if name != "parallel-coordinates" else ():
                alt.Chart.from_dict(spec)

    def test_every_pair_can_be_chosen(self, grid):
        shown = grid[2]
        assert set(shown.specs["heat-map"]) == {"0-1", "0-2", "1-0", "1-2", "2-0", "2-1"}
        assert set(shown.specs["lines"]) == {"0-", "1-", "2-", *shown.specs["heat-map"]}
        named = [spec["data"]["name"] for name in ("heat-map", "lines") for spec in shown.specs[name].values()]
        assert set(named) <= shown.data.keys()

    def test_counts_what_came_of_the_cells_with_their_reasons(self, grid):
        """Two leads of nine are refused; their reasons differ in a number alone, so they are one row."""
        rows = grid[2].rows("Outcomes")
        assert [row[:3] for row in rows] == [["done", "98", "77.8%"], ["refused", "28", "22.2%"]]
        assert rows[1][3] == "cell 98: learning_controller: grows 0.00275 times a cycle; allowed: below 1"

    def test_says_what_was_asked_for(self, grid):
        rows = grid[2].rows("What was varied")
        assert [f"{LEAD} [s]", "1e-3:3e-3:9", "0.001", "0.003", "9", "0.001425"] in rows
        assert [LAW, "constant_angle, variable", "", "", "2", "variable"] in rows

    def test_lists_the_best_cells_in_order(self, grid):
        folder, _, shown = grid
        rows = shown.rows("Best cells")
        table = folder.table(["cell", "tool.max_error"]).sort_by(
            [("tool.max_error", "ascending"), ("cell", "ascending")]
        )
        assert [row[0] for row in rows] == [str(cell) for cell in table.column("cell").to_pylist()[: len(rows)]]
        assert float(rows[0][4]) == pytest.approx(table.column("tool.max_error")[0].as_py() * 1e6, rel=1e-3)

    def test_a_map_holds_every_cell_once(self, grid):
        """Fields are medians of the cells; where all are refused there is none."""
        folder, _, shown = grid
        fields = shown.data["pair-0-1"]
        assert sum(field["n"] for field in fields) == 126
        assert sum(field["d"] for field in fields) == 98
        assert all((field["m"] is None) == (field["d"] == 0) for field in fields)
        (lead,) = [row for row in shown.data["bins-0"] if row["t"] == "0.00125"]
        table = folder.table([LEAD, Q, "tool.max_error"]).to_pylist()
        small = [row["tool.max_error"] for row in table if row[LEAD] == 1.25e-3 and row[Q] == 1e-5]
        (field,) = [field for field in fields if (field["a"], field["b"]) == (lead["i"], 0)]
        assert field["m"] == pytest.approx(np.median(small) * 1e6, rel=1e-4)

    def test_axes_of_log_ranges_are_logarithmic(self, grid):
        scales = {}
        for spec in grid[2].specs["lines"].values():
            x = (spec.get("encoding") or spec["layer"][0]["encoding"])["x"]
            scales[x["title"]] = x.get("scale", {}).get("type")
        assert scales == {f"{LEAD} [s]": "linear", f"{Q} [s]": "log", LAW: None}

    def test_what_matters_most_comes_first(self, grid):
        names = [row[0] for row in grid[2].rows("What matters")]
        assert names == [LEAD, Q, LAW]
        assert float(grid[2].rows("What matters")[2][1].split()[0]) == pytest.approx(0.0, abs=0.02)

    def test_another_goal(self, tmp_path):
        """A margin is to be large: the best cells have the largest, and the yield counts from above."""
        folder = swept(tmp_path / "sweep", Space(grid={LEAD: "1e-3:2e-3:11"}), bowl)
        page.write(folder, "margin")
        shown = shown_page(folder)
        margins = np.array(folder.table(["margin"]).column("margin").to_pylist())
        assert shown.rows("Best cells")[0][0] == str(margins.argmax())
        assert "largest margin" in shown.text
        assert f"95% of the cells have at least {np.sort(margins)[0]:.4g}" in shown.text
        with pytest.raises(InputError, match=r"--goal 'margins': no such number .*did you mean margin\?$"):
            page.write(folder, "margins")

    def test_one_parameter_has_a_line_and_no_map(self, tmp_path):
        folder = swept(tmp_path / "sweep", Space(grid={LEAD: "1e-3:2e-3:11"}), bowl)
        page.write(folder)
        shown = shown_page(folder)
        assert set(shown.specs) == {"lines", "sensitivity", "parallel-coordinates", "yield"}
        assert len(shown.data["one-0"]) == 11
        assert shown.rows("What matters")[0][1].startswith("1.000 (+")

    def test_texts_and_truth_values_are_parameters(self, tmp_path):
        space = Space(
            grid={LAW: ["variable", "constant_angle"], "spindle_encoder.deviation_amplitude": [[0.05], [0.1], [0.2]]}
        )
        space = Space(grid={**space.grid, "electrodynamic_actuator.autostart": [True, False]})
        folder = swept(tmp_path / "sweep", space, lambda values: 1e-6 * (1 + (values[LAW] == "constant_angle")))
        axes = {axis.name: axis for axis in PageData(folder).axes}
        assert axes[LAW].texts == ["variable", "constant_angle"]
        assert axes["electrodynamic_actuator.autostart"].texts == ["false", "true"]
        assert_allclose(axes["spindle_encoder.deviation_amplitude"].distinct, [0.05, 0.1, 0.2])
        page.write(folder)
        rows = {row[0]: row[1] for row in shown_page(folder).rows("What matters")}
        assert rows[LAW] == "1.000"
        assert rows["electrodynamic_actuator.autostart"] == "0.000 (+0.00)"

    def test_texts_of_a_sweep_cannot_harm_the_page(self, tmp_path):
        """Names and reasons are somebody's texts: none of them ends the script or begins an element."""
        hostile = "</script><script>alert(1)</script>"
        space = Space(grid={"run_id": [hostile, "<b>$x"], Q: "1e-5,2e-5"})
        folder = swept(tmp_path / "sweep", space, lambda values: ("failed", hostile) if values[Q] < 1.5e-5 else 1e-6)
        page.write(folder)
        shown = shown_page(folder)
        assert shown.source.count("<script") == shown.source.count("</script>") == 3
        assert "<b>$x" not in shown.source
        assert hostile in shown.text
        assert [row["t"] for row in shown.data["bins-0"]] == [hostile, "<b>$x"]

    def test_a_page_that_cannot_be_written_is_one_line(self, tmp_path):
        folder = swept(tmp_path / "sweep", Space(grid={LEAD: "2.6e-3:3e-3:5"}), bowl)
        (folder.path / "figures").touch()
        with pytest.raises(LatheError, match=r"^.*/figures: File exists; the rows are as they were$"):
            page.write(folder)

    def test_when_every_cell_was_refused_one_line_says_so(self, tmp_path):
        folder = swept(tmp_path / "sweep", Space(grid={LEAD: "2.6e-3:3e-3:5"}), bowl)
        (folder.path / "figures").mkdir()
        (folder.path / "figures" / "yield.png").touch()
        written = page.write(folder)
        shown = shown_page(folder)
        assert "No cell has a tool.max_error: 5 refused." in shown.text
        assert (shown.specs, written.figures, list((folder.path / "figures").iterdir())) == ({}, [], [])
        assert "<script" not in shown.source

    def test_a_tolerance_study(self, tmp_path):
        """Drawn cells: the share within the tolerance, and between what the share of the whole batch is."""
        cell = scenario.load(
            resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=10", "tool.tolerance=0.3e-6"]
        )
        space = Space(sampled={LEAD: "normal:5%"}, sample="sobol:128", ties={Q: f"{LEAD} / 20"})
        folder = swept(tmp_path / "sweep", space, lambda values: abs(values[LEAD] - 1.4e-3) * 2e-3, cell)
        page.write(folder)
        shown = shown_page(folder)
        errors = np.array(folder.table(["tool.max_error"]).column("tool.max_error").to_pylist()) * 1e6
        share = np.mean(errors <= 0.3)
        said = re.search(r"([\d.]+)% are within the tolerance of 0.3 µm, of .* ([\d.]+)% to ([\d.]+)%", shown.text)
        assert float(said[1]) == pytest.approx(share * 100, abs=0.005)
        assert float(said[2]) < share * 100 < float(said[3])
        assert "tolerance 0.3 µm" in json.dumps(shown.specs["yield"], ensure_ascii=False)
        assert f"{Q} (tied)" in [row[0] for row in shown.rows("What matters")]

    def test_a_hundred_thousand_cells_fit(self, tmp_path):
        """Maps hold them all, lines are drawn of some, and the page says so."""
        targets = [LEAD, Q, DAMPING, "electrodynamic_actuator.delay"]
        space = Space(sampled=dict.fromkeys(targets, "99%:101%"), sample="random:100000")
        folder = Folder.begin(tmp_path / "sweep", PISTON, space, [])
        x = np.random.default_rng(0).random((len(targets), 100_000))
        columns = dict(zip(targets, x + 0.5, strict=True)) | {"tool.max_error": 1e-6 * (0.1 + x[0] + x[1] * x[2])}
        columns |= {"cell": np.arange(100_000), "key": np.arange(100_000).astype(str), "status": ["done"] * 100_000}
        table = pa.table(
            [pa.array(columns[name], kind) if name in columns else pa.nulls(100_000, kind)
             for name, kind in zip(folder.schema.names, folder.schema.types, strict=True)],
            schema=folder.schema,
        )  # fmt: skip
        folder.write([table])
        written = page.write(folder)
        shown = shown_page(folder)
        assert written.page.stat().st_size < LARGEST
        assert all(sum(row["n"] for row in shown.data[f"pair-0-{place}"]) == 100_000 for place in range(1, 4))
        assert "400 of 100000 cells with a result are in it: the best, and others by lot." in shown.text
        assert "The curve has 400 points of them." in shown.text
        assert len(shown.specs["parallel-coordinates"][""]["data"][0]["values"]) == 400


def test_the_docs_name_every_column():
    text = (Path(__file__).parents[1] / "docs" / "sweeps.md").read_text(encoding="utf-8")
    columns = row.schema(PISTON, [], []).names
    assert [name for name in columns if f"`{name}`" not in text] == []


class TestCommand:
    def test_writes_the_page_beside_the_table(self, grid):
        folder = grid[0]
        done = CliRunner().invoke(cli.main, ["sweep", "show", str(folder.path)])
        assert done.exit_code == 0, done.output
        assert "smallest errors" in done.output
        assert f"page:    {folder.path}/page.html" in done.output
        assert f"figures: {folder.path}/figures (5 PNG)" in done.output

    def test_says_where_as_json(self, grid):
        told = json.loads(CliRunner().invoke(cli.main, ["sweep", "show", str(grid[0].path), "--json"]).output)
        assert Path(told["page"]).is_file()
        assert [Path(path).is_file() for path in told["figures"]] == [True] * 5
        assert told["statuses"] == {"done": 98, "refused": 28}

    def test_a_goal_that_there_is_not_is_one_line(self, grid):
        done = CliRunner().invoke(cli.main, ["sweep", "show", str(grid[0].path), "--goal", "tool.max_eror"])
        assert (done.exit_code, done.output.count("\n")) == (2, 1)
        assert "did you mean tool.max_error" in done.output

    def test_a_goal_with_a_cell_is_refused(self, grid):
        done = CliRunner().invoke(cli.main, ["sweep", "show", str(grid[0].path), "--goal", "margin", "--cell", "3"])
        assert (done.exit_code, done.output) == (2, "lathe: --goal margin with --cell 3; allowed: one of them\n")
