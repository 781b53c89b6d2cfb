# SPDX-License-Identifier: Apache-2.0
"""Encoder: what is measured against what is true."""

from pathlib import Path

import numpy as np
import pytest
from cells import cuts, in_blocks, same
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused, refusals
from numpy.testing import assert_allclose

from lathe_rc import harness, messages
from lathe_rc.analysis.metrology import undulations
from lathe_rc.cell import scenario
from lathe_rc.signals import speed
from lathe_rc.signals.encoder import Encoder
from lathe_rc.signals.encoder_errors import EncoderErrors

TURN = 2 * np.pi
STEP = 1 / 64000
NOMINAL = 1000 * TURN / 60
swinging = speed.harmonic(NOMINAL, np.array([0.1]), np.array([10.7]), np.array([0.5]))
laws = st.sampled_from([speed.constant(NOMINAL), swinging])
counts = st.one_of(st.integers(1, 100), st.integers(101, 2**31 - 1))


def measure(law, counts=0, window=64, lengths=(12000,), errors=EncoderErrors()):  # noqa: B008 - it never changes
    """Signals of an encoder that works in blocks of ``lengths``."""
    signals = messages.allocate(messages.ENCODER, sum(lengths))
    encoder = Encoder(law, STEP, counts, window, errors)
    in_blocks(lengths, encoder.block, *signals.values())
    return signals


@given(laws)
def test_ideal_encoder_measures_the_truth_which_is_the_law(law):
    signals = measure(law)
    angle, rate, _ = law.at(np.arange(12000) * STEP)
    for name, expected in (("angle", angle), ("speed", rate)):
        assert np.array_equal(signals[f"{name}_true"], expected)
        assert np.array_equal(signals[name], expected)


@given(laws, st.one_of(st.just(0), counts))
def test_index_pulse_comes_from_sample_0_with_the_count_that_ends_a_revolution(law, counts):
    signals = measure(law, counts)
    revolution = np.rint(signals["angle"] * counts / TURN) // counts if counts else signals["angle_true"] // TURN
    assert np.array_equal(signals["index_pulse"], np.diff(revolution, prepend=-1.0))
    assert signals["index_pulse"].sum() == 4


@given(laws, counts)
def test_counts_lag_by_less_than_one(law, counts):
    signals = measure(law, counts)
    lag = signals["angle_true"] - signals["angle"]
    rounding = 1e-13
    assert lag.min() >= -rounding
    assert lag.max() < TURN / counts + rounding
    assert_allclose(signals["angle"] * counts / TURN, np.rint(signals["angle"] * counts / TURN), rtol=1e-14)


@given(st.integers(500, 100_000), st.integers(1, 500))
def test_mean_of_the_measured_speed_is_true(counts, window):
    measured = measure(speed.constant(NOMINAL), counts, window)["speed"]
    assert abs(measured.mean() - NOMINAL) <= TURN / counts / (measured.size * STEP)


def test_measured_speed_lags_by_half_its_window():
    ramp = speed.tachogram(NOMINAL, np.array([0.0, 10.0]), np.array([0.0, 1.0]))
    signals, window = measure(ramp, counts=2**30, window=100), 100
    middle = (np.arange(window, 12000) - window / 2) * STEP
    assert_allclose(signals["speed"][window:], ramp.at(middle)[1], rtol=1e-6)


@given(laws, st.one_of(st.just(0), counts), st.integers(1, 400), cuts)
def test_cuts_change_nothing(law, counts, window, lengths):
    assert same(measure(law, counts, window, lengths), measure(law, counts, window, [sum(lengths)]))


# --- errors of the disc and the signals

EVEN = speed.constant(TURN / (3840 * STEP))  # 3840 samples a revolution
PERIODS = 32


def misread(errors, counts=0, lengths=(3840,), law=EVEN):
    """Signals of an encoder with errors, by default of a revolution."""
    return measure(law, counts, lengths=lengths, errors=errors)


