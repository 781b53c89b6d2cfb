# SPDX-License-Identifier: Apache-2.0
"""Learning control from a measured response, in Python: the same loop as in the cell, and trials in lifted form."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal

import lathe_rc
from lathe_commission import ilc
from lathe_rc.errors import InputError

F = np.geomspace(5.0, 2000.0, 240)
W, ZETA = 1038.0, 0.8
OVAL = ilc.reference({2: 100e-6, 6: 5e-6}, rpm=1000.0)
SPEED = 1000.0 * 2.0 * np.pi / 60.0
DRIVE = signal.lti([W**2], [1.0, 2.0 * ZETA * W, W**2])
DELAY = np.exp(-2j * np.pi * F * 0.36e-3)
PLANT = signal.dlti([0.2, 0.1], [1.0, -0.7, 0.1], dt=1e-3)  # with a delay of one sample


@pytest.fixture(scope="module")
def measured():
    return ilc.frequency_response(F, signal.freqresp(DRIVE, 2.0 * np.pi * F)[1] * DELAY)


@pytest.fixture(scope="module")
def known(measured):
    return measured.fit()


def test_the_margin_of_arrays_is_that_of_the_formula_at_each_point(measured):
    """(1 - |Q - γZ|)/|γZ|; no claim is made beyond the points, and Q is 0 there."""
    learning = ilc.learning_filter(measured, "lead")
    q = ilc.q_filter(measured, learning, margin=0.3)
    loop = ilc.Loop(measured, learning, q)
    waves = 2.0 * np.pi * F / SPEED
    factor = loop.factor(waves)
    acts = ilc.Loop(measured, learning, {**q, "learning_gain": 1e-9}).factor(waves) - factor  # γZ
    brute = (1.0 - np.abs(factor)) / np.abs(acts)
    found = loop.margin()
    assert found.error == pytest.approx(brute.min(), rel=1e-6)
    assert found.frequency == pytest.approx(F[brute.argmin()])
    assert found.points == pytest.approx((5.0, 2000.0))
    assert q["q_stop"] <= 2.0 * np.pi * 2000.0
    assert f"beyond too: where the drive moves less than {found.beyond:.3g}, it converges" in str(found)
    high = np.linspace(waves[-1], 500.0, 2000)
    ones = ilc.Loop(measured, learning, q)._stage.loop(np.ones_like)
    for size, least in ((0.999 * found.beyond, False), (1.01 * found.beyond, True)):
        phases = np.exp(2j * np.pi * np.arange(60) / 60)
        kept = ones.operators(high, SPEED, list(size * phases))
        assert (max(np.abs(each).max() for each in kept) > 1.0) == least


@pytest.mark.parametrize("kind", ["lead", "inverse", "zero-phase"])
def test_a_run_leaves_the_expected_error(kind, known):
    """A Q that is too narrow for the form leaves 0.8 µm; the shipped cell and the formula agree."""
    loop = ilc.Loop(known, ilc.learning_filter(known, kind), {"q_filter": "gaussian", "q_time": 400e-6})
    expected = loop.asymptotic_error(OVAL)
    assert expected.rms > 0.5e-6
    run = loop.simulate(known, OVAL, trials=20)
    assert run.errors[-1] == pytest.approx(expected.rms, rel=0.02)
    assert loop.expected_errors(OVAL, 20)[-1] == pytest.approx(expected.rms, rel=1e-3)
    axes = run.plot_convergence(loop).axes[0]
    assert axes.get_lines()[0].get_ydata() == pytest.approx(run.errors * 1e6)


def test_the_written_scenario_is_the_run(known, tmp_path):
    learning = ilc.learning_filter(known)
    loop = ilc.Loop(known, learning, ilc.q_filter(known, learning, margin=0.5))
    conditions = {"trials": 3, "noise_rms": 50e-9, "speed_deviation": (0.05, 37.0), "seed": 7}
    loop.to_scenario(tmp_path / "cell.yaml", OVAL, **conditions)
    written = lathe_rc.load(tmp_path / "cell.yaml")
    assert lathe_rc.run(written).digest == loop.simulate(known, OVAL, **conditions).result.digest
    factor, where = loop.supremum()
    assert lathe_rc.run(written).margins["learning_controller"] == pytest.approx(1.0 - factor, abs=0.02)
    assert where > 0.0


@pytest.fixture(scope="module")
def resonant():
    """A drive with a mode of 1180 Hz that is narrower than the distance of the points."""
    p, (pole, zero) = 2j * np.pi * F, 2.0 * np.pi * np.array([1180.0, 1240.0])
    mode = (p * p + 0.024 * zero * p + zero**2) / (p * p + 0.024 * pole * p + pole**2) * (pole / zero) ** 2
    return ilc.frequency_response(F, signal.freqresp(DRIVE, 2.0 * np.pi * F)[1] * DELAY * mode)


def test_the_margin_within_a_deviation_of_the_speed_is_that_of_the_cell(resonant, tmp_path):
    known = resonant.fit()
    learning = ilc.learning_filter(known, "notch", gain=0.5)
    q = ilc.q_filter(known, learning, margin=0.2)
    steady, swinging = (ilc.Loop(known, learning, q, speed_deviation=part) for part in (0.0, 0.05))
    found = steady.simulate(known, OVAL, trials=3, speed_deviation=(0.05, 37.0)).margin.error
    assert swinging.margin().error == pytest.approx(found, abs=0.01)
    assert steady.margin().error > found + 0.02
    assert "950 to 1050 rpm" in str(swinging.margin())
    swinging.to_scenario(tmp_path / "cell.yaml", OVAL, speed_deviation=(0.05, 37.0), trials=3)
    written = lathe_rc.run(lathe_rc.load(tmp_path / "cell.yaml"))
    assert written.drive_margins["learning_controller"].error == pytest.approx(found, abs=0.01)


def test_a_resonance_between_the_points_is_said_with_model_and_margin(resonant):
    known = resonant.fit()
    learning = ilc.learning_filter(known, gain=0.3)
    told = ilc.Loop(known, learning, ilc.q_filter(known, learning, margin=0.2)).margin()
    assert all("Hz wide lies between the points" in text for text in (repr(known), str(told)))


def test_a_gain_that_a_refused_q_names_has_the_margin(resonant):
    with pytest.raises(InputError, match=r"\(more by gain=\S+ or another filter\)") as told:
        ilc.q_filter(resonant, ilc.learning_filter(resonant), margin=0.9)
    gain = float(str(told.value).partition("gain=")[2].partition(" ")[0])
    assert ilc.q_filter(resonant, ilc.learning_filter(resonant, gain=gain), margin=0.9)


def test_the_lag_of_noisy_points_is_that_of_the_drive(known):
    random = np.random.default_rng(4)
    noisy = known.points.value * (1.0 + 0.005 * (random.standard_normal(F.size) + 1j * random.standard_normal(F.size)))
    assert ilc.frequency_response(F, noisy).lag == pytest.approx(known.lag, rel=0.01)


def test_systems_and_files_are_read_like_arrays(tmp_path, measured):
    """Of python-control: a response has omega and frdata, a system is a function of p or z."""
    array = signal.freqresp(DRIVE, 2.0 * np.pi * F)[1]
    sampled = PLANT.to_tf()
    of_z = signal.dfreqresp(PLANT, 2.0 * np.pi * F[:100] * 1e-3)[1]
    frd = SimpleNamespace(omega=2.0 * np.pi * F, frdata=array[None, None])

    class Discrete:
        dt = 1e-3

        def __call__(self, z):
            return np.polyval(sampled.num, z) / np.polyval(sampled.den, z)

    assert ilc.frequency_response(DRIVE, F).points.value == pytest.approx(array)
    assert ilc.frequency_response(frd).points.value == pytest.approx(array)
    assert ilc.frequency_response(PLANT, F[:100]).points.value == pytest.approx(of_z)
    assert ilc.frequency_response(Discrete(), F[:100]).points.value == pytest.approx(of_z)
    table = np.column_stack([F, measured.points.value.real, measured.points.value.imag])
    np.savetxt(tmp_path / "g.csv", table, delimiter=",", header="frequency,real,imaginary", comments="")
    assert ilc.frequency_response(tmp_path / "g.csv").points.value == pytest.approx(measured.points.value)


ONES = np.ones(F.size)
LOOP = "ilc.Loop(G, {}, {})"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("ilc.frequency_response(F, np.ones(3))", r"response of shape \(3,\); allowed: \(240,\)"),
        ("ilc.frequency_response(F, ONES * np.nan)", "response: .*nan.* allowed: finite numbers"),
        ("ilc.frequency_response(F * np.nan, ONES)", "frequencies: .*nan.* allowed: finite numbers"),
        ("ilc.frequency_response(['a'], ONES)", "allowed: an array of numbers"),
        ("ilc.frequency_response(F + 1j, ONES)", "allowed: real numbers"),
        ("ilc.frequency_response(F, ONES, coherence=0.0 * ONES)", "allowed: above 0 to 1"),
        ("ilc.frequency_response(F, ONES, coherence=ONES, averages=0)", "averages = 0; allowed: a number from 1"),
        ("ilc.frequency_response(DRIVE)", "allowed: frequency_response"),
        ("ilc.frequency_response(PLANT, F)", "allowed: up to half of 1/dt"),
        ("G.fit(modes=-1)", "modes = -1; allowed: a whole number from 0 to 8"),
        ("ilc.learning_filter((F, ONES))", r"allowed: Response \(ilc.frequency_response"),
        ("ilc.learning_filter(G, 'inverse')", r"without a model; allowed: response = response.fit\(\)"),
        ("ilc.learning_filter(G, 'P')", "allowed: lead, inverse, zero-phase, notch"),
        ("ilc.learning_filter(ilc.frequency_response(F, 5e-6 * ONES))", "static gain of 5e-06; allowed: 0.01 to 100"),
        ("ilc.learning_filter(G, gain=np.nan)", "gain = nan; allowed: a number above 0 to 2"),
        ("ilc.q_filter(G, {'lead_time': 0.0}, margin=0.9)", r"0.9; allowed: up to \S+, which \S+ Hz limits \(more"),
        (
            "ilc.q_filter(ilc.frequency_response(F[:60], ONES[:60]), {'lead_time': 0.0})",
            r"points up to \S+ Hz; allowed: up to \S+ Hz or more, or response = response.fit\(\)",
        ),
        ("ilc.q_filter(G, {'lead_tme': 1e-3})", "lead_tme: unknown parameter; did you mean lead_time"),
        ("ilc.q_filter(G, {}, rpm='1000')", "rpm = '1000'; allowed: a number above 0"),
        ("ilc.Loop(G, None, {})", "learning = None: NoneType; allowed: dict"),
        (f"{LOOP}.simulate(G, OVAL)", "without a model in a cell; allowed"),
        (f"{LOOP}.to_scenario('x.yaml', OVAL)", "without a model in a cell; allowed"),
        ("ilc.Loop(G, {}, {}, rpm=500.0).asymptotic_error(OVAL)", "allowed: equal speeds"),
        (f"{LOOP}.asymptotic_error({{2: 1e-6}})", "allowed: Part"),
        (f"{LOOP}.expected_errors(OVAL, 2.5)", "revolutions = 2.5; allowed: a whole number"),
        ("ilc.reference({2.5: 1e-6})", "order = 2.5; allowed: a whole number from 1"),
        ("ilc.reference({2: 'x'})", "amplitude of 2 waves = 'x'; allowed: a number"),
        ("ilc.reference([1e-6])", "allowed: {ORDER: AMPLITUDE"),
        ("ilc.Trials(DRIVE, 10)", "without a sampling step; allowed: a discrete one"),
        ("ilc.Trials(np.ones(5), 10)", "of 5 samples; allowed: at least the 10"),
        ("ilc.Trials(np.zeros(9), 9)", "allowed: a plant that moves"),
        ("ilc.Trials(PLANT, 2.5)", "samples = 2.5; allowed: a whole number"),
        ("ilc.Trials([1, 1.5, *np.zeros(80)], 82).norm_optimal()", "the least is not unique"),
        ("ilc.Trials(PLANT, 9).norm_optimal(effort=-1)", "effort = -1; allowed: a number from 0"),
        ("ilc.Trials(PLANT, 9).norm(1.0, np.eye(9))", r"Q of shape \(\); allowed: \(8, 8\)"),
        ("ilc.Trials(PLANT, 9).errors(ONES, np.eye(8), np.eye(8), 3)", r"wanted of shape \(240,\); allowed: \(9,\)"),
    ],
)
def test_bad_input_is_refused_in_one_line(call, message, measured, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message) as told:
        eval(call, {**globals(), "G": measured})  # noqa: S307 - the calls above, which are the names of the cases
    assert "\n" not in str(told.value)
    assert not list(tmp_path.iterdir())


def test_a_loop_that_diverges_is_not_run(known):
    with pytest.raises(InputError, match="sup"):
        ilc.Loop(known, {"lead_time": 0.0}, {"q_time": 0.0}).simulate(known, OVAL, trials=3)


def lifted(impulse):
    return np.array([[impulse[k - j] if k >= j else 0.0 for j in range(len(impulse))] for k in range(len(impulse))])


def test_norm_optimal_trials_converge_monotonously_to_the_least():
    """The command has the least |e|² + effort·|u|², and comes nearer by at least the norm in each trial."""
    trials, wanted = ilc.Trials(PLANT, 60), np.sin(np.linspace(0.0, np.pi, 60)) ** 2
    assert trials.delay == 1
    plant, goal = trials.plant, wanted[1:]
    assert plant == pytest.approx(lifted(PLANT.impulse(n=60)[1][0].ravel()[1:]))
    q, learning = trials.norm_optimal(effort=0.02, change=0.5)
    least = np.linalg.solve(plant.T @ plant + 0.02 * np.eye(59), plant.T @ goal)
    norm = trials.norm(q, learning)
    assert norm < 1.0
    command = np.zeros(59)
    for _ in range(80):
        far = np.linalg.norm(command - least)
        command = q @ (command + learning @ (goal - plant @ command))
        assert np.linalg.norm(command - least) <= norm * far * (1.0 + 1e-9) + 1e-12
    errors = trials.errors(wanted, q, learning, 80)
    assert errors[0] == pytest.approx(np.sqrt(np.mean(goal**2)))
    assert errors[-1] == pytest.approx(np.sqrt(np.mean((goal - plant @ least) ** 2)), rel=1e-3)
    assert trials.errors(wanted, q, learning, 80, noise_rms=0.1)[-1] > 1.5 * errors[-1]
    assert trials.norm(*trials.norm_optimal()) < 1e-9  # the inverse: one trial


def test_a_plant_that_is_not_minimum_phase_is_learned():
    """With a zero at 1.5 the inverse diverges; weights leave the part of the form that the plant cannot reach."""
    impulse = np.concatenate(([0.0], signal.dlti([0.5, -0.75], [1.0, -0.5], dt=1e-3).impulse(n=80)[1][0].ravel()))
    trials = ilc.Trials(impulse, 81)
    plant, wanted = trials.plant, np.sin(np.linspace(0.0, np.pi, 81)) ** 2
    assert np.abs(np.linalg.solve(plant, wanted[1:])).max() > 1e6
    q, learning = trials.norm_optimal(effort=1e-4, change=1e-2)
    errors = trials.errors(wanted, q, learning, 400)
    least = np.linalg.solve(plant.T @ plant + 1e-4 * np.eye(80), plant.T @ wanted[1:])
    assert np.abs(least).max() < 10.0
    assert np.all(np.diff(errors) < 1e-12)
    assert errors[-1] == pytest.approx(np.sqrt(np.mean((wanted[1:] - plant @ least) ** 2)), rel=0.01)


def test_basis_functions_keep_the_command_in_their_span():
    trials = ilc.Trials(PLANT, 51)
    wanted, basis = np.linspace(0.0, 1.0, 51) ** 2, np.vander(np.linspace(0.0, 1.0, 50), 3)
    q, learning = trials.norm_optimal(basis=basis)
    seen = trials.plant @ basis
    least = wanted[1:] - seen @ np.linalg.lstsq(seen, wanted[1:], rcond=None)[0]
    assert trials.errors(wanted, q, learning, 2)[-1] == pytest.approx(np.sqrt(np.mean(least**2)), rel=1e-6)
