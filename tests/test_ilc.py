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
PLANT = signal.dlti([0.2, 0.1], [1.0, -0.7], dt=1e-3)


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
    assert "beyond them unknown" in str(found)
    assert q["q_stop"] <= 2.0 * np.pi * 2000.0


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
    loop.to_scenario(tmp_path / "cell.yaml", OVAL)
    written = lathe_rc.load(tmp_path / "cell.yaml", ["spindle_encoder.revolutions=3"])
    assert lathe_rc.run(written).digest == loop.simulate(known, OVAL, trials=3).result.digest


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


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda _: ilc.frequency_response(F, np.ones(3)), "allowed: equal ones"),
        (lambda _: ilc.frequency_response(F, np.full(F.size, np.nan)), "allowed: finite numbers"),
        (lambda _: ilc.frequency_response(DRIVE), "allowed: frequency_response"),
        (lambda g: ilc.learning_filter(g, "inverse"), "without a model; allowed: of response.fit"),
        (lambda g: ilc.learning_filter(g, "P"), "allowed: lead, inverse, zero-phase, notch"),
        (lambda g: ilc.q_filter(g, {"lead_time": 0.0}, margin=0.9), "with a drive margin of 0.9; allowed: up to"),
        (lambda g: ilc.Loop(g, {}, {}).simulate(g, OVAL), "without a model; allowed"),
        (lambda g: ilc.Loop(g, {}, {}, rpm=500.0).asymptotic_error(OVAL), "allowed: equal speeds"),
        (lambda g: ilc.Loop(g, {"q_pas": 1.0}, {}).margin(), "q_pas"),
        (lambda _: ilc.Trials(DRIVE.to_ss(), 10), "a continuous system"),
        (lambda _: ilc.Trials(np.ones(5), 10), "of 5 samples; allowed: at least the 10"),
        (lambda _: ilc.Trials(np.r_[0.0, np.ones(9)], 10).norm_optimal(), "the least is not unique"),
    ],
)
def test_bad_input_is_refused_in_one_line(make, message, measured):
    with pytest.raises(InputError, match=message) as told:
        make(measured)
    assert "\n" not in str(told.value)


def test_a_loop_that_diverges_is_not_run(known):
    with pytest.raises(InputError, match="sup"):
        ilc.Loop(known, {"lead_time": 0.0}, {"q_time": 0.0}).simulate(known, OVAL, trials=3)


def test_norm_optimal_trials_converge_monotonously_to_the_least():
    """The command has the least |e|² + effort·|u|², and comes nearer by at least the norm in each trial."""
    trials, wanted = ilc.Trials(PLANT, 60), np.sin(np.linspace(0.0, np.pi, 60)) ** 2
    plant = trials.plant
    assert plant[:, 0] == pytest.approx(PLANT.impulse(n=60)[1][0].ravel())
    q, learning = trials.norm_optimal(effort=0.02, change=0.5)
    least = np.linalg.solve(plant.T @ plant + 0.02 * np.eye(60), plant.T @ wanted)
    norm = trials.norm(q, learning)
    assert norm < 1.0
    command = np.zeros(60)
    for _ in range(80):
        far = np.linalg.norm(command - least)
        command = q @ (command + learning @ (wanted - plant @ command))
        assert np.linalg.norm(command - least) <= norm * far * (1.0 + 1e-9) + 1e-12
    errors = trials.errors(wanted, q, learning, 80)
    assert errors[0] == pytest.approx(np.sqrt(np.mean(wanted**2)))
    assert errors[-1] == pytest.approx(np.sqrt(np.mean((wanted - plant @ least) ** 2)), rel=1e-3)
    assert trials.errors(wanted, q, learning, 80, noise_rms=1e-3)[-1] > errors[-1]


def test_a_plant_that_is_not_minimum_phase_is_learned():
    """With a zero at 1.5 the inverse diverges; weights leave the part of the form that the plant cannot reach."""
    trials = ilc.Trials(signal.dlti([0.5, -0.75], [1.0, -0.5], dt=1e-3), 80)
    plant, wanted = trials.plant, np.sin(np.linspace(0.0, np.pi, 80)) ** 2
    assert np.abs(np.linalg.solve(plant, wanted)).max() > 1e6
    q, learning = trials.norm_optimal(effort=1e-4, change=1e-2)
    errors = trials.errors(wanted, q, learning, 400)
    least = np.linalg.solve(plant.T @ plant + 1e-4 * np.eye(80), plant.T @ wanted)
    assert np.abs(least).max() < 10.0
    assert np.all(np.diff(errors) < 1e-12)
    assert errors[-1] == pytest.approx(np.sqrt(np.mean((wanted - plant @ least) ** 2)), rel=0.01)


def test_basis_functions_keep_the_command_in_their_span():
    trials = ilc.Trials(PLANT, 50)
    wanted, basis = np.linspace(0.0, 1.0, 50) ** 2, np.vander(np.linspace(0.0, 1.0, 50), 3)
    q, learning = trials.norm_optimal(basis=basis)
    seen = trials.plant @ basis
    least = wanted - seen @ np.linalg.lstsq(seen, wanted, rcond=None)[0]
    assert trials.errors(wanted, q, learning, 2)[-1] == pytest.approx(np.sqrt(np.mean(least**2)), rel=1e-6)
