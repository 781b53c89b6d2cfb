# SPDX-License-Identifier: Apache-2.0
"""Design of the learning law for a measured drive: margins, errors, and the scenario that is written."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cells import config
from click.testing import CliRunner

import lathe_rc
from lathe_rc.analysis.frequency_response import FrequencyResponse
from lathe_rc.cell import design
from lathe_rc.cell.design import Design
from lathe_rc.cell.wiring import Cell
from lathe_rc.cli import main
from lathe_rc.errors import InputError

DRIVE = {
    "natural_frequency": 1036.7, "damping": 0.7, "delay": 0.2e-3,
    "mode_frequency": [5654.9, 10053.1], "mode_damping": [0.02, 0.02], "mode_participation": [0.02, 0.01],
}  # fmt: skip
OTHER = {**DRIVE, "natural_frequency": 1080.0, "mode_frequency": [5400.0, 10300.0], "mode_participation": [0.03, 0.01]}
TURNS = "spindle_encoder.revolutions=30"
FAST = [TURNS, "nominal_rpm=3000.0", "learning_controller.feedback_delay=640"]
FAST += ["spindle_encoder.deviation_amplitude=[0.0]", "electrodynamic_actuator.max_acceleration=1000.0"]
FAST += ["electrodynamic_actuator.noise_rms=50e-9", "spindle_encoder.counts_per_revolution=4096"]


@pytest.fixture
def few(monkeypatch):
    laws = {
        name: design.LAWS[name]
        for name in ("lead, Gaussian Q", "measured, flat Q", "inverse, Gaussian Q", "disturbance")
    }
    laws["disturbance"] = design.Law(
        "disturbance_controller",
        {"identify": False},
        [{"learned_waves": waves, "observer_bandwidth": 0.0} for waves in (8.0, 60.0)],
        "",
    )
    monkeypatch.setattr(design, "LAWS", laws)


@pytest.mark.usefixtures("few")
def test_the_best_law_keeps_the_margin_with_every_drive_and_its_runs_give_the_error_shown():
    asked = Design(config("piston", *FAST), [DRIVE, OTHER], 0.3)
    best, second, last = asked.candidates()
    assert (best.law, second.law, last.law) == ("disturbance", "lead, Gaussian Q", "inverse, Gaussian Q")
    assert best.worst.largest < second.worst.largest
    assert last.scenario is None
    for each in (best, second):
        found = []
        for drive in asked.drives:
            scenario = each.scenario.with_models_given().varied(drive)
            cell = Cell(scenario.nodes)
            cell.check()
            (margin,) = cell.drive_margins.values()
            assert margin.error >= 0.3
            found.append((margin.error, lathe_rc.run(scenario).errors.largest[-10:].max()))
        assert min(found)[0] == pytest.approx(each.margin.error, rel=1e-6)
        assert max(largest for _, largest in found) == each.worst.largest
        assert found[0][1] == each.nominal.largest


@pytest.mark.usefixtures("few")
def test_the_command_writes_the_scenario_of_the_best_law(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    values = "\n".join(f"    {name}: {value}" for name, value in DRIVE.items())
    (tmp_path / "drive.yaml").write_text(f"/electrodynamic_actuator:\n  ros__parameters:\n{values}\n")
    names = ",".join(f"electrodynamic_actuator.{name}" for name in OTHER)
    (tmp_path / "drive.drives.csv").write_text(names + "\n" + ",".join(f'"{value}"' for value in OTHER.values()) + "\n")
    words = ["design", "piston", "--drive", "drive.yaml", "-o", "mine.yaml", "--json"]
    done = CliRunner().invoke(
        main, [*words, *(word for each in FAST[1:] for word in ("--set", each)), "--revolutions", "16"]
    )
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert (found["drives"], found["laws"][0]["law"]) == (2, "disturbance")
    run = lathe_rc.run(lathe_rc.load(tmp_path / "mine.yaml"))
    assert run.errors.largest[-10:].max() * 1e6 == pytest.approx(found["laws"][0]["largest_um"]["nominal"], rel=1e-12)


def test_a_margin_that_no_law_keeps_is_said_and_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(design, "LAWS", {"lead, Gaussian Q": design.LAWS["lead, Gaussian Q"]})
    monkeypatch.chdir(tmp_path)
    drive = ("mode_frequency=[5e3]", "mode_damping=[0.002]", "mode_participation=[0.5]")
    words = [word for each in drive for word in ("--set", f"electrodynamic_actuator.{each}")]
    done = CliRunner().invoke(main, ["design", "piston", "--margin", "1", "--revolutions", "2", *words])
    assert done.exit_code == 1
    assert "lathe: no law keeps a drive margin of 1; allowed: a smaller --margin" in done.output
    assert not list(tmp_path.iterdir())


def test_an_fir_inverse_is_that_of_the_response_it_is_given():
    """Of the model or of the points; where these are known badly, and beyond them, it amplifies nothing."""
    asked = Design(config("piston", *FAST), [DRIVE, OTHER], 0.3)
    nominal, other = asked._responses(asked.drives)
    frequency = np.linspace(100.0, 14_000.0, 1400)
    noise = np.where(frequency < 9000.0, 1e-4, 10.0)
    known = design.Known(nominal, 0.2e-3, FrequencyResponse(frequency, other(frequency), noise))

    def inverted(drive, at, *, measured):
        found = known.inverse(1e-3, measured=measured)
        leads = found["lead_time"] - found["correction_interval"] * np.arange(len(found["correction_taps"]))
        return np.exp(1j * np.outer(at, leads)) @ found["correction_taps"] * drive(at)

    band, beyond = np.linspace(200.0, 7000.0, 400), np.linspace(10_500.0, 20_000.0, 100)
    for drive, others, measured in ((nominal, other, False), (other, nominal, True)):
        assert np.abs(np.angle(inverted(drive, band, measured=measured))).max() < 0.4
        assert np.abs(np.angle(inverted(others, band, measured=measured))).max() > 1.5
    of_model, of_points = (np.abs(inverted(np.ones_like, beyond, measured=each)).max() for each in (False, True))
    assert (of_points < 1.0, of_model > 10.0) == (True, True)


def test_notches_stop_the_resonances_without_a_phase_and_raise_the_margin():
    asked = Design(config("piston", *FAST), [DRIVE], 0.3)
    (drive,) = asked._responses(asked.drives)
    known, lead = design.Known(drive, 0.2e-3, None, DRIVE["mode_frequency"]), 1.5e-3
    found = known.notched(lead)
    leads = found["lead_time"] - found["correction_interval"] * np.arange(len(found["correction_taps"]))
    beside = np.array([300.0, 1000.0, *DRIVE["mode_frequency"]])
    response = np.exp(1j * np.outer(beside, leads)) @ found["correction_taps"] * np.exp(-1j * beside * lead)
    np.testing.assert_allclose(response, [1.0, 1.0, 0.0, 0.0], atol=0.1)
    laws = (design.LAWS["lead, flat Q"], design.LAWS["notch, flat Q"])
    wide = [replace(law, filters=[{"q_pass": 3433.0, "q_stop": 8582.0}]) for law in laws]
    settings = [next(law.settings(known)) for law in wide]
    without, notched = (
        max(asked._margin_of(law, values, [drive]) for values in alike)
        for law, alike in zip(wide, settings, strict=True)
    )
    assert notched > without + 0.2


def test_an_fir_inverse_that_the_cycle_is_too_short_for_is_refused():
    taps = ["learning_controller.correction=fir", f"learning_controller.correction_taps={[1.0] * 50}"]
    with pytest.raises(InputError, match=r"50 correction_taps in .* 0.05 s; allowed: up to 0.031"):
        Cell(config("piston", *taps, "learning_controller.correction_interval=1e-3").nodes)
    with pytest.raises(InputError, match="lead_time = 0 s with correction fir"):
        Cell(config("piston", *taps, "learning_controller.lead_time=0.0").nodes)


def test_the_inverse_laws_have_the_delay_of_a_drive_that_no_file_describes():
    asked = Design(config("piston"), [{}], 0.3)
    (drive,) = asked._responses(asked.drives)
    known = design.Known(drive, 0.36e-3, None)
    tried = [values for alike in design.LAWS["inverse, Gaussian Q"].settings(known) for values in alike]
    assert max(asked._margin_of(design.LAWS["inverse, Gaussian Q"], values, [drive]) for values in tried[-40:]) > 0.9
    assert asked._settings(design.LAWS["inverse, Gaussian Q"])


def test_a_cell_that_runs_with_no_law_says_why(tmp_path, monkeypatch):
    monkeypatch.setattr(design, "LAWS", {"lead, Gaussian Q": design.LAWS["lead, Gaussian Q"]})
    monkeypatch.chdir(tmp_path)
    late = "learning_controller.feedback_delay=4000"
    done = CliRunner().invoke(main, ["design", "piston", "--margin", "0.01", "--revolutions", "3", "--set", late])
    assert done.exit_code == 1
    assert "lathe: no law" in done.output
    assert "feedback_delay = 4000 samples: at 115.2 rad/s the cycle leaves" in done.output
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        (("two_channel",), "design of two_channel: 2 learning controllers; allowed: a scenario with one"),
        (("piston", "tool.tolerance=0.0"), "design of piston: no tolerance; allowed: tool.tolerance above 0"),
    ],
)
def test_a_cell_that_cannot_be_designed_is_refused(cell, said):
    with pytest.raises(InputError) as refusal:
        Design(config(*cell), [{}], 0.3)
    assert str(refusal.value) == said


def test_a_file_of_no_drive_is_refused(tmp_path):
    path = tmp_path / "drive.yaml"
    path.write_text("/drive:\n  ros__parameters:\n    stiffness: 1.0\n")
    done = CliRunner().invoke(main, ["design", "piston", "--drive", str(path)])
    assert done.exit_code == 2
    assert f"lathe: {path}: stiffness; allowed: parameters of electrodynamic_actuator" in done.output
