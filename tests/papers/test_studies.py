# SPDX-License-Identifier: Apache-2.0
"""``lathe study``: the frame, and what each study finds."""

import functools
import json
import signal
from dataclasses import FrozenInstanceError, fields, replace

import numpy as np
import pytest
from cells import cuts, in_blocks
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from numpy.testing import assert_allclose

from lathe_machine.analysis.regeneration import Regeneration
from lathe_machine.transfer import TransferFunction
from lathe_papers import angle_domain, drive_models, invariance
from lathe_papers.angle_domain import AngleDomainParameters
from lathe_papers.formulas.invariance import FirstOrderInvariance
from lathe_papers.formulas.loaded import compliance
from lathe_papers.formulas.step_fit import SecondOrder
from lathe_papers.invariance import InvarianceParameters
from lathe_rc.cli import main
from lathe_rc.commands import study as commands_study
from lathe_rc.commands.study import read
from lathe_rc.errors import InputError, LatheError
from lathe_rc.signals import speed
from lathe_rc.study import STUDIES

KEYS = {
    "invariance": "speeds angles corrected uncorrected max_spread_corrected max_spread_uncorrected "
    "deviation_amplitude deviation_frequencies deviation_spread_corrected deviation_spread_uncorrected "
    "deviation_spread_wrong_order",
    "angle-domain": "amplitudes frequencies tolerance gost exact quasi_static linearised "
    "good_to_exact good_to_quasi_static good_to_linearised",
    "drive-models": "file time_s measured harmonic_rad_s models",
    "sampled-servo": "table links series uncorrected analog",
    "saturation": "period_max_error u_max memory_max corners saturated_samples integrator eq_15 eq_14 learning "
    "required_u checks curves",
    "decoupling": "preset plant stability robustness single_loop cross noise delay engagement reduced_order",
    "coupling": "delays position_difference invented_energy limits speed_deviation speed_difference "
    "edge_difference angle force moved speed slowed",
}
#: settings with which a study takes a moment only
QUICK = {
    "invariance": ["deviation_frequencies=213"],
    "angle-domain": ["amplitudes=0.05,0.1", "frequencies=50,200"],
    "drive-models": [],
    "sampled-servo": ["t=0.16"],
    "saturation": ["periods=2", "step_ms=10"],
    "decoupling": ["seconds=4"],
    "coupling": ["delays=1,16,64"],
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder to work in; the command's handling of SIGTERM ends with the test."""
    monkeypatch.chdir(tmp_path)
    before = signal.getsignal(signal.SIGTERM)
    yield tmp_path
    signal.signal(signal.SIGTERM, before)


def study(*arguments, sets=()):
    options = [part for override in sets for part in ("--set", override)]
    return CliRunner(env={"COLUMNS": "80"}).invoke(main, ["study", *arguments, *options])


@functools.cache
def quick(name):
    """The result of a study with its quick settings, and the items that its progress has counted."""
    items = []

    def track(sequence):
        for item in sequence:
            items.append(item)
            yield item

    return STUDIES[name].run(read(STUDIES[name], QUICK[name]), track), items


def printed(name, sets=()):
    """The result of a study, as it is printed; no figure is drawn, which takes longest."""
    subject = STUDIES[name]
    result = subject.run(read(subject, sets)) if sets else quick(name)[0]
    return json.loads(json.dumps(result.to_json(), allow_nan=False))


# --- the frame


def test_without_a_name_the_studies_are_listed():
    result = study()
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.stdout.splitlines()] == list(STUDIES)


@pytest.mark.parametrize("name", STUDIES)
def test_help_lists_the_parameters_whose_defaults_are_allowed(name):
    result = study(name, "--help")
    assert result.exit_code == 0
    for row in STUDIES[name].parameters.rows().values():
        assert row.name in result.stdout
        assert row.unit == "1" or f"[{row.unit}]" in result.stdout
    assert STUDIES[name].parameters().model_dump()


