# SPDX-License-Identifier: Apache-2.0
"""The learning cell against the formulas of papers 000 and 001."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cells import command, config, encoder, form_error, run, same, scenario
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_machine.analysis.learning import LearningLoop
from lathe_rc import messages
from lathe_rc.analysis import cycle_factors
from lathe_rc.analysis.cycle_factors import supremum
from lathe_rc.analysis.resonance_grid import Grid
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

NOMINAL = 1000 * np.pi / 30
TABLE = np.array([500.0, 1000.0, 1500.0, 2000.0])  # [rad/s], of paper 001
WN, ZETA, TAU, LEAD, Q_TIME = 1038.0, 0.804, 0.36e-3, 1.425e-3, 67e-6
SWING = {"deviation_amplitude": [0.1], "deviation_frequency": [10.7]}
STATUS = "/coarse/learning"


def smooth(frequency):
    """Q of spec/learning.md."""
    return 1 / (1 + (frequency * Q_TIME) ** 2)


def corrected(frequency):
    """Z = Wi/W0 of spec/learning.md."""
    p = 1j * frequency
    return np.exp(p * (LEAD - TAU)) / (1 + 2 * ZETA * p / WN + (p / WN) ** 2)


def learning_loop(shared=None, **controller):
    """The loop as the cell computes it before its start."""
    stages = Cell(scenario(shared, learning_controller=controller).nodes).stages
    return stages["learning_controller"].loop(stages["electrodynamic_actuator"].drive.plant.response)


# --- formulas


def test_contraction_of_the_paper():
    assert_allclose(np.abs(smooth(TABLE) - corrected(TABLE)), [0.259, 0.506, 0.652, 0.744], atol=5e-4)
    assert_allclose(learning_loop().operator(TABLE / NOMINAL, NOMINAL), smooth(TABLE) - corrected(TABLE), atol=1e-3)


def test_steady_error_of_the_paper():
    error = np.abs(learning_loop().steady_error(TABLE / NOMINAL, NOMINAL))
    assert_allclose(error, [1.2e-3, 6.6e-3, 2.6e-2, 6.6e-2], rtol=0.1)
    q, z = smooth(TABLE), corrected(TABLE)
    assert_allclose(error, np.abs((1 - q) / (z + 1 - q)), rtol=2e-3)


@pytest.mark.parametrize("place", [0.0, 3.3, 256.25, 511.9, 512.0])
def test_supremum_finds_a_peak_wherever_it_is(place):
    """Beside two that are nearly as high, and between the points that are looked at first."""

    def operator(waves):
        peaks = [height / (1 + ((waves - at) / 2) ** 2) for height, at in ((0.99, 100), (1.0, place), (0.98, 400))]
        return sum(peaks) + 0j

    waves = np.linspace(0.0, 512.0, 100_001)
    largest, at = supremum(operator, 512.0)
    assert largest == pytest.approx(operator(waves).real.max(), rel=1e-4)
    assert at == pytest.approx(place, abs=0.05)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_supremum_tells_where_a_factor_is_no_number(number):
    largest, at = supremum(lambda waves: np.where((waves >= 300.0) & (waves < 301.0), number, 1.0), 512.0)
    assert (np.isnan(largest), at) == (True, 300.0)


def test_supremum_is_computed_once_for_loops_that_are_alike(monkeypatch):
    """Two cells have two loops; a drive that is no constant may change meanwhile."""
    asked = []
    operator = LearningLoop.operator
    monkeypatch.setattr(LearningLoop, "operator", lambda *loop: asked.append(loop) or operator(*loop))
    speed, lead = 0.987 * NOMINAL, {"lead_time": 1.4321e-3}
    first = learning_loop(**lead)
    found = first.worst(speed)
    looks = len(asked)
    assert learning_loop(**lead).worst(speed) == found
    assert len(asked) == looks
    assert learning_loop(lead_time=1.4322e-3).worst(speed) != found
    size = [1.0]
    other = replace(first, drive=lambda frequency: size[0] * first.drive(frequency))
    assert other.worst(speed) == found
    size[0] = 0.5
    assert other.worst(speed) != found


# --- the simulated cell


@pytest.mark.parametrize(
    "name", ["piston", "lead_lag", "adaptive_inverse", "exact_invariance", "series", "robust", "robust_cutting"]
)
def test_an_error_of_the_drive_margin_is_the_smallest_with_which_learning_diverges(name):
    """Brute force at the frequency where it is lost: errors of all phases, at the margin and 3 % below it."""
    cell = Cell(config(name).nodes)
    cell.check()
    phases = np.exp(2j * np.pi * np.arange(720) / 720)
    assert cell.drive_margins.keys() == cell.factors.keys()
    for node, margin in cell.drive_margins.items():
        (loop,) = cell.loops[node]
        at = np.array([margin.waves])

        def largest(error, loop=loop, at=at, speed=margin.speed):
            each = (
                np.abs(loop.stage.factors(lambda f, d=drive, p=phase: (1.0 + error * p) * d(f), at, speed)).max()
                for drive in loop.responses
                for phase in phases
            )
            return max(each)

        assert largest(margin.error) == pytest.approx(1.0, abs=1e-4)
        assert largest(0.97 * margin.error) < 1.0
        # Nowhere else a smaller error suffices.
        waves = np.linspace(0.0, loop.stage.highest_waves(margin.speed), 4001)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cycle_factors, "_waves_up_to", lambda _, waves=waves: Grid.even(waves))
            assert loop.drive_margin().error == pytest.approx(margin.error, rel=1e-3)


@pytest.mark.parametrize(("part", "diverges"), [(0.97, False), (1.03, True)])
def test_a_drive_in_error_by_the_margin_diverges_in_a_run(part, diverges):
    """Gain and lead scale the response by 1 + Δ at the frequency of the form's harmonic."""
    waves, loop = np.array([7.0]), learning_loop()
    operator, given = loop.operator(waves, NOMINAL)[0], loop.corrected_drive(waves, NOMINAL)[0]
    error = part * (1.0 - abs(operator)) / abs(given)
    scale = 1.0 - error * operator / abs(operator) / (given / abs(given))
    changed = {"learning_gain": abs(scale), "lead_time": LEAD + np.angle(scale) / (waves[0] * NOMINAL)}
    found = run(
        spindle_encoder={"revolutions": 16.0},
        learning_controller={**changed, "allow_unstable": True},
        tool={"profile": "harmonics", "harmonic_order": [7], "harmonic_amplitude": [1e-6]},
    )
    harmonic = abs(np.fft.rfft(form_error(found)[: 16 * 3840].reshape(16, -1))[:, 7])
    contraction = harmonic[-1] / harmonic[-2]
    assert (contraction > 1.0) == diverges


