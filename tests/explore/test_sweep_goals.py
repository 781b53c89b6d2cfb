# SPDX-License-Identifier: Apache-2.0
"""Goals of sweeps as formulas and functions, their inputs as distributions, and columns that are carried along."""

import sys
from pathlib import Path

import numpy as np
import pytest
import scipy
from click.testing import CliRunner

import lathe_explore
import lathe_rc
from lathe_explore.sweep import inputs, row
from lathe_explore.sweep.comparison import compare
from lathe_explore.sweep.expression import Expression
from lathe_explore.sweep.objectives import front, objectives
from lathe_explore.sweep.space import Space
from lathe_rc import allowed_code, extensions
from lathe_rc.cell import cells_file
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cli import main
from lathe_rc.errors import InputError

LEAD, Q = "learning_controller.lead_time", "learning_controller.q_time"
DAMPING, FREQUENCY = "electrodynamic_actuator.damping", "electrodynamic_actuator.natural_frequency"
PISTON = Path(__file__).parents[2] / "config" / "piston.yaml"


@pytest.fixture(scope="module")
def piston():
    return scenarios.load(PISTON, ["spindle_encoder.revolutions=3"])


def drawn(scenario, **of):
    """The drawn values by target, shape (points,) each."""
    space = Space(**of)
    space.check(scenario)
    found = list(space.cells(scenario))
    return {target: np.array([cell[target] for cell in found]) for target in space.targets()}


# ---- distributions ---------------------------------------------------------------------------------------------------


def test_distributions_of_scipy_are_drawn_truncated_and_discrete(piston):
    """The quantiles of 4096 points are those of the distribution, and truncation keeps its shape between the ends."""
    laws = {FREQUENCY: "weibull_min:c=3:scale=1000", DAMPING: "normal:0.8:0.1:min=0.75:max=1.0"}
    found = drawn(piston, sampled=laws | {"block_size": "randint:low=1:high=5"}, sample="sobol:4096")
    shares = [0.1, 0.5, 0.9]
    assert np.quantile(found[FREQUENCY], shares) == pytest.approx(scipy.stats.weibull_min(3, 0, 1000).ppf(shares), 0.01)
    truncated = scipy.stats.truncnorm(-0.5, 2.0, 0.8, 0.1)
    assert np.quantile(found[DAMPING], shares) == pytest.approx(truncated.ppf(shares), abs=1e-3)
    assert (found[DAMPING].min() >= 0.75, found[DAMPING].max() <= 1.0) == (True, True)
    values, counts = np.unique(found["block_size"], return_counts=True)
    assert (values.tolist(), counts.tolist()) == ([1, 2, 3, 4], [1024] * 4)


def test_correlated_parameters_have_their_correlation_and_their_own_distributions(piston):
    laws = {FREQUENCY: "normal:1000:50", DAMPING: "normal:0.8:0.05", LEAD: "uniform:1e-3:2e-3"}
    of = {"sampled": laws, "sample": "sobol:8192"}
    found = drawn(piston, **of, correlated={f"{FREQUENCY}, {DAMPING}": -0.7, f"{DAMPING},{LEAD}": 0.5})
    matrix = np.corrcoef(np.stack([found[FREQUENCY], found[DAMPING], scipy.stats.norm.ppf((found[LEAD] - 1e-3) * 1e3)]))
    assert matrix[[0, 1, 0], [1, 2, 2]] == pytest.approx([-0.7, 0.5, 0.0], abs=0.01)
    independent = drawn(piston, **of)
    for name, values in found.items():
        assert np.quantile(values, [0.05, 0.5, 0.95]) == pytest.approx(
            np.quantile(independent[name], [0.05, 0.5, 0.95]), rel=2e-3
        )
    other = drawn(piston, **of, sample_seed=1)
    assert not np.isin(other[LEAD], independent[LEAD]).any()


@pytest.mark.parametrize(
    ("of", "said"),
    [
        ({"sampled": {LEAD: "weibull_min:k=3"}}, r"allowed: weibull_min:c=NUMBER, also loc, scale, min and max"),
        ({"sampled": {LEAD: "weibul_min:c=3"}}, "allowed: LOW:HIGH, .* or a distribution of scipy.stats"),
        ({"sampled": {LEAD: "gamma:a=-1"}}, "not defined with these arguments; allowed: as scipy.stats.gamma"),
        ({"sampled": {LEAD: "normal:0.001:0.0001:min=1"}}, "not defined with these arguments"),
        ({"sampled": {"block_size": "gamma:a=2"}}, "a discrete distribution, such as randint"),
        ({"correlated": {f"{LEAD},{DAMPING}": 0.5}}, "allowed: two of what is drawn: learning"),
        ({"correlated": {f"{LEAD},{Q}": 1.0}}, "= 1; allowed: above -1 and below 1"),
        ({"correlated": {f"{LEAD},{Q}": 0.1}, "sample": "saltelli:4"}, "in a saltelli sample; allowed: sobol"),
        (
            {"correlated": {f"{LEAD},{Q}": 0.9, f"{Q},{FREQUENCY}": 0.9, f"{LEAD},{FREQUENCY}": -0.9}},
            r"the least eigenvalue of their matrix is -0\.8; allowed: a positive definite matrix",
        ),
    ],
)
def test_distributions_that_do_not_exist_are_refused_by_name(piston, of, said):
    three = {LEAD: "1e-3:2e-3", Q: "50e-6:100e-6", FREQUENCY: "normal:5%"}
    with pytest.raises(InputError, match=said):
        Space(**{"sampled": three, "sample": "sobol:4"} | of).check(piston)