def waves(signals):
    """Amplitude of what is seen less what is true, by waves a revolution."""
    error = signals["angle"] - signals["angle_true"]
    return 2 * np.abs(np.fft.rfft(error)) / error.size


def test_eccentric_disc_errs_once_a_revolution_by_its_eccentricity():
    errors = EncoderErrors(eccentricity=2e-4, phase=0.6)
    signals = misread(errors)
    true = signals["angle_true"]
    assert_allclose(signals["angle"] - true, 2e-4 * (np.sin(true + 0.6) - np.sin(0.6)), atol=1e-14)
    assert signals["index_pulse"].sum() == signals["index_pulse"][0] == 1


@pytest.mark.parametrize(
    ("values", "wave", "amplitude"),
    [
        ({"cosine_offset": 3e-3, "sine_offset": -4e-3}, PERIODS, 5e-3 / PERIODS),
        ({"mismatch": 6e-3, "skew": 8e-3}, 2 * PERIODS, 1e-2 / (2 * PERIODS)),
    ],
)
def test_signals_that_are_no_circle_err_within_a_period(values, wave, amplitude):
    """Heydemann's ellipse: offsets err once in a signal period, amplitudes and phase twice."""
    found = waves(misread(EncoderErrors(periods=PERIODS, **values)))
    assert found[wave] == pytest.approx(amplitude, rel=0.01)
    found[[0, wave]] = 0.0
    assert found.max() < 0.02 * amplitude


ALL_WRONG = EncoderErrors(
    eccentricity=1e-3, phase=-1.0, periods=PERIODS, cosine_offset=0.05, sine_offset=0.02, mismatch=-0.1, skew=0.1
)


def test_speed_is_the_rate_of_the_angle_that_is_seen():
    signals = misread(ALL_WRONG, law=swinging)
    rate = np.gradient(signals["angle"], STEP)
    assert_allclose(signals["speed"][1:-1], rate[1:-1], rtol=1e-3)
    assert np.ptp(signals["speed"] / signals["speed_true"]) > 0.2


@given(counts, cuts)
def test_counts_round_what_is_seen_and_cuts_change_nothing(count, lengths):
    exact, rounded = misread(ALL_WRONG, 0, lengths), misread(ALL_WRONG, count, lengths)
    lag = exact["angle"] - rounded["angle"]
    assert -1e-13 <= lag.min() <= lag.max() < TURN / count + 1e-13
    assert same(rounded, misread(ALL_WRONG, count, [sum(lengths)]))


@refusals(
    (EncoderErrors(eccentricity=0.6).check, "encoder: eccentricity 0.6 rad; allowed: up to 0.5 rad"),
    (EncoderErrors(periods=0).check, "encoder: 0 signal periods in a revolution; allowed: 1 or more"),
    (EncoderErrors(mismatch=-0.3, skew=0.3).check, "encoder: errors of the signals that come to 0.6; allowed: "),
)
def test_errors_that_would_turn_the_angle_back_are_refused(make, message):
    assert_refused(make, message)


def test_learning_leaves_what_the_encoder_misreads():
    """Of an oval A·sin 2φ an eccentric disc leaves A·e at 1 and at 3 undulations: no controller can see it."""
    plain = ["spindle_encoder.revolutions=12.0", "spindle_encoder.deviation_amplitude=[]",
             "spindle_encoder.deviation_frequency=[]", "tool.profile=harmonics"]  # fmt: skip
    profiles = []
    for eccentricity in (0.0, 2e-3):
        config = Path(__file__).parents[1] / "config" / "piston.yaml"
        loaded = scenario.load(config, [*plain, f"spindle_encoder.disc_eccentricity={eccentricity}"])
        profiles.append(harness.run(loaded).part.profile[-1])
    found = undulations((profiles[1] - profiles[0])[None, :], 6).amplitude[0]
    assert_allclose(found[[1, 3]], 225e-6 * 2e-3, rtol=0.02)
    assert max(found[2], *found[4:]) < 0.02 * found[1]