def test_equal_weights_of_four_cycles_halve_the_random_part_of_the_error():
    found = {}
    for cycles in (1, 4):
        law = {"cycle_weights": [1.0] * cycles}
        sensor = {"noise_rms": 2e-6}
        result = run(
            spindle_encoder={"revolutions": 40.0},
            learning_controller=law,
            electrodynamic_actuator=sensor,
            tool={"profile": "harmonics", "harmonic_order": [2], "harmonic_amplitude": [100e-6]},
        )
        error = form_error(result)[: 40 * 3840].reshape(40, -1)[-20:]
        found[cycles] = np.std(error - error.mean(axis=0))
    assert found[4] == pytest.approx(0.5 * found[1], rel=0.15)


def test_last_revolution_agrees_with_the_formula():
    """Harmonic by harmonic; at 1000 rpm a revolution is 3840 samples."""
    order = np.array([1, 2, 4, 8, 12, 16, 19])
    amplitude, phase = 200e-6 / order**2, 0.3 * order
    form = {"harmonic_order": order, "harmonic_amplitude": amplitude, "harmonic_phase": phase}
    form = {name: values.tolist() for name, values in form.items()}
    result = run(spindle_encoder={"revolutions": 60.0}, tool=form)
    spectrum = np.fft.rfft(form_error(result)[-3840:])[order] * 2 / 3840
    q, z = smooth(order * NOMINAL), corrected(order * NOMINAL)
    desired = -1j * amplitude * np.exp(1j * phase)
    assert_allclose(spectrum, (1 - q) / (z + 1 - q) * desired, rtol=2e-3)
    expected_rms = np.sqrt((np.abs((1 - q) / (z + 1 - q) * desired) ** 2).sum() / 2)
    assert result.errors.rms[-1] == pytest.approx(expected_rms, rel=0.02)