# ---- columns that are carried along ----------------------------------------------------------------------------------


def test_columns_of_given_cells_are_carried_into_the_rows_as_text(piston, client, tmp_path):
    """Two drives of the same values stay two rows, and the serial number its zeros."""
    (tmp_path / "drives.csv").write_text(f"serial,{DAMPING}\n0012,0.8\n0013,0.8\n")
    space = Space(given=cells_file.read(tmp_path / "drives.csv", ["serial"]), carried=["serial"])
    rows = lathe_explore.run_sweep(piston, space, tmp_path / "rows", client=client).table().to_pylist()
    assert [(each["serial"], each[DAMPING]) for each in rows] == [("0012", 0.8), ("0013", 0.8)]
    assert rows[0]["digest"] == rows[1]["digest"]
    for carried, cell, said in (
        (["serail"], {LEAD: 1e-3}, f"serail: no column of the given cells; allowed: {LEAD}"),
        ([], {"serial": "1"}, "'serial' is not shared; not NODE.PARAM"),
        (["status"], {"status": "1"}, "carried along, and a column of each row as well"),
    ):
        with pytest.raises(InputError, match=said):
            lathe_explore.run_sweep(piston, Space(given=[cell], carried=carried), tmp_path / "other", client=client)


# ---- goals -----------------------------------------------------------------------------------------------------------


def test_a_formula_of_columns_is_a_goal_and_a_constraint(piston):
    wanted = objectives(
        piston, ['"tool.error:max" / tool.first_max_error', "-margin"], ["tool.max_error - 2 * tool.rms_error <= 1e-7"]
    )
    assert wanted.columns[:3] == ["status", "margin", "tool.error:max"]
    cell = {"status": row.DONE, "tool.error:max": 2e-6, "tool.first_max_error": 4e-6, "margin": 0.1}
    cell |= {"tool.max_error": 2e-6, "tool.rms_error": 0.9e-6}
    score = wanted.score([cell])
    assert score.costs == (0.5, -0.1)
    assert score.violations == pytest.approx((0.0, 1.0))
    undefined = wanted.score([cell | {"tool.first_max_error": 0.0}])
    assert (undefined.costs[0], undefined.feasible) == (np.inf, False)


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        ("tool.max_eror / 2", "did you mean tool.max_error"),
        ("1 + 2", "no column in it"),
        ("tool.max_error +", "allowed: targets and numbers"),
        ("my_goal:settled", "code that is not allowed; allowed: --allow-code my_goal"),
    ],
)
def test_goals_without_a_meaning_are_refused_by_name(piston, goal, said):
    with allowed_code.call(), pytest.raises(InputError, match=said):
        objectives(piston, [goal])


def test_formula_of_a_quantity_that_is_missing_or_divides_by_zero_has_no_value():
    formula = Expression("a / b ** 2")
    cells = [{"a": 1.0, "b": 2.0}, {"a": 1.0, "b": None}, {"a": 1.0, "b": 0.0}, {"a": 1.0, "b": float("nan")}]
    assert np.isfinite([formula.number(cell) for cell in cells]).tolist() == [True, False, False, False]


def test_front_is_what_no_other_point_equals_or_betters():
    costs = np.random.default_rng(1).integers(0, 6, (200, 3)).astype(float)
    costs[::9, 1] = np.nan
    known = np.flatnonzero(~np.isnan(costs).any(axis=1))
    others = [(costs[known] <= costs[each]).all(axis=1) & (costs[known] < costs[each]).any(axis=1) for each in known]
    wanted = {tuple(costs[each]) for each, beaten in zip(known, others, strict=True) if not beaten.any()}
    found = front(costs)
    assert {tuple(costs[each]) for each in found} == wanted
    assert len(found) == len(wanted)


