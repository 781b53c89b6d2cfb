# SPDX-License-Identifier: Apache-2.0
"""``lathe fit``: what is found in a measurement is what made it."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose

from lathe_rc.analysis.reduced_order import step_of
from lathe_rc.cli import main
from lathe_rc.control.decoupler import PAPER
from lathe_rc.plants.hysteresis import THRESHOLDS, WEIGHTS, PrandtlIshlinskii

PROPORTIONAL = 0.7617


def lathe(*arguments):
    return CliRunner().invoke(main, ["fit", *map(str, arguments)])


@pytest.fixture
def loop_file(tmp_path):
    command = np.sin(np.linspace(0.0, 6.0 * np.pi, 3000))
    displacement = np.empty_like(command)
    PrandtlIshlinskii(THRESHOLDS, WEIGHTS, PROPORTIONAL).block(command, displacement)
    path = tmp_path / "loop.csv"
    rows = 15.0 * np.stack((command, displacement), axis=1)
    np.savetxt(path, rows, delimiter=",", header="command_um,displacement_um", comments="")
    return path


@pytest.fixture
def step_file(tmp_path):
    time = np.arange(1500) * 1e-3
    path = tmp_path / "step.csv"
    rows = np.stack((time, step_of(PAPER.w1, time)), axis=1)
    np.savetxt(path, rows, delimiter=",", header="time_s,response", comments="")
    return path


def test_hysteresis_of_a_file_is_found(loop_file):
    found = json.loads(lathe("hysteresis", loop_file, "--json").stdout)
    assert found["identified_proportional"] == pytest.approx(PROPORTIONAL)
    assert_allclose(found["identified_weights"], WEIGHTS, atol=1e-9)


def test_hysteresis_is_told_as_parameters(loop_file):
    lines = lathe("hysteresis", loop_file).stdout.splitlines()
    assert lines[1] == "identified_proportional: 0.7617"
    assert lines[3].startswith("identified_weights: [0.04767, ")


def test_channel_of_paper_004_is_found_with_an_inverse_and_a_pid(step_file, tmp_path):
    done = lathe("channel", step_file, "--lags", "--figure", tmp_path / "fit.png", "--json")
    found = json.loads(done.stdout)
    gain = found["model"]["numerator"][0] / found["model"]["denominator"][-1]
    assert gain == pytest.approx(1179.0, rel=1e-4)
    lags = sorted(-1.0 / np.roots(found["model"]["denominator"]))
    assert_allclose(lags, [0.17, 0.22], rtol=1e-2)
    assert found["inverse"]["rms"] < 0.15
    assert found["loop"]["phase_margin_deg"] == pytest.approx(60.0, abs=0.1)
    assert found["loop"]["gain_margin"] is None or found["loop"]["gain_margin"] >= 3.0
    assert (tmp_path / "fit.png").stat().st_size > 10_000


@pytest.mark.parametrize("kind", ["channel", "hysteresis"])
def test_files_that_are_none_are_refused_in_one_line(kind, tmp_path):
    refused = lathe(kind, tmp_path / "nowhere.csv")
    assert refused.exit_code == 2
    assert len(refused.stderr.splitlines()) == 1
