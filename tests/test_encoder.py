# SPDX-License-Identifier: Apache-2.0
"""Encoder: what is measured against what is true."""

import numpy as np
from cells import cuts, in_blocks, same
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_rc.cell import messages
from lathe_rc.signals import speed
from lathe_rc.signals.encoder import Encoder

TURN = 2 * np.pi
STEP = 1 / 64000
NOMINAL = 1000 * TURN / 60
swinging = speed.harmonic(NOMINAL, np.array([0.1]), np.array([10.7]), np.array([0.5]))
laws = st.sampled_from([speed.constant(NOMINAL), swinging])
counts = st.one_of(st.integers(1, 100), st.integers(101, 2**31 - 1))


def measure(law, counts=0, window=64, lengths=(12000,)):
    """Signals of an encoder that works in blocks of ``lengths``."""
    signals = messages.allocate(messages.ENCODER, sum(lengths))
    encoder = Encoder(law, STEP, counts, window)
    in_blocks(lengths, lambda first, *parts: encoder.block(first, **dict(zip(signals, parts, strict=True))),
              *signals.values())  # fmt: skip
    return signals


@given(laws)
def test_truth_is_the_law(law):
    signals = measure(law)
    angle, rate, _ = law.at(np.arange(12000) * STEP)
    assert np.array_equal(signals["angle_true"], angle)
    assert np.array_equal(signals["speed_true"], rate)


@given(laws)
def test_ideal_encoder_measures_the_truth(law):
    signals = measure(law)
    assert np.array_equal(signals["angle"], signals["angle_true"])
    assert np.array_equal(signals["speed"], signals["speed_true"])


@given(laws, counts)
def test_counts_lag_by_less_than_one(law, counts):
    signals = measure(law, counts)
    lag = signals["angle_true"] - signals["angle"]
    rounding = 1e-13
    assert lag.min() >= -rounding
    assert lag.max() < TURN / counts + rounding
    assert_allclose(signals["angle"] * counts / TURN, np.rint(signals["angle"] * counts / TURN), rtol=1e-14)


@given(laws)
def test_ideal_index_pulse_comes_once_in_a_revolution_from_sample_0(law):
    signals = measure(law)
    revolution = np.floor(signals["angle_true"] / TURN)
    assert np.array_equal(signals["index_pulse"], np.diff(revolution, prepend=-1.0))
    assert signals["index_pulse"].sum() == 4


@given(laws, counts)
def test_measured_index_pulse_comes_with_the_count_that_ends_a_revolution(law, counts):
    signals = measure(law, counts)
    revolution = np.rint(signals["angle"] * counts / TURN) // counts
    assert np.array_equal(signals["index_pulse"], np.diff(revolution, prepend=-1.0))
    assert signals["index_pulse"].sum() == 4


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
