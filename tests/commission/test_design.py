# SPDX-License-Identifier: Apache-2.0
"""Design of the learning law for a measured drive: margins, errors, and the scenario that is written."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cells import config
from click.testing import CliRunner
from machines import line_of

import lathe_rc
from lathe_commission import design
from lathe_commission.design import Design
from lathe_machine.analysis.modal_drive import ModalDrive
from lathe_rc.analysis.frequency_response import FrequencyResponse, write_points
from lathe_rc.cell.wiring import Cell
from lathe_rc.cli import main
from lathe_rc.errors import InputError

DRIVE = {
    "natural_frequency": 1036.7, "damping": 0.7, "delay": 0.2e-3,
    "mode_frequency": [5654.9, 10053.1], "mode_damping": [0.02, 0.02], "mode_participation": [0.02, 0.01],
}  # fmt: skip
OTHER = {**DRIVE, "natural_frequency": 1080.0, "mode_frequency": [5400.0, 10300.0], "mode_participation": [0.03, 0.01]}
LAWS = dict(design.LAWS)
TURNS = "spindle_encoder.revolutions=30"
FAST = [TURNS, "nominal_rpm=3000.0", "learning_controller.feedback_delay=600"]
FAST += ["spindle_encoder.deviation_amplitude=[0.0]", "electrodynamic_actuator.max_acceleration=1000.0"]
FAST += ["electrodynamic_actuator.noise_rms=50e-9", "spindle_encoder.counts_per_revolution=4096"]


@pytest.fixture
def few(monkeypatch):
    laws = {
        name: design.LAWS[name]
        for name in ("lead, Gaussian Q", "measured, flat Q", "inverse, Gaussian Q", "disturbance")
    }
    laws["disturbance"] = design.FilteredLaw(
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
    assert last.reason.startswith("drive margin at most ")
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
    assert lathe_rc.load(tmp_path / "mine.yaml").value("spindle_encoder.revolutions") == 200.0  # that of piston
    run = lathe_rc.run(lathe_rc.load(tmp_path / "mine.yaml", ["spindle_encoder.revolutions=16"]))
    assert run.errors.largest[-10:].max() * 1e6 == pytest.approx(found["laws"][0]["largest_um"]["nominal"], rel=1e-12)


def test_the_inverse_with_a_resonance_errs_less_with_a_drive_that_has_one(monkeypatch):
    """It starts with the model of the fitted drive; for a drive without modes it is not a law of its own."""
    settings = [{"learned_waves": 8.0, "learning_bandwidth": 8000.0, "observer_bandwidth": 0.0}]
    names = ("disturbance", "disturbance, resonance")
    monkeypatch.setattr(design, "LAWS", {name: replace(design.LAWS[name], filters=settings) for name in names})
    varied = config("piston", *FAST, "spindle_encoder.random_rms=0.03", "spindle_encoder.counts_per_revolution=100000")
    found = {each.law: each for each in Design(varied, [DRIVE], 0.1).candidates()}
    assert not any(each.reason for each in found.values())
    assert found[names[1]].nominal.largest < 0.7 * found[names[0]].nominal.largest
    assert [each.law for each in Design(varied, [{}], 0.1).candidates()] == [names[0]]


def test_a_margin_that_no_law_keeps_is_said_and_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(design, "LAWS", {"lead, Gaussian Q": design.LAWS["lead, Gaussian Q"]})
    monkeypatch.chdir(tmp_path)
    drive = ("mode_frequency=[5e3]", "mode_damping=[0.002]", "mode_participation=[0.5]")
    words = [word for each in drive for word in ("--set", f"electrodynamic_actuator.{each}")]
    done = CliRunner().invoke(main, ["design", "piston", "--margin", "1", "--revolutions", "2", *words])
    assert done.exit_code == 1
    assert "lathe: no law is offered for a drive margin of 1; allowed: a smaller --margin" in done.output
    assert not list(tmp_path.iterdir())


def test_an_fir_inverse_is_that_of_the_response_it_is_given():
    """Of the model or of the points; where these are known badly, and beyond them, it amplifies nothing."""
    asked = Design(config("piston", *FAST), [DRIVE, OTHER], 0.3)
    nominal, other = (drive for _, drive in asked._drives)
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
    ((_, drive),) = asked._drives
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
        max(asked._setting(law, values, 0.0).error for values in alike)
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
    ((_, drive),) = asked._drives
    known = design.Known(drive, 0.36e-3, None)
    tried = [values for alike in design.LAWS["inverse, Gaussian Q"].settings(known) for values in alike]
    assert max(asked._setting(design.LAWS["inverse, Gaussian Q"], values, 0.0).error for values in tried[-40:]) > 0.9
    assert asked._settings(design.LAWS["inverse, Gaussian Q"])[0]


def design_of(monkeypatch, folder, laws, *words):
    """Run the command with some laws and settings; return its result."""
    monkeypatch.setattr(design, "LAWS", laws)
    monkeypatch.chdir(folder)
    return CliRunner().invoke(main, ["design", *words])


def only(name, *filters):
    return {name: replace(LAWS[name], filters=filters or LAWS[name].filters)}


def test_a_feedback_delay_that_is_too_long_for_a_law_is_shortened_and_told(tmp_path, monkeypatch):
    """The longest with which the check before a start passes, in table, JSON and scenario; the other speed counts."""
    late = ("--set", "learning_controller.feedback_delay=4000", "--revolutions", "6", "--margin", "0.01")
    laws = only("lead, Gaussian Q", {"q_time": 2e-4})
    done = design_of(monkeypatch, tmp_path, laws, "piston", *late, "--json")
    (law,) = json.loads(done.stdout)["laws"]
    text = (tmp_path / "piston-designed.yaml").read_text()
    assert f"# feedback_delay {law['feedback_delay']} in place of 4000, which is too long for this law" in text
    made = lathe_rc.load(tmp_path / "piston-designed.yaml")
    assert (
        made.nodes["learning_controller"].feedback_delay == law["feedback_delay"] == law["parameters"]["feedback_delay"]
    )
    Cell(made.nodes).check()
    with pytest.raises(InputError, match=f"feedback_delay = {law['feedback_delay'] + 1} samples"):
        Cell(made.varied({"learning_controller.feedback_delay": law["feedback_delay"] + 1}).nodes).check()
    told = design_of(monkeypatch, tmp_path, laws, "piston", *late)
    assert f"with feedback_delay = {law['feedback_delay']}; 4000 is too long for it" in told.output
    wider = design_of(monkeypatch, tmp_path, laws, "piston", *late, "--swing", "0.2", "--json")
    assert json.loads(wider.stdout)["laws"][0]["feedback_delay"] < law["feedback_delay"]


def test_a_law_that_is_not_offered_says_why(tmp_path, monkeypatch):
    """Its own reason each: a cycle without time for a feedback, or a margin with its drive and frequency."""
    fast = [f"electrodynamic_actuator.max_{name}=1e9" for name in ("velocity", "acceleration")]
    fast = [
        word for each in ("nominal_rpm=48000", "learning_controller.q_time=2e-5", *fast) for word in ("--set", each)
    ]
    done = design_of(monkeypatch, tmp_path, only("lead, Gaussian Q"), "piston", "--revolutions", "3", *fast)
    assert done.exit_code == 1
    assert "(lead, Gaussian Q: learning_controller.feedback_delay = 3200 samples: at " in done.output
    laws = only("lead, Gaussian Q", {"q_time": 2e-4}) | only("lead, flat Q", {"q_pass": 2e4, "q_stop": 5e4})
    done = design_of(monkeypatch, tmp_path, laws, "piston", "--revolutions", "4", "--json")
    good, bad = json.loads(done.stdout)["laws"]
    assert (good["offered"], bad["law"], bad["offered"]) == (True, "lead, flat Q", False)
    assert bad["reason"].startswith("drive margin at most 0, with the nominal drive at ")
    done = design_of(monkeypatch, tmp_path, laws, "piston", "--revolutions", "4")
    assert f"not offered: lead, flat Q: {bad['reason']}" in done.output


MODES = {
    "two modes": ((900.0, 0.02, 0.015), (1600.0, 0.02, -0.01)),
    "a low one": ((420.0, 0.03, 0.03),),
    "against the drive": ((700.0, 0.02, -0.02),),
    "a narrow one": ((1100.0, 0.008, 0.004),),
    "a high one": ((2100.0, 0.02, 0.01),),
    "three": ((600.0, 0.03, 0.01), (1000.0, 0.02, 0.01), (1500.0, 0.02, 0.01)),
}
FEW, MANY = np.geomspace(5.0, 2250.0, 60), np.linspace(5.0, 2250.0, 800)
ZERO = {"zero phase, flat Q": ({"q_pass": 2879.0, "q_stop": 4894.0}, {"q_pass": 4884.0, "q_stop": 8303.0})}
ROBUST = {"lead, Gaussian Q": ({"q_time": 4e-4}, {"q_time": 8e-4}, {"q_time": 2e-3})}


def flexible(modes):
    """The drive with modes by frequency [Hz], damping and participation."""
    sections = [(2.0 * np.pi * hertz, zeta, part, 0.0) for hertz, zeta, part in modes]
    return ModalDrive(1036.7, 0.75, 0.2e-3).with_sections(sections, ())


def rigid(path, hertz, modes):
    """Write the parameters of the drive without its modes, and the points that show them."""
    true = flexible(modes)
    parameters = {"/electrodynamic_actuator": {"ros__parameters": flexible(()).parameters()}}
    path.write_text(json.dumps(parameters))
    frequency = 2.0 * np.pi * hertz
    points = FrequencyResponse(frequency, true.response(frequency))
    write_points(path.with_suffix(".points.csv"), points, np.full(frequency.size, 1e-3), "a test")
    return {f"electrodynamic_actuator.{name}": value for name, value in true.parameters().items()}


@pytest.mark.parametrize("hertz", [FEW, MANY], ids=["few", "many"])
@pytest.mark.parametrize("modes", MODES.values(), ids=MODES)
def test_no_setting_has_the_margin_that_the_true_drive_makes_diverge(modes, hertz):
    """The model lacks the modes and only the points show them; between few of them a resonance is higher than there.

    Without the points, the zero-phase law has its margin, and diverges on each of these drives.
    """
    true = flexible(modes).response
    points = FrequencyResponse(2.0 * np.pi * hertz, true(2.0 * np.pi * hertz))
    bare, known = (
        Design(config("piston", *FAST), [flexible(()).parameters()], 0.3, measured) for measured in ((), [points])
    )

    def settings(asked, name, filters):
        return asked._settings(replace(design.LAWS[name], filters=filters))

    (zero,) = ZERO.items()
    alone, _ = settings(bare, *zero)
    assert any(each.loop.stage.drive_margin(true, 100.0 * np.pi).error == 0.0 for each in alone)
    for name, filters in {**ZERO, **ROBUST}.items():
        kept, reason = settings(known, name, filters)
        assert kept or "points" in reason
        for each in kept:
            assert each.loop.stage.drive_margin(true, 100.0 * np.pi).error > 0.0


def test_the_scenario_carries_the_points_and_is_checked_against_them_again(tmp_path, monkeypatch):
    true = rigid(tmp_path / "drive.yaml", MANY, MODES["two modes"])
    laws = only("lead, Gaussian Q", *ROBUST["lead, Gaussian Q"])
    words = [word for each in FAST for word in ("--set", each)]
    done = design_of(monkeypatch, tmp_path, laws, "piston", *words, "--drive", "drive.yaml", "--swing", "0", "--json")
    assert done.exit_code == 0, done.output
    (law,) = json.loads(done.stdout)["laws"]
    assert law["checked"]["points"] == MANY.size
    assert law["checked"]["points_hz"] == pytest.approx([5.0, 2250.0])
    made = lathe_rc.load(tmp_path / "piston-designed.yaml")
    assert made.nodes["electrodynamic_actuator"].response_file == str((tmp_path / "drive.points.csv").resolve())
    cell = Cell(made.nodes)
    cell.check()
    assert cell.drive_margins["learning_controller"].error == pytest.approx(law["drive_margin"]["error"], rel=1e-6)
    run = lathe_rc.run(made.with_models_given().varied({**true, "spindle_encoder.revolutions": 60.0}))
    assert run.errors.largest[-10:].max() < 1.1 * run.errors.largest[20:30].max()


def test_points_of_several_states_all_count(tmp_path, monkeypatch):
    """A mode that only the second state shows rejects a law; the scenario has the points of both in one file."""
    rigid(tmp_path / "other.yaml", MANY, MODES["two modes"])
    rigid(tmp_path / "drive.yaml", MANY, ())
    laws = only("zero phase, flat Q", {"q_pass": 6000.0, "q_stop": 9000.0})
    laws |= only("lead, Gaussian Q", *ROBUST["lead, Gaussian Q"])
    words = ["piston", "--drive", "drive.yaml", "--swing", "0", "--margin", "0.1", "--json"]
    words += [word for each in FAST for word in ("--set", each)]
    first = design_of(monkeypatch, tmp_path, laws, *words)
    (tmp_path / "other.points.csv").rename(tmp_path / "drive.points-2.csv")
    second = design_of(monkeypatch, tmp_path, laws, *words)
    reasons = [{law["law"]: law.get("reason") for law in json.loads(each.stdout)["laws"]} for each in (first, second)]
    assert reasons[0]["zero phase, flat Q"] is None
    assert reasons[1]["zero phase, flat Q"].startswith(
        "drive margin at most 0, with the measured points in state 2 at "
    )
    made = lathe_rc.load(tmp_path / "piston-designed.yaml")
    assert made.nodes["electrodynamic_actuator"].response_file == str(tmp_path / "piston-designed.states.csv")
    drive = Cell(made.nodes).stages["electrodynamic_actuator"]
    states = drive.states()["coarse/command"]
    assert [state.frequency.size for state in states] == [MANY.size] * 2
    assert np.abs(states[0].value - states[1].value).max() > 0.1


def test_the_error_at_the_other_speed_is_that_of_its_run(tmp_path, monkeypatch):
    words = [word for each in FAST for word in ("--set", each)]
    done = design_of(
        monkeypatch, tmp_path, only("lead, Gaussian Q", {"q_time": 3e-4}), "piston", *words, "--drift", "0.02", "--json"
    )
    found = json.loads(done.stdout)
    assert found["speeds"] == ["constant", "swing of ±0 at 10.7 rad/s, drift of 0.02"]
    made = design.with_swing(lathe_rc.load(tmp_path / "piston-designed.yaml"), 0.0, 0.02)
    low, high = Cell(made.nodes).speed_range
    assert high / low == pytest.approx(1.01 / 0.99, rel=1e-4)
    assert lathe_rc.run(made).errors.largest[-10:].max() * 1e6 == found["laws"][0]["largest_um"]["other_speed"]


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        (("two_channel",), "design of two_channel: 2 learning controllers; allowed: a scenario with one"),
        (("piston", "tool.tolerance=0.0"), "design of piston: no tolerance; allowed: tool.tolerance above 0"),
    ],
)
def test_a_cell_that_cannot_be_designed_is_refused(cell, said):
    refusal = line_of(lambda: Design(config(*cell), [{}], 0.3))
    assert refusal == said


def test_a_file_of_no_drive_is_refused(tmp_path):
    path = tmp_path / "drive.yaml"
    path.write_text("/drive:\n  ros__parameters:\n    stiffness: 1.0\n")
    done = CliRunner().invoke(main, ["design", "piston", "--drive", str(path)])
    assert done.exit_code == 2
    assert f"lathe: {path}: stiffness; allowed: parameters of electrodynamic_actuator" in done.output