@pytest.mark.parametrize("order", [5, 10, 15, 20])
def test_error_contracts_by_the_formula_in_each_cycle(order):
    """At 100 rad/s these orders are the frequencies of the table.

    A cycle of three revolutions, watched in the middle one, where the start of learning is not felt.
    """
    result = run(
        {"nominal_rpm": 3000 / np.pi},
        spindle_encoder={"revolutions": 12.0},
        learning_controller={"cycle_revolutions": 3},
        tool={"harmonic_order": [order], "harmonic_amplitude": [20e-6]},
    )
    turn, error = encoder(result)["angle_true"] / (2 * np.pi), form_error(result)
    found = []
    for revolution in (1, 4, 7, 10):
        middle = (turn >= revolution) & (turn < revolution + 1)
        wave = np.exp(2j * np.pi * order * turn[middle])
        fit = np.linalg.lstsq(np.stack((wave, wave.conj()), axis=1), error[middle].astype(complex))
        found.append(fit[0][0])
    gained = np.diff(found)
    assert_allclose(gained[1:] / gained[:-1], smooth(order * 100.0) - corrected(order * 100.0), rtol=1e-3)


def test_status_tells_each_cycle():
    result = run(spindle_encoder={"revolutions": 6.0})
    status = result.recording.sparse[STATUS].values
    assert status["cycle"] == [1, 2, 3, 4, 5]
    # With ideal sensors the measured error is the form error; the grid sees less of its step between two cycles.
    assert_allclose(status["rms_error"], result.errors.rms[:5], rtol=0.02)
    assert_allclose(status["max_error"], result.errors.largest[:5], rtol=0.1)
    assert_allclose(status["contraction"][1:], np.divide(status["rms_error"][1:], status["rms_error"][:-1]))
    assert np.isnan(status["contraction"][0])
    assert status["learning"] == [True] * 5
    assert_allclose(status["stability_margin"], 1 - learning_loop().supremum(NOMINAL), atol=1e-3)


# --- feedback delay


def largest_delay(shared=None, *, spindle=None, controller=None):
    """The delay that the refusal of an impossible one allows."""
    asked = {**(controller or {}), "feedback_delay": 100_000}
    with pytest.raises(InputError, match=r"feedback_delay = 100000 samples: at .* rad/s the cycle leaves") as refusal:
        run(shared, spindle_encoder=spindle or {}, learning_controller=asked)
    return int(re.search(r"the cycle leaves (\d+); allowed: 64 up to \1$", str(refusal.value))[1])


@cache
def signals_with(delay, lead_law):
    spindle = {"revolutions": 3.0, **SWING}
    controller = {"feedback_delay": delay, "lead_law": lead_law}
    return run(spindle_encoder=spindle, learning_controller=controller).recording.dense


@settings(max_examples=10)
@given(st.integers(64, 3386), st.sampled_from(["variable", "constant_angle"]))
def test_result_does_not_depend_on_the_delay(delay, lead_law):
    here, there = signals_with(delay, lead_law), signals_with(2048, lead_law)
    assert all(same(here[topic], there[topic]) for topic in here)