LONG = {"angle-domain", "coupling", "decoupling", "sampled-servo", "saturation"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.system) if name in LONG else name for name in KEYS]
)
def test_study_prints_a_table_or_json_and_draws_a_figure(folder, name, monkeypatch):
    """A table of 80 columns, or one line of JSON with exactly the promised keys; nothing on the error stream."""
    result, items = quick(name)
    assert items
    with pytest.raises(FrozenInstanceError):
        setattr(result, fields(result)[0].name, None)
    computed = replace(STUDIES[name], run=lambda _parameters, _track: result)
    monkeypatch.setattr(commands_study, "STUDIES", {name: computed})
    as_json = study(name, "--json", sets=QUICK[name])
    assert (as_json.exit_code, as_json.stderr) == (0, "")
    assert as_json.stdout.count("\n") == 1
    assert list(json.loads(as_json.stdout)) == [*KEYS[name].split(), "figure"]
    assert json.loads(as_json.stdout) == {**printed(name), "figure": f"study-{name}.png"}
    assert [path.name for path in folder.iterdir()] == [f"study-{name}.png"]
    assert (folder / f"study-{name}.png").read_bytes().startswith(b"\x89PNG")
    paths = []
    monkeypatch.setattr(commands_study, "_save", lambda _study, _result, path: paths.append(str(path)))
    table = study(name, "--figure", "a.png", sets=QUICK[name])
    assert (table.exit_code, table.stderr) == (0, "")
    assert table.stdout.splitlines()[-1] == "figure: a.png"
    assert max(map(len, table.stdout.splitlines())) <= 80
    assert "…" not in table.stdout
    assert paths == ["a.png"]


@pytest.mark.parametrize("text", ["84,105,126.5", "[84, 105, 126.5]", " 84 , 1.05e2,126.5"])
def test_lists_are_numbers_with_commas(text):
    assert read(STUDIES["invariance"], [f"speeds={text}"]).speeds == [84.0, 105.0, 126.5]


def test_one_number_is_a_list_of_one_and_the_last_setting_counts():
    assert read(STUDIES["invariance"], ["speeds=84,105", "speeds=120"]).speeds == [120.0]
    with pytest.raises(InputError, match="at least one"):
        InvarianceParameters(speeds=[])


# --- the correction of paper 000, eqs 13-17

laws = st.builds(
    lambda amplitude, frequency, phase: speed.harmonic(
        105.0, np.array([amplitude]), np.array([frequency]), np.array([phase])
    ),
    st.floats(0.0, 0.6),
    st.floats(1.0, 1500.0),
    st.floats(0.0, 6.0),
)


def corrected(law, desired, lengths=None, step=1e-5):
    """Angle, v and u; ``desired`` of the angle."""
    angle, omega, _ = law.at(np.arange(1000) * step)
    wanted = desired(angle)
    substitute, command = np.empty((2, angle.size))
    machine = FirstOrderInvariance(2e-3, 0.21)

    def block(first, a, w, y, v, u):
        machine.block(angle=a, speed=w, desired=y, substitute=v, command=u)

    in_blocks(lengths or [angle.size], block, angle, omega, wanted, substitute, command)
    return angle, substitute, command


@given(laws)
def test_substitute_is_a_function_of_the_angle_alone(law):
    """Analytic, for a step and for a ramp over the angle, at any speed law."""
    angle, v, _ = corrected(law, np.ones_like)
    assert_allclose(v, -np.expm1(-angle / 0.21), atol=1e-12)
    angle, v, _ = corrected(law, lambda angle: angle)
    assert_allclose(v, angle + 0.21 * np.expm1(-angle / 0.21), atol=1e-12)


@given(laws)
def test_command_is_the_inverse_of_the_plant(law):
    """u = v + T0·dv/dt, here with dv/dt by differences."""
    _, v, u = corrected(law, lambda angle: np.sin(2 * angle))
    assert_allclose(u[1:-1], (v + 2e-3 * np.gradient(v, 1e-5))[1:-1], atol=2e-4)


@given(cuts)
def test_length_of_blocks_changes_no_bit(lengths):
    lengths = [*lengths, max(1000 - sum(lengths), 0)]
    lengths = [b for n, b in enumerate(lengths) if sum(lengths[: n + 1]) <= 1000] or [1000]
    law = speed.harmonic(105.0, np.array([0.1]), np.array([213.0]), np.zeros(1))
    used = sum(lengths)
    for cut, whole in zip(corrected(law, np.cos, lengths), corrected(law, np.cos), strict=True):
        assert np.array_equal(cut[:used], whole[:used])


