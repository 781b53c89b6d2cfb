# SPDX-License-Identifier: Apache-2.0
"""``lathe sweep show``: the page of a sweep, its pictures and its numbers."""

import json
import math
import re
from itertools import permutations
from pathlib import Path

import altair as alt
import numpy as np
import pyarrow as pa
import pytest
from click.testing import CliRunner
from matplotlib.image import imread
from numpy.testing import assert_allclose
from shown_page import ShownPage

from lathe_explore.sweep import page, row, space
from lathe_explore.sweep.effects import Axis, Yield, bins, effect, groups, is_grid, total_effect
from lathe_explore.sweep.folder import Folder
from lathe_explore.sweep.page_data import PageData
from lathe_explore.sweep.space import Space
from lathe_rc import cli, resources
from lathe_rc.cell import scenario
from lathe_rc.drawing import charts
from lathe_rc.errors import LatheError

LEAD, Q = "learning_controller.lead_time", "learning_controller.q_time"
DAMPING, LAW = "electrodynamic_actuator.damping", "learning_controller.lead_law"
PISTON = scenario.load(resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=10"])
EXTERNAL = re.compile(r"""(?:src|href|action)=["'](?!data:)|url\((?!data:)|@import""")
LARGEST = 3_000_000  # [B] of a page
FIGURES = {"heat-map", "lines", "sensitivity", "parallel-coordinates", "yield"}
GRID = Space(grid={LEAD: "1e-3:3e-3:9", Q: "1e-5:1e-3:7:log", LAW: ["constant_angle", "variable"]})


def shown_page(folder, goal=""):
    page.write(folder, goal)
    return ShownPage((folder.path / "page.html").read_text(encoding="utf-8"))


def swept(place, space, outcome, cell=PISTON):
    """A sweep folder whose results are a function of the cells' values: an error [m], or a status and a reason."""
    folder = Folder.begin(place, cell, space, [])
    rows = []
    for number, values in enumerate(space.cells(cell)):
        came = outcome(values)
        row = {"cell": number, "key": f"{number:032d}", "limits": "", **values, "seed": values.get("seed", 0)}
        if isinstance(came, tuple):
            row |= {"status": came[0], "reason": came[1]}
        elif isinstance(came, dict):
            row |= {"status": "done", **came}
        else:
            row |= {"status": "done", "tool.max_error": came, "tool.rms_error": came / 3, "margin": 0.5 - came * 1e3}
        rows.append(row)
    folder.write([pa.Table.from_pylist(rows, folder.schema)])
    return folder


def bowl(values):
    """Error [m] that is least at a lead of 1.4 ms; longer leads than 2.5 ms are refused."""
    if values[LEAD] > 2.5e-3:
        return "refused", f"learning_controller: grows {values[LEAD]:.6g} times a cycle; allowed: below 1"
    return 1e-7 * (1.0 + (values[LEAD] / 1.4e-4 - 10.0) ** 2) * (1.0 + abs(math.log(values.get(Q, 6e-5) / 6e-5)))


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    folder = swept(tmp_path_factory.mktemp("grid") / "sweep", GRID, bowl)
    return folder, shown_page(folder)


@pytest.fixture(autouse=True)
def no_library(monkeypatch):
    """Leave the scripts out of all pages but that of the grid: to read them takes seconds."""
    monkeypatch.setattr(charts, "library", lambda: "")


class TestEffects:
    def ishigami(self, count=4096):
        """Points of a sample, and the values of Ishigami's function (a = 7, b = 0.1) there."""
        from scipy.stats import qmc

        x = (qmc.Sobol(3, rng=1).random(count) * 2.0 - 1.0) * np.pi
        y = np.sin(x[:, 0]) + 7.0 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
        return [Axis(f"x{place}", f"x{place}", column) for place, column in enumerate(x.T)], y

    def test_shares_of_a_known_function(self):
        """Its first-order indices are 0.3139, 0.4424 and 0 (Ishigami and Homma 1990)."""
        axes, y = self.ishigami()
        assert_allclose([effect(axis, y).share for axis in axes], [0.3139, 0.4424, 0.0], atol=0.02)

    def test_ranks_of_a_known_function(self):
        """The function is even in x2 and x3; the exponential of x1 is monotonic."""
        axes, y = self.ishigami()
        assert_allclose([effect(axis, y).rank for axis in axes[1:]], [0.0, 0.0], atol=0.03)
        assert effect(axes[0], np.exp(axes[0].values)).rank == pytest.approx(1.0)

    def test_chance_explains_nothing(self):
        """The mean share of noise is 0; uncorrected it would be bins / cells."""
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

    @pytest.mark.parametrize("refused", [0.0, 0.3, 0.6])
    def test_intervals_of_total_effects_have_the_true_ones(self, refused):
        """Of a Saltelli sample from which a dependent part is refused, the 95 % intervals have 95 % of the effects."""
        limit = 2.0 - np.sqrt(2.0 * refused) if refused < 0.5 else np.sqrt(2.0 * (1.0 - refused))

        def ishigami(u):
            x = (2.0 * u - 1.0) * np.pi
            y = np.sin(x[:, 0]) + 7.0 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
            return np.where(u[:, 0] + u[:, 1] <= limit, y, np.nan)

        def product(u):
            a = np.array([0.0, 1.0, 1e9])
            y = np.prod((np.abs(4.0 * u - 2.0) + a) / (1.0 + a), axis=1)
            return np.where(u[:, 0] + u[:, 1] <= limit, y, np.nan)

        one, other = np.random.default_rng(1).random((2, 100_000, 3))
        covered = []
        for function in (ishigami, product):
            mixed = [function(np.where(np.arange(3) == place, other, one)) for place in range(3)]
            y = function(one)
            expected = [np.nanmean((y - changed) ** 2) / 2.0 / np.nanvar(y) for changed in mixed]
            for seed in range(20):
                points = np.concatenate(list(space._sample("saltelli", 5 * 128, 3, seed)))
                axes = [Axis(f"x{place}", f"x{place}", column) for place, column in enumerate(points.T)]
                for group, true in zip(groups(axes, np.zeros(len(points))), expected, strict=True):
                    found, error = total_effect(group, function(points), lot=5)
                    covered.append(abs(found - true) <= error + 1e-6)
        assert np.mean(covered) >= 0.95

    def test_a_parameter_without_effect_has_none_where_cells_are_refused(self):
        """On a grid of which a corner is refused, b predicts a and so explains y = a; its total effect is 0."""
        a, b = (side.ravel() for side in np.meshgrid(np.arange(8.0), np.arange(8.0), indexing="ij"))
        axes, y = [Axis("a", "a", a), Axis("b", "b", b)], np.where(a + b > 8.0, np.nan, a)
        assert effect(axes[1], y, exact=True).share > 0.2
        one, other = groups(axes, np.zeros(64))
        assert total_effect(other, y, exact=True)[0] == pytest.approx(0.0, abs=1e-15)
        full = [total_effect(group, 2.0 * a + b, exact=True)[0] for group in (one, other)]
        assert_allclose(full, [0.8, 0.2], rtol=1e-12)
        assert total_effect(np.arange(64), y) is None

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
    @pytest.mark.parametrize(("above", "points"), [(False, (95.0, 98.0)), (True, (4.0, 1.0))])
    def test_points_are_the_tightest_limits_of_a_share(self, above, points):
        """Two of 100 cells have no goal and count as beyond every limit."""
        found = Yield(np.arange(1.0, 99.0), 100, above)
        assert (found.point(0.95), found.point(0.98), found.point(0.99)) == (*points, None)
        assert [found.share(found.point(share)) for share in (0.5, 0.98)] == [0.5, 0.98]
        assert found.share(99.0 if above else 0.0) == 0.0

    @pytest.mark.parametrize("above", [False, True])
    def test_a_thinned_curve_lies_on_the_whole_one(self, above):
        found = Yield(np.sort(np.random.default_rng(0).random(1000)), 1100, above)
        limits, shares = found.curve(40)
        assert [found.share(limit) for limit in limits] == shares.tolist()
        assert (limits[0], limits[-1]) == (found.goal[0], found.goal[-1])

    def test_interval_is_that_of_wilson(self):
        """For 99 of 100 Wilson's interval is 0.9455 to 0.9982."""
        assert_allclose(Yield(np.arange(100.0), 100).interval(98.0), (0.9455, 0.9982), atol=5e-5)


class TestPage:
    def test_needs_nothing_else_and_is_small(self, grid):
        folder, shown = grid
        body = shown.source[: shown.source.index("<script>")]
        assert not EXTERNAL.search(body)
        assert "default-src 'none'" in body
        assert "window.vegaEmbed=" in shown.source
        assert (folder.path / "page.html").stat().st_size < LARGEST

    def test_has_a_figure_and_a_picture_of_each_kind(self, grid):
        folder, shown = grid
        pictures = {path.stem: imread(path)[..., :3] for path in (folder.path / "figures").iterdir()}
        assert set(shown.specs) == pictures.keys() == FIGURES
        for name, pixels in pictures.items():
            assert min(pixels.shape[:2]) > 200
            assert pixels.std() > 0.02, f"{name} is blank"

    def test_every_pair_can_be_chosen(self, grid):
        specs = grid[1].specs
        pairs = {f"{x}-{y}" for x, y in permutations(range(3), 2)}
        assert set(specs["heat-map"]) == pairs
        assert set(specs["lines"]) == {"0-", "1-", "2-", *pairs}
        named = {spec["data"]["name"] for name in ("heat-map", "lines") for spec in specs[name].values()}
        assert named <= grid[1].data.keys()

    def test_specifications_are_those_of_vega_lite(self, grid):
        """Each of the three axes (linear, log, texts) is checked across and up."""
        for name in FIGURES - {"parallel-coordinates"}:  # that one is of Vega
            specs = grid[1].specs[name]
            for chosen in specs.keys() & {"", "0-", "1-", "2-", "0-1", "1-2", "2-0"}:
                alt.Chart.from_dict(specs[chosen])

    def test_counts_what_came_of_the_cells_with_their_reasons(self, grid):
        """Two leads of nine are refused; their reasons differ only in a number and share one row."""
        rows = grid[1].rows("Outcomes")
        assert [row[:3] for row in rows] == [["done", "98", "77.8%"], ["refused", "28", "22.2%"]]
        assert rows[1][3] == "cell 98: learning_controller: grows 0.00275 times a cycle; allowed: below 1"

    def test_says_what_was_asked_for(self, grid):
        rows = grid[1].rows("What was varied")
        assert [f"{LEAD} [s]", "1e-3:3e-3:9", "0.001", "0.003", "9", "0.001425"] in rows
        assert [LAW, "constant_angle, variable", "", "", "2", "variable"] in rows

    @pytest.mark.parametrize(
        ("best", "words", "sound"),
        [
            (1.4e-3, ["Its stability margin is 0.4999, beside 0.4949."], True),
            (
                1e-3,
                [f"at the end of {LEAD} (0.001, the smallest): a better", "margin is 0.4999, beside 0.4949."],
                False,
            ),
            (2.4e-3, ["margin is 0.4999, beside 0.4949.", "Beside it without a result: cell 8 (refused)."], False),
        ],
    )
    def test_praises_no_best_cell_at_an_end_or_beside_a_refused_one(self, tmp_path, no_pictures, best, words, sound):
        """The lead is at its best amid its axis, at its end, or beside a lead that is refused."""

        def outcome(values):
            refused = values[LEAD] > 2.5e-3
            return ("refused", "too long") if refused else 1e-7 + 125.0 * (values[LEAD] - best) ** 2

        shown = shown_page(swept(tmp_path / "sweep", Space(grid={LEAD: "1e-3:2.6e-3:9"}), outcome))
        for each in words:
            assert each in shown.text
        assert ("lies at the end" in shown.text) == (best == 1e-3)
        smallest = re.search(r'<div class="(\w*)"><b>[^<]*</b><span>smallest tool.max_error', shown.source)
        assert (smallest[1] == "good") == sound

    def test_says_that_the_best_cell_has_less_margin_than_those_beside_it(self, tmp_path, no_pictures):
        """Drawn cells: the nearest are beside it, and the outermost twentieth of an axis is its end."""
        space = Space(sampled={LEAD: "1e-3:3e-3"}, sample="random:40", sample_seed=1)
        leads = sorted(float(values[LEAD]) for values in space.cells(PISTON))

        def outcome(values):
            margin = {leads[2]: 0.013, leads[1]: 0.045, leads[3]: 0.04}.get(values[LEAD], 0.5)
            return {"tool.max_error": 1e-7 + abs(values[LEAD] - leads[2]), "margin": margin}

        shown = shown_page(swept(tmp_path / "sweep", space, outcome))
        assert f"at the end of {LEAD} ({leads[2]:.4g}, of {leads[0]:.4g} to {leads[-1]:.4g}): a better" in shown.text
        assert "Its stability margin is 0.013, beside 0.04 to 0.045." in shown.text

    def test_lists_the_best_cells_in_order(self, grid):
        folder, shown = grid
        rows = shown.rows("Best cells")
        results = folder.table(["cell", "tool.max_error"]).drop_null().to_pylist()
        best = sorted(results, key=lambda result: (result["tool.max_error"], result["cell"]))
        assert [row[0] for row in rows] == [str(result["cell"]) for result in best[: len(rows)]]
        assert float(rows[0][4]) == pytest.approx(best[0]["tool.max_error"] * 1e6, rel=1e-3)

    def test_a_map_holds_every_cell_once(self, grid):
        """A field is the median of its cells; it is empty where all of them are refused."""
        folder, shown = grid
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
        for spec in grid[1].specs["lines"].values():
            x = (spec.get("encoding") or spec["layer"][0]["encoding"])["x"]
            scales[x["title"]] = x.get("scale", {}).get("type")
        assert scales == {f"{LEAD} [s]": "linear", f"{Q} [s]": "log", LAW: None}

    def test_what_matters_most_comes_first(self, grid):
        rows = grid[1].rows("What matters")
        assert [row[0] for row in rows] == [LEAD, Q, LAW]
        assert float(rows[2][1].split(";")[0]) == pytest.approx(0.0, abs=0.02)

    def test_another_goal(self, tmp_path, no_pictures):
        """A margin should be large: the best cells have the largest, and the yield counts from above."""
        folder = swept(tmp_path / "sweep", Space(grid={LEAD: "1e-3:2e-3:11"}), bowl)
        shown = shown_page(folder, "margin")
        margins = np.array(folder.table(["margin"]).column("margin").to_pylist())
        assert shown.rows("Best cells")[0][0] == str(margins.argmax())
        assert "largest margin" in shown.text
        assert f"95% of the cells have at least {margins.min():.4g}" in shown.text

    def test_one_parameter_has_a_line_and_no_map(self, tmp_path):
        folder = swept(tmp_path / "sweep", Space(grid={LEAD: "1e-3:2e-3:11"}), bowl)
        shown = shown_page(folder)
        assert set(shown.specs) == {"lines", "sensitivity", "parallel-coordinates", "yield"}
        assert len(shown.data["one-0"]) == 11
        assert shown.rows("What matters")[0][1].startswith("1.000; 1.000 (+")

    def test_texts_and_truth_values_are_parameters(self, tmp_path, no_pictures):
        start, amplitude = "electrodynamic_actuator.autostart", "spindle_encoder.deviation_amplitude"
        space = Space(
            grid={LAW: ["variable", "constant_angle"], amplitude: [[0.05], [0.1], [0.2]], start: [True, False]}
        )
        folder = swept(tmp_path / "sweep", space, lambda values: 1e-6 * (1 + (values[LAW] == "constant_angle")))
        axes = {axis.name: axis for axis in PageData(folder).axes}
        assert axes[LAW].texts == ["variable", "constant_angle"]
        assert axes[start].texts == ["false", "true"]
        assert_allclose(axes[amplitude].distinct, [0.05, 0.1, 0.2])
        rows = {row[0]: row[1] for row in shown_page(folder).rows("What matters")}
        assert rows[LAW] == "1.000; 1.000"
        assert rows[start] == "0.000; 0.000 (+0.00)"

    def test_texts_of_a_sweep_cannot_harm_the_page(self, tmp_path, no_pictures):
        """Neither names nor reasons can end the script or begin an element."""
        hostile = "</script><script>alert(1)</script>"
        space = Space(grid={"run_id": [hostile, "<b>$x"], Q: "1e-5,2e-5"})
        folder = swept(tmp_path / "sweep", space, lambda values: ("failed", hostile) if values[Q] < 1.5e-5 else 1e-6)
        shown = shown_page(folder)
        assert shown.source.count("<script") == shown.source.count("</script>") == 3
        assert "<b>$x" not in shown.source
        assert hostile in shown.text
        assert [row["t"] for row in shown.data["bins-0"]] == [hostile, "<b>$x"]

    @pytest.fixture
    def refused(self, tmp_path):
        return swept(tmp_path / "sweep", Space(grid={LEAD: "2.6e-3:3e-3:5"}), bowl)

    def test_a_page_that_cannot_be_written_is_one_line(self, refused):
        (refused.path / "figures").touch()
        with pytest.raises(LatheError, match=r"^.*/figures: File exists; the rows are as they were$"):
            page.write(refused)

    def test_when_every_cell_was_refused_one_line_says_so(self, refused):
        figures = refused.path / "figures"
        figures.mkdir()
        (figures / "yield.png").touch()
        shown = shown_page(refused)
        assert "No cell has a tool.max_error: 5 refused." in shown.text
        assert (shown.specs, list(figures.iterdir())) == ({}, [])
        assert "<script" not in shown.source

    def test_a_tolerance_study(self, tmp_path):
        """The page has the share of the drawn cells within the tolerance, and its confidence interval."""
        cell = PISTON.varied({"tool.tolerance": 0.3e-6})
        space = Space(sampled={LEAD: "normal:5%"}, sample="sobol:128", ties={Q: f"{LEAD} / 20"})
        folder = swept(tmp_path / "sweep", space, lambda values: abs(values[LEAD] - 1.4e-3) * 2e-3, cell)
        shown = shown_page(folder)
        errors = np.array(folder.table(["tool.max_error"]).column("tool.max_error").to_pylist()) * 1e6
        share = np.mean(errors <= 0.3)
        said = re.search(r"([\d.]+)% are within the tolerance of 0.3 µm, of .* ([\d.]+)% to ([\d.]+)%", shown.text)
        assert float(said[1]) == pytest.approx(share * 100, abs=0.005)
        assert float(said[2]) < share * 100 < float(said[3])
        assert "tolerance 0.3 µm" in json.dumps(shown.specs["yield"], ensure_ascii=False)
        assert f"{Q} (tied)" in [row[0] for row in shown.rows("What matters")]

    def test_a_hundred_thousand_cells_fit(self, tmp_path, no_pictures):
        """The maps hold all cells, the lines some of them, and the page says so."""
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
        shown = shown_page(folder)
        assert (folder.path / "page.html").stat().st_size < LARGEST
        assert all(sum(row["n"] for row in shown.data[f"pair-0-{place}"]) == 100_000 for place in range(1, 4))
        assert "400 of 100000 cells with a result are in it: the best, and others by lot." in shown.text
        assert "The curve has 400 points of them." in shown.text
        assert len(shown.specs["parallel-coordinates"][""]["data"][0]["values"]) == 400


def test_the_docs_name_every_column():
    text = (Path(__file__).parents[2] / "docs" / "sweeps.md").read_text(encoding="utf-8")
    columns = row.schema({}, [], []).names
    assert [name for name in columns if f"`{name}`" not in text] == []


class TestCommand:
    def show(self, grid, *options):
        return CliRunner().invoke(cli.main, ["sweep", "show", str(grid[0].path), *options])

    def test_writes_the_page_beside_the_table(self, grid, no_pictures):
        folder, done = grid[0].path, self.show(grid)
        assert done.exit_code == 0, done.output
        for text in ("smallest errors", f"page:    {folder}/page.html", f"figures: {folder}/figures (5 PNG)"):
            assert text in done.output

    def test_says_where_as_json(self, grid, no_pictures):
        told = json.loads(self.show(grid, "--json").output)
        assert Path(told["page"]).is_file()
        assert [Path(path).is_file() for path in told["figures"]] == [True] * 5
        assert told["statuses"] == {"done": 98, "refused": 28}

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (["--goal", "tool.max_eror"], r"--goal 'tool.max_eror': no such number .*did you mean tool.max_error, .*"),
            (["--goal", "margin", "--cell", "3"], "--goal margin with --cell 3; allowed: one of them"),
        ],
    )
    def test_an_impossible_goal_is_refused_in_one_line(self, grid, options, message):
        done = self.show(grid, *options)
        assert done.exit_code == 2
        assert re.fullmatch(f"lathe: {message}\n", done.output)