def test_several_goals_of_a_sweep_give_a_front(piston, client, tmp_path):
    place = tmp_path / "rows"
    found = lathe_explore.run_sweep(piston, Space(grid={LEAD: "1.2e-3:1.5e-3:7"}), place, client=client)
    shown = found.best("tool.max_error / tool.first_max_error", "margin")
    rows = {each["cell"]: each for each in found.table().to_pylist() if each["status"] == row.DONE}
    points = [(each["tool.max_error"] / each["tool.first_max_error"], -each["margin"]) for each in rows.values()]
    wanted = [
        cell for cell, p in zip(rows, points, strict=True) if not any(o[0] < p[0] and o[1] < p[1] for o in points)
    ]
    assert {each["cell"] for each in shown} == set(wanted)
    assert len(wanted) > 1
    none = CliRunner().invoke(main, ["sweep", "show", str(place), "--goal", "1 / (margin - margin)"])
    assert (none.exit_code, f"{len(rows)} done cells without a value of 1 / (margin - margin)" in none.stdout) == (
        1,
        True,
    )


FUNCTION = """
def settled(recording):
    return SCALE * recording.errors.largest[-1]
"""


def test_a_function_of_a_recording_is_a_column_whose_code_is_pinned(piston, client, tmp_path, monkeypatch):
    """Its value is that of a direct run; edited code is refused, and a value that is not finite is a failed row."""
    monkeypatch.chdir(tmp_path)
    place, space = tmp_path / "rows", Space(grid={LEAD: [1.3e-3]})

    def write(scale):
        Path("my_goal.py").write_text(FUNCTION.replace("SCALE", scale))
        sys.modules.pop("my_goal", None)
        extensions.source_hash.cache_clear()
        inputs._hash_here.cache_clear()

    write("2.0")
    with allowed_code.call():
        allowed_code.allow("my_goal")
        (found,) = (
            lathe_explore.run_sweep(piston, space, place, measures=["my_goal:settled"], client=client)
            .table()
            .to_pylist()
        )
        assert found["my_goal:settled"] == 2.0 * lathe_rc.run(piston.varied({LEAD: 1.3e-3})).errors.largest[-1]
        assert found["code"].startswith("xxh3:")
        write("float('nan')")
        with pytest.raises(InputError, match="my_goal:settled has the hash"):
            lathe_explore.run_sweep(piston, space, place, measures=["my_goal:settled"], client=client)
        (failed,) = (
            lathe_explore.run_sweep(piston, space, tmp_path / "other", measures=["my_goal:settled"], client=client)
            .table()
            .to_pylist()
        )
    assert (failed["status"], failed["reason"]) == (row.FAILED, "my_goal:settled is nan; allowed: a finite number")


# ---- folders side by side --------------------------------------------------------------------------------------------


def test_two_sweeps_are_compared_by_their_common_cells(piston, client, tmp_path):
    """Another law: the differing parameter, the change of each common cell, both best cells and effects."""
    law = "learning_controller.lead_law"
    one = lathe_explore.run_sweep(
        piston.varied({law: "constant_angle"}), Space(grid={LEAD: "1.3e-3:1.5e-3:3"}), tmp_path / "a", client=client
    )
    other = lathe_explore.run_sweep(
        piston, Space(grid={LEAD: "1.4e-3:1.6e-3:3", Q: [67e-6]}), tmp_path / "b", client=client
    )
    found = compare(one.folder, other.folder)
    assert found.differences == [f"{law} = constant_angle there, and variable here"]
    before, after = ({each[LEAD]: each["tool.max_error"] for each in side.table().to_pylist()} for side in (one, other))
    changes = [(after[lead] - before[lead]) * 1e6 for lead in (1.4e-3, 1.5e-3)]
    assert found.changes == pytest.approx(changes)
    assert found.better == sum(change < 0.0 for change in changes)
    assert [side.best[LEAD] for side in found.sides] == [min(errors, key=errors.get) for errors in (before, after)]
    shown = CliRunner().invoke(main, ["sweep", "compare", str(tmp_path / "a"), str(tmp_path / "b")])
    assert f"2 cells in common: {found.better} better in" in shown.stdout
    assert f"lathe sweep show {tmp_path / 'b'} --cell {found.sides[1].best['cell']} --panel" in shown.stdout


@pytest.mark.usefixtures("no_pictures")
def test_a_cell_gives_its_bag_and_its_report_in_one_command(piston, client, tmp_path):
    lathe_explore.run_sweep(piston, Space(grid={LEAD: [1.3e-3]}), tmp_path / "rows", client=client)
    shown = CliRunner().invoke(main, ["sweep", "show", str(tmp_path / "rows"), "--cell", "0", "--report"])
    assert shown.exit_code == 0, shown.output
    assert (tmp_path / "rows" / "cell-0" / "metadata.yaml").exists()
    assert "</html>" in (tmp_path / "rows" / "cell-0.html").read_text(encoding="utf-8")