@pytest.mark.parametrize("lead_law", ["variable", "constant_angle"])
def test_delay_beyond_what_the_cycle_leaves_is_refused_with_the_figures(lead_law):
    spindle, controller = {"revolutions": 3.0, **SWING}, {"lead_law": lead_law}
    largest = largest_delay(spindle=spindle, controller=controller)
    run(spindle_encoder=spindle, learning_controller={**controller, "feedback_delay": largest})
    with pytest.raises(InputError, match=rf"= {largest + 1} samples: at 115\.2 rad/s the cycle leaves {largest};"):
        run(spindle_encoder=spindle, learning_controller={**controller, "feedback_delay": largest + 1})
    leaves = r"at 104\.7 rad/s the cycle leaves 0; allowed: a longer cycle, a shorter lead, or a spindle that"
    with pytest.raises(InputError, match=leaves):
        run(learning_controller={"lead_time": 0.9})


@pytest.mark.parametrize("rpm", [300.0, 1000.0, 1900.0])
@pytest.mark.parametrize("counts", [0, 360, 4096])
def test_largest_delay_runs(rpm, counts):
    """Whatever the encoder: the angle of a coarse one is late by up to a count."""
    shared = {"nominal_rpm": rpm}
    spindle = {"revolutions": 3.0, "counts_per_revolution": counts}
    small = {"harmonic_amplitude": [1e-6], "harmonic_order": [1]}
    delay = largest_delay(shared, spindle=spindle)
    result = run(shared, spindle_encoder=spindle, learning_controller={"feedback_delay": delay}, tool=small)
    assert np.isfinite(command(result)).all()


# --- stability


@pytest.mark.parametrize(("q_time", "lead_time"), [(67e-6, 2e-3), (99e-6, 2e-3), (0.0, 1.425e-3)])
def test_setting_that_diverges_is_refused_with_the_figures(q_time, lead_time):
    controller = {"q_time": q_time, "lead_time": lead_time}
    supremum = learning_loop(**controller).supremum(NOMINAL)
    assert supremum > 1
    settings = f"lead_time = {lead_time * 1e3:.4g} ms, q_time = {q_time * 1e6:.4g} µs"
    with pytest.raises(InputError, match=rf"(?s)(?=.*sup\|Q - Z\| = {supremum:.4g} at ).*{settings}"):
        run(learning_controller=controller)


def test_refused_setting_diverges_when_forced():
    """Fine at first; only the supremum, or a long run, shows it."""
    controller = {"q_time": 67e-6, "lead_time": 2e-3}
    result = run(spindle_encoder={"revolutions": 150.0}, learning_controller={**controller, "allow_unstable": True})
    rms = result.errors.rms
    assert rms[20:40].max() < 1e-6
    growth = (rms[149] / rms[99]) ** (1 / 50)
    assert 1.03 < growth < learning_loop(**controller).supremum(NOMINAL)


def test_setting_at_the_spec_s_limit_converges():
    """A lead of 2 ms with a Q of 104 µs."""
    controller = {"q_time": 104e-6, "lead_time": 2e-3}
    assert learning_loop(**controller).supremum(NOMINAL) < 1
    rms = run(spindle_encoder={"revolutions": 200.0}, learning_controller=controller).errors.rms
    assert np.all(np.diff(rms[20::20]) < 0.0)


def test_stability_counts_at_the_highest_speed():
    """Learning that converges at 1000 rpm may diverge at the top of a swing."""
    controller = {"q_time": 104e-6, "lead_time": 2e-3}
    run(learning_controller=controller)
    with pytest.raises(InputError, match=r"learning diverges with .*: sup\|Q - Z\| = 1\.\d+ at .* at 115\.2 rad/s\)"):
        run(spindle_encoder={"revolutions": 20.0, **SWING}, learning_controller=controller)


def test_drive_model_is_what_the_status_judges_by():
    """The check before the start takes the drive itself, the status the controller's model of it."""
    result = run(learning_controller={"model_delay": 2e-3})
    assert result.recording.sparse[STATUS].values["stability_margin"][-1] < 0.0
    assert result.recording.types[STATUS] == messages.LEARNING
