# SPDX-License-Identifier: Apache-2.0
"""How far a form may be off between the points of its table: the estimate beside the truth, and the verdict."""

import re

import numpy as np
import pytest
from cells import scenario
from click.testing import CliRunner

from lathe_machine.signals.interpolation_doubt import doubt
from lathe_machine.signals.measured_profile import Measured
from lathe_machine.signals.profile import Piston
from lathe_rc import harness
from lathe_rc.analysis import profile_csv
from lathe_rc.analysis.tolerance import judge
from lathe_rc.cell.wiring import Cell
from lathe_rc.cli import main

TURN = 2.0 * np.pi


def twist(per_mm, waves=2):
    """A form of some waves that turns along the part [rad/mm]."""
    return lambda angle, height: 200e-6 * np.sin(waves * (angle - per_mm * 1e3 * height))


def conical(angle, height):
    return 1e-3 * height * (1.0 + np.cos(3.0 * angle))


def table(form, points, heights):
    angle = TURN * np.arange(points) / points
    return Measured(angle, heights, np.array([form(angle, height) for height in heights]))


def even(step_mm, top_mm=6.0):
    return np.arange(0.0, top_mm + 1e-9, step_mm) * 1e-3


def error(form, tabulated):
    """Largest error of a table at a fine grid of angles, half-way between its first heights [m]."""
    angle = np.linspace(0.0, TURN, 1441)[:-1]
    between = tabulated.heights[:4] + np.append(np.diff(tabulated.heights[:5]), 0.0)[:4] / 2.0
    return max(float(np.abs(tabulated.deviation(angle, z) - form(angle, z)).max()) for z in between.tolist())


@pytest.mark.parametrize(
    ("form", "points", "heights", "largest"),
    [
        (twist(np.pi / 2), 360, even(0.25), 1.3),
        (twist(np.pi / 2), 360, even(0.05), 1.1),
        (twist(np.pi / 2), 360, even(0.5), 4.0),
        (twist(np.pi / 3, 4), 180, even(0.1), 1.3),
        (twist(0.1, 1), 90, even(1.0), 1.3),
        (twist(0.0, 12), 72, even(6.0), 40.0),
        (twist(0.0, 2), 36, even(6.0), 1.3),
        (conical, 60, even(2.0), 1.3),
    ],
)
def test_the_doubt_of_a_smooth_form_is_its_error(form, points, heights, largest):
    """Up to the factor by which a table is judged too badly that is too coarse to show the order."""
    tabulated = table(form, points, heights)
    true, found = error(form, tabulated), doubt(tabulated).whole
    assert 0.9 * true <= found + 1e-15 <= largest * true + 1e-12


def dwell(angle, height):
    """A cam: a rise and fall of 120° with a kink at each end."""
    return 100e-6 * np.where((angle > 1.0) & (angle < 3.1), np.sin(np.pi * (angle - 1.0) / 2.1), 0.0)


def flat(angle, height):
    return 100e-6 * np.maximum(np.cos(angle - 0.2), 0.3)


def triangle(angle, height):
    return 100e-6 * np.abs(angle / TURN * 6.0 % 1.0 - 0.5)


@pytest.mark.parametrize("form", [dwell, flat, triangle])
@pytest.mark.parametrize("points", [36, 72, 180])
def test_the_doubt_of_a_form_with_kinks_has_the_size_of_its_error(form, points):
    tabulated = table(form, points, np.zeros(1))
    true = error(form, tabulated)
    assert 0.5 * true < doubt(tabulated).whole < 6.0 * true


def test_noise_of_the_points_is_a_doubt_of_its_size():
    clean = table(twist(0.0), 360, np.zeros(1))
    noisy = Measured(clean.angle, clean.heights, clean.radius + 1e-6 * np.random.default_rng(1).normal(size=(1, 360)))
    assert 2e-6 < doubt(noisy).whole < 8e-6


def test_points_that_are_too_few_to_tell_are_told(tmp_path):
    tabulated = table(conical, 4, even(6.0))
    assert np.isnan(doubt(tabulated)).all()
    assert doubt(tabulated).whole == 0.0
    profile_csv.write(tmp_path / "form.csv", tabulated.radius, heights=tabulated.heights)
    cell = Cell(scenario(tool={"profile": "csv", "profile_file": str(tmp_path / "form.csv")}).nodes)
    cell.check()
    assert any("2 heights: nothing shows how far the form between them" in each for each in cell.warnings)


def test_rows_of_a_formula_are_joined_by_straight_lines():
    """The bound that the docstring of `Piston` states; a formula has no doubt over the angle."""
    found = doubt(Piston(0.5e-3, 0.4e-3, 1e-3, 0.06, 0.02))
    assert found.angle == 0.0
    assert 0.5e-4 * 1e-3 < found.height < 3e-4 * 1e-3


@pytest.mark.parametrize(
    ("doubted", "said", "in_tolerance"),
    [
        (0.0, "in tolerance (±2 µm) from revolution 2 on, 1.5 µm to spare in the last 2", True),
        (0.3e-6, "to spare in the last 2; the form may be 0.3 µm off between the points of its table", True),
        (1.6e-6, "not shown in tolerance (±2 µm): 0.4 µm in the last revolution, but the form may be 1.6", False),
        (9e-6, "not shown in tolerance (±2 µm): 0.4 µm in the last revolution, but the form may be 9 µm off", False),
    ],
)
def test_a_verdict_needs_room_for_the_doubt(doubted, said, in_tolerance):
    found = judge(np.array([5e-6, 0.5e-6, 0.4e-6]), 2e-6, doubt=doubted + 1e-9 * (doubted == 1.6e-6))
    assert found.told().startswith(said) or said in found.told()
    assert found.in_tolerance == in_tolerance


@pytest.mark.usefixtures("no_pictures")
def test_run_json_and_report_tell_the_doubt(tmp_path):
    """A twisted form whose heights are too far apart is not in tolerance, though the error to its table is small."""
    tabulated = table(twist(np.pi / 2), 90, even(0.25, 2.0))
    profile_csv.write(tmp_path / "twist.csv", tabulated.radius, heights=tabulated.heights)
    tool = {"profile": "csv", "profile_file": str(tmp_path / "twist.csv"), "tolerance": 100e-6}
    cells = [scenario(spindle_encoder={"revolutions": 6.0}, tool={**tool, "tolerance": t}) for t in (300e-6, 15e-6)]
    wide, narrow = harness.run(cells[0]), harness.run(cells[1], bag=tmp_path / "bag")
    assert wide.digest == narrow.digest
    assert "; the form may be" not in wide.verdict.told()
    assert wide.verdict.in_tolerance
    assert narrow.errors.largest[-1] < 15e-6
    assert not narrow.verdict.in_tolerance
    assert narrow.summary()["tolerance_um"]["form_doubt"] == pytest.approx(15.2, rel=0.2)
    assert "between its heights (tolerance: ±15 µm): more of them help" in narrow.warnings[0]
    page = tmp_path / "report.html"
    assert CliRunner().invoke(main, ["report", str(tmp_path / "bag"), "-o", str(page)]).exit_code == 0
    told = re.search(r'<section class="verdict bad".*?<p class="said">([^<]*)</p>', page.read_text(), re.DOTALL)
    assert told[1].startswith("Not shown in tolerance (±15 µm): ")