def test_spindle_may_stand_but_not_turn_back():
    machine = FirstOrderInvariance(2e-3, 0.21)
    v, u = np.empty((2, 3))
    machine.block(angle=np.array([0.0, 0.1, 0.1]), speed=np.zeros(3), desired=np.ones(3), substitute=v, command=u)
    assert v[1] == v[2] > 0.0
    with pytest.raises(LatheError, match=r"turns back to 0\.05 rad"):
        machine.block(angle=np.array([0.05]), speed=np.zeros(1), desired=np.ones(1), substitute=v[:1], command=u[:1])


# --- invariance


def test_corrected_responses_coincide_and_others_do_not():
    found = printed("invariance")
    corrected_, alone, angles = (np.array(found[key]) for key in ("corrected", "uncorrected", "angles"))
    assert corrected_.shape == alone.shape == (3, angles.size)
    assert_allclose(corrected_, np.tile(-np.expm1(-angles / 0.21), (3, 1)), atol=1e-6)
    for row, omega in zip(alone, found["speeds"], strict=True):
        assert_allclose(row, -np.expm1(-angles / (2e-3 * omega)), atol=1e-9)
    assert found["max_spread_corrected"] == np.ptp(corrected_, axis=0).max() < 1e-6
    assert found["max_spread_uncorrected"] == np.ptp(alone, axis=0).max() > 0.1


def test_deviation_changes_nothing_in_the_right_order_only():
    found = printed("invariance", sets=["deviation_frequencies=10.7,213,1000"])
    right, wrong, alone = (
        np.array(found[f"deviation_spread_{chain}"]) for chain in ("corrected", "wrong_order", "uncorrected")
    )
    assert np.all(right < 1e-6)
    assert np.all(alone > 0.05)
    # The error of the wrong order grows with dΩ/dt, until the correction is worse than none.
    assert np.all(np.diff(wrong) > 0.0)
    assert wrong[0] < 0.1 * alone[0]
    assert wrong[-1] > alone[-1]


def test_at_constant_speed_the_order_does_not_matter():
    angles = np.linspace(0.0, 1.0, 50)
    right, _, wrong = invariance.responses(speed.constant(126.0), 2e-3, 105.0, angles)
    assert_allclose(right, wrong, atol=1e-6)


# --- angle domain


@pytest.mark.system
def test_errors_stand_by_amplitude_and_frequency():
    found = printed("angle-domain")
    for kind in ("exact", "quasi_static", "linearised"):
        assert np.shape(found[kind]) == (2, 2)
    errors = np.array(found["quasi_static"])
    assert np.array(found["exact"]).max() < 1e-6
    # a_2·dΩ/dt·sX through the drive: as the amplitude and as the frequency.
    gain = abs(1 / np.polyval([1 / 1038**2, 2 * 0.804 / 1038, 1.0], 2j * 1000 * np.pi / 30))
    estimate = np.outer([0.05, 0.1], [50.0, 200.0]) * 2 * 1000 * np.pi / 30 / 1038**2 * gain**2
    assert_allclose(errors, estimate, rtol=0.06)


def test_good_to_is_the_last_frequency_within_the_tolerance():
    found = angle_domain.run(
        AngleDomainParameters(amplitudes=[0.01, 0.1, 0.3], frequencies=[10.0, 50.0, 200.0], tolerance=2e-3)
    )
    by_key = found.to_json()
    for kind in ("exact", "quasi_static", "linearised"):
        for row, limit in zip(by_key[kind], by_key[f"good_to_{kind}"], strict=True):
            good = [f for f, error in zip(by_key["frequencies"], row, strict=True) if error <= 2e-3]
            assert limit == (max(good) if good else None)
    assert by_key["good_to_exact"] == [200.0] * 3
    assert by_key["good_to_quasi_static"] == [200.0, 50.0, 10.0]
    assert by_key["good_to_linearised"][2] is None


@pytest.mark.system
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("tolerance", [0.9, 1e-12])
def test_figure_of_a_map_that_is_good_or_bad_everywhere(tolerance):
    """No contour of the tolerance then, and no warning."""
    found = quick("angle-domain")[0]
    replace(found, parameters=found.parameters.model_copy(update={"tolerance": tolerance})).draw(Figure())


# --- drive models


def model(found, name, *, fitted=True):
    (one,) = [m for m in found["models"] if m["name"] == name and m["fitted"] == fitted]
    return one


