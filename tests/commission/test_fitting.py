# SPDX-License-Identifier: Apache-2.0
"""``lathe fit``: what is found in a measurement is what made it."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose

from lathe_commission.commands import fit
from lathe_commission.reduced_order import step_of
from lathe_machine.analysis import pid_tuning
from lathe_machine.control.decoupler import PAPER
from lathe_machine.plants.hysteresis import THRESHOLDS, WEIGHTS, PrandtlIshlinskii
from lathe_rc.cli import main

PROPORTIONAL = 0.7617


def lathe(*arguments):
    return CliRunner().invoke(main, ["fit", *map(str, arguments)])


def written(path, header, *columns):
    np.savetxt(path, np.stack(columns, axis=1), delimiter=",", header=header, comments="")
    return path


def step_file(folder, time, response):
    return written(folder / "step.csv", "time_s,response", time, response)


def test_hysteresis_of_a_file_is_found_and_told_as_parameters(tmp_path):
    command = np.sin(np.linspace(0.0, 6.0 * np.pi, 3000))
    displacement = np.empty_like(command)
    PrandtlIshlinskii(THRESHOLDS, WEIGHTS, PROPORTIONAL).block(command, displacement)
    path = written(tmp_path / "loop.csv", "command_um,displacement_um", 15.0 * command, 15.0 * displacement)
    found = json.loads(lathe("hysteresis", path, "--json").stdout)
    assert found["identified_proportional"] == pytest.approx(PROPORTIONAL)
    assert_allclose(found["identified_weights"], WEIGHTS, atol=1e-9)
    lines = lathe("hysteresis", path).stdout.splitlines()
    assert lines[1] == "identified_proportional: 0.7617"
    assert lines[3].startswith("identified_weights: [0.04767, ")


def test_channel_of_paper_004_is_found_with_an_inverse_and_a_pid(tmp_path):
    time = np.arange(1500) * 1e-3
    path = step_file(tmp_path, time, step_of(PAPER.w1, time))
    found = json.loads(lathe("channel", path, "--lags", "--figure", tmp_path / "fit.png", "--json").stdout)
    gain = found["model"]["numerator"][0] / found["model"]["denominator"][-1]
    assert gain == pytest.approx(1179.0, rel=1e-4)
    lags = sorted(-1.0 / np.roots(found["model"]["denominator"]))
    assert_allclose(lags, [0.17, 0.22], rtol=1e-2)
    assert found["inverse"]["rms"] < 0.15
    assert found["loop"]["phase_margin_deg"] == pytest.approx(60.0, abs=0.1)
    assert found["loop"]["gain_margin"] is None or found["loop"]["gain_margin"] >= 3.0
    assert (tmp_path / "fit.png").stat().st_size > 10_000


def decay(time):
    return 1.0 - np.exp(-time / 0.02)


def first_away(time):
    """(1 - 0.01 p)/(1 + 0.02 p)^2: it turns away first."""
    return 1.0 - np.exp(-time / 0.02) * (1.0 + 1.5 * time / 0.02)


@pytest.mark.parametrize(
    ("response", "step", "options", "lacking", "message"),
    [
        (decay, 5e-3, ["--lag", "1e-3"], {"inverse"}, "inverse: response in steps of 0.005 s, .*--lag 0.005, or a"),
        (decay, 5e-3, [], set(), ""),
        (lambda t: t - 0.02 * decay(t), 1e-3, ["--integrator"], set(), ""),
        (lambda t: 5.0 * t, 0.1, ["--integrator"], set(), ""),
        (first_away, 1e-3, ["--poles", "2", "--zeros", "1"], {"inverse"}, "inverse of .*a zero that is not stable; "),
        (lambda t: -decay(t), 1e-3, [], {"pid", "loop"}, "tuning: no crossover from 5 to 500 rad/s has margins of 60"),
        (decay, 1e-3, ["--gain-margin", "1e9"], {"pid", "loop"}, r"tuning: no crossover from .* of 60° and 1e\+09"),
        (lambda t: -decay(t), 0.005, ["--lag", "1e-3"], {"inverse", "pid", "loop"}, "inverse: .*; tuning: no "),
    ],
)
def test_a_model_without_an_inverse_or_a_pid_is_kept(tmp_path, monkeypatch, response, step, options, lacking, message):
    """With the reason in one line, and exit code 1."""
    monkeypatch.setattr(pid_tuning, "_TRIES", 4)
    monkeypatch.setattr(fit, "_draw", lambda *_: None)
    time = np.arange(60) * step
    path = step_file(tmp_path, time, response(time))
    done = lathe("channel", path, "--poles", 1, *options, "--figure", tmp_path / "fit.svg", "--json")
    found = json.loads(done.stdout)
    assert found["model"]["rms"] < 1e-3 * np.abs(response(time)).max()
    assert {name for name in ("inverse", "pid", "loop") if found[name] is None} == lacking
    assert done.exit_code == (1 if lacking else 0)
    assert len(done.stderr.splitlines()) == bool(lacking)
    assert re.match(f"lathe: {path}: {message}" if lacking else "$", done.stderr)


@pytest.mark.parametrize("kind", ["step", "response"])
def test_channel_with_a_delay_is_found_in_either_measurement(tmp_path, monkeypatch, kind):
    """The inverse is that of the rest; the PID meets the delay."""
    monkeypatch.setattr(pid_tuning, "_TRIES", 4)
    delay, time = 0.07, np.arange(200) * 1e-2
    if kind == "step":
        late = np.maximum(time - delay, 0.0)
        path = step_file(tmp_path, time, 3.0 - 3.0 * np.exp(-late / 0.2))
    else:
        frequency = np.geomspace(0.05, 20.0, 60)
        value = 3.0 / (1.0 + 0.2j * 2 * np.pi * frequency) * np.exp(-2j * np.pi * frequency * delay)
        columns = (frequency, 20.0 * np.log10(np.abs(value)), np.degrees(np.angle(value)))
        path = written(tmp_path / "response.csv", "frequency_hz,magnitude_db,phase_deg", *columns)
    done = lathe("channel", path, "--poles", 1, "--dead-time", "--figure", tmp_path / "fit.png", "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["model"]["delay"] == pytest.approx(delay, rel=1e-2)
    assert_allclose(found["model"]["numerator"][0] / found["model"]["denominator"][-1], 3.0, rtol=1e-3)
    assert -1.0 / np.roots(found["model"]["denominator"])[0] == pytest.approx(0.2, rel=1e-2)
    assert found["inverse"]["rms"] < 0.2
    assert found["loop"]["phase_margin_deg"] == pytest.approx(60.0, abs=0.5)


def test_a_model_alone_is_told_in_words(tmp_path, monkeypatch):
    monkeypatch.setattr(pid_tuning, "_TRIES", 4)
    time = np.arange(20) * 5e-3
    path = step_file(tmp_path, time, -decay(time))
    done = lathe("channel", path, "--poles", 1, "--lag", 1e-3, "--figure", tmp_path / "fit.svg")
    assert [line[:9] for line in done.stdout.splitlines()] == ["model    ", "figure:  "]
