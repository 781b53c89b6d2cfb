# SPDX-License-Identifier: Apache-2.0
"""Vibration of the tool against the part: spectrum, size, repeatability; the stage."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused, refusals, run
from numpy.testing import assert_allclose

from lathe_machine.signals.vibration import band_limited_random, evaluate, harmonic
from lathe_machine.stages.cut.vibration import Vibration, VibrationParameters
from lathe_rc import messages

STEP = 1 / 64000


def move(lines, samples, first=0):
    position, velocity = np.empty((2, samples))
    evaluate(first, STEP, lines, position, velocity)
    return position, velocity


def draw(rms=1e-6, low=200.0, high=2000.0, lines=32, seed=1):
    return band_limited_random(rms, low, high, lines, np.random.default_rng(seed))


# --- signal


def test_lines_are_the_formula_with_its_derivative():
    lines = harmonic(np.array([1e-6, 2e-6]), np.array([300.0, 1700.0]), np.array([0.0, 0.5]))
    position, velocity = move(lines, 1000, first=5000)
    time = (5000 + np.arange(1000)) * STEP
    expected = 1e-6 * np.sin(300 * time) + 2e-6 * np.sin(1700 * time + 0.5)
    assert_allclose(position, expected, atol=1e-18)
    assert_allclose(velocity, 300e-6 * np.cos(300 * time) + 3400e-6 * np.cos(1700 * time + 0.5), atol=1e-15)


@given(st.floats(1e-9, 1e-3), st.floats(1.0, 1000.0), st.floats(10.0, 5000.0), st.integers(1, 200), st.integers(0, 99))
def test_random_lines_have_their_rms_and_stay_in_the_band(rms, low, width, lines, seed):
    drawn = draw(rms, low, low + width, lines, seed)
    assert drawn.shape == (3, lines)
    assert np.sqrt((drawn[0] ** 2).sum() / 2) == pytest.approx(rms)
    edges = low + width * np.arange(lines + 1) / lines
    assert np.all((edges[:-1] <= drawn[1] + 1e-9) & (drawn[1] <= edges[1:] + 1e-9))


def test_random_vibration_looks_random():
    """Random vibration has its RMS, mean and kurtosis, and no frequencies outside of the band."""
    position, _ = move(draw(), 1_000_000)
    assert position.std() == pytest.approx(1e-6, rel=0.01)
    assert abs(position.mean()) < 1e-8
    assert np.mean((position / position.std()) ** 4) == pytest.approx(3.0, abs=0.2)
    window = np.hanning(position.size)
    spectrum = np.abs(np.fft.rfft(position * window)) ** 2
    frequency = 2 * np.pi * np.fft.rfftfreq(position.size, STEP)
    within = (frequency > 199.0) & (frequency < 2001.0)
    assert spectrum[~within].sum() < 1e-6 * spectrum.sum()


# --- stage


def stage(name="vibration", **values):
    return Vibration(name, VibrationParameters.read(name, values))


def advance(made, samples, lengths=None):
    fields = tuple(messages.allocate(messages.STATE, 1))

    def block(first, *parts):
        made.advance(first, [{"angle": parts[0]}], [dict(zip(fields, parts[1:], strict=True))])

    return dict(zip(fields, run(block, len(fields), np.zeros(samples), lengths=lengths), strict=True))


def test_stage_publishes_the_vibration():
    made = stage(line_amplitude=[2e-6], line_frequency=[700.0], line_phase=[0.1])
    assert [(port.topic, port.fields) for port in made.inputs] == [("encoder", ("angle",))]
    assert [(port.topic, port.type) for port in made.outputs] == [("vibration/state", messages.STATE)]
    state = advance(made, 2000)
    position, velocity = move(made.lines, 2000)
    assert np.array_equal(state["position"], position)
    assert np.array_equal(state["velocity"], velocity)
    assert not state["effort"].any()
    assert np.array_equal(state["measured_position"], position)
    assert made.lines[:, 0].tolist() == [2e-6, 700.0, 0.1]
    still = advance(stage(random_rms=0.0, random_low=5.0, random_high=1.0), 10)
    assert not still["position"].any()
    assert not still["velocity"].any()


def test_seed_and_name_make_the_vibration():
    def lines(**values):
        return stage(**values).lines

    assert np.array_equal(lines(), lines())
    assert not np.array_equal(lines(), lines(seed=1))
    assert not np.array_equal(lines(), lines(name="other"))


@refusals(
    (lambda: draw(low=300.0, high=300.0), "band 300-300 rad/s; allowed: 0 < low < high"),
    (lambda: draw(low=0.0), "band 0-2000 rad/s"),
    (lambda: stage(line_amplitude=[1e-6]), "1 amplitudes, 0 frequencies and 1 phases"),
    (lambda: stage(random_low=500.0, random_high=400.0), "band 500-400 rad/s"),
    (lambda: stage(random_high=1e6), "^vibration.random_high: vibration at .* rad/s; allowed: below 201061 rad/s"),
    (lambda: stage(line_amplitude=[1e-6], line_frequency=[3e5]), "vibration at 300000 rad/s; allowed: below 201061"),
)
def test_what_cannot_work_is_refused(make, message):
    assert_refused(make, message)