def test_fits_of_the_simulated_drive():
    found = printed("drive-models")
    assert found["file"] is None
    assert model(found, "first order")["parameters"]["time_constant"] == pytest.approx(2e-3, rel=0.02)
    assert model(found, "delay")["parameters"]["delay"] == pytest.approx(2e-3, rel=0.1)
    exact = model(found, "second order with delay")
    assert exact["parameters"] == pytest.approx(
        {"natural_frequency": 1038.0, "damping": 0.804, "delay": 0.36e-3}, rel=1e-3
    )
    assert exact["rms"] < 1e-5
    for one in found["models"]:
        assert one["rms"] == pytest.approx(np.sqrt(np.mean(np.subtract(one["step"], found["measured"]) ** 2)), rel=1e-3)


def test_learning_with_each_model():
    """|Q - Z| by hand at the oval's harmonic; where the inverse is that of the drive only Q is left."""
    found = printed("drive-models")
    omega = 2 * 1000 * np.pi / 30
    q = 1 / (1 + (omega * 130e-6) ** 2)
    drive = SecondOrder(1038.0, 0.804, 0.36e-3).response(np.array([omega]))[0]
    assert found["harmonic_rad_s"] == pytest.approx(omega)
    assert model(found, "second order with delay")["contraction"] == pytest.approx(1 - q, rel=0.02)
    delay = model(found, "delay", fitted=False)
    assert delay["contraction"] == pytest.approx(abs(q - drive * np.exp(2e-3j * omega)), rel=1e-6)
    first = model(found, "first order", fitted=False)
    assert first["contraction"] == pytest.approx(abs(q - drive * (1 + 2e-3j * omega)), rel=1e-6)
    converging = [m["name"] for m in found["models"] if m["fitted"] and m["converges"]]
    assert converging == ["delay", "second order with delay"]


def test_lead_of_the_paper_needs_its_filter():
    """T0 = 2 ms converges with Q of 104 µs and more (spec)."""
    for q_time, converges in (("100e-6", False), ("108e-6", True)):
        found = printed("drive-models", sets=[f"q_time={q_time}"])
        assert model(found, "delay", fitted=False)["converges"] is converges


def test_measured_response_takes_the_place_of_the_simulated(folder):
    time = np.linspace(0.0, 30e-3, 400)
    response = SecondOrder(500.0, 1.2, 1e-3).step(time)
    rows = "".join(f"{t * 1e3},{h}\n" for t, h in zip(time, response, strict=True))
    (folder / "step.csv").write_text("time_ms,response\n" + rows)
    found = printed("drive-models", sets=["file=step.csv"])
    assert found["file"] == "step.csv"
    assert_allclose(found["measured"], response)
    best = model(found, "second order with delay")["parameters"]
    assert best == pytest.approx({"natural_frequency": 500.0, "damping": 1.2, "delay": 1e-3}, rel=1e-3)


@pytest.mark.parametrize("drive", [SecondOrder(1038.0, 0.804, 0.36e-3), SecondOrder(100.0, 3.0), SecondOrder(5e3, 0.1)])
def test_step_test_has_no_half_step_of_latency(drive):
    """The simulated measurement is the step response itself, for any drive."""
    measured = drive_models._simulated(drive)
    assert_allclose(measured.response, drive.step(measured.time), atol=2e-3)
    assert measured.rms(drive) < 3e-4


@pytest.mark.system
def test_a_delay_between_drive_and_cut_lowers_the_limit_of_chatter_and_brings_energy_in():
    """Without a delay the limit is that of `Regeneration`; the error of the edge grows with the delay from 0 on."""
    found = printed("coupling")
    give = compliance(natural_frequency=1038.0, damping=0.804, moving_mass=1.2)
    radial = TransferFunction(tuple(0.4 * each for each in give.numerator), give.denominator)
    assert found["limits"][0] == pytest.approx(Regeneration(radial).worst().stiffness, rel=1e-4)
    assert found["limits"][3] < 0.5 * found["limits"][0]
    edge = found["position_difference"]
    assert edge[1] == pytest.approx(16 * edge[0], rel=0.02)
    assert 0.0 < found["invented_energy"][0] < found["invented_energy"][1] < found["invented_energy"][2]
    assert found["speed_difference"][0] == 0.0 < found["speed_difference"][1] < found["speed_difference"][2]
