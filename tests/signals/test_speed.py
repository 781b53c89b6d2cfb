# SPDX-License-Identifier: Apache-2.0
"""Spindle speed laws: angle, speed and acceleration belong together, and bounds hold."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused, refusals
from numpy.testing import assert_allclose

from lathe_rc.signals import speed

DURATION = 1.5
NOMINAL = 100.0
STEP = 1 / 64000

part = st.floats(-0.15, 0.15)


@st.composite
def harmonic_laws(draw):
    n = draw(st.integers(0, 3))
    rows = [
        np.array(draw(st.lists(values, min_size=n, max_size=n)), dtype=float)
        for values in (part, st.floats(0.1, 1000.0), st.floats(-4.0, 4.0))
    ]
    return speed.harmonic(NOMINAL, *rows, start=draw(st.floats(0.0, 1.0)))


@st.composite
def tachograms(draw):
    times = sorted(draw(st.sets(st.integers(0, 2000), max_size=6)))
    deviations = draw(st.lists(part, min_size=len(times), max_size=len(times)))
    return speed.tachogram(NOMINAL, np.array(times) / 1000, np.array(deviations))


random_laws = st.builds(
    speed.band_limited_random,
    st.just(NOMINAL),
    rms=st.floats(0.001, 0.02),
    low=st.floats(0.5, 10.0),
    high=st.floats(20.0, 500.0),
    lines=st.integers(1, 8),
    seed=st.integers(0, 2**31 - 1),
)
laws = st.one_of(
    st.just(speed.constant(NOMINAL)),
    harmonic_laws(),
    tachograms(),
    random_laws,
    st.builds(lambda a, b, c: a + b + c, harmonic_laws(), tachograms(), random_laws),
)


def smooth_pieces(law: speed.SpeedLaw) -> np.ndarray:
    """Edges of pieces in which the law is smooth and its fastest line turns by less than a radian."""
    fastest = law.lines[1].max(initial=1.0)
    kinks = np.concatenate((law.lines[3], law.tachogram[0]))
    grid = np.linspace(0.0, DURATION, int(DURATION * fastest) + 2)
    return np.union1d(grid, kinks[kinks < DURATION])


@given(laws)
def test_angle_speed_and_acceleration_belong_together(law):
    """Speed is the derivative of the angle, acceleration that of the speed, within the bound that the law gives."""
    edges = smooth_pieces(law)
    nodes, weights = np.polynomial.legendre.leggauss(10)
    half = np.diff(edges) / 2
    times = edges[:-1, None] + half[:, None] * (nodes + 1)
    _, speeds, accelerations = law.at(times.ravel()).reshape(3, *times.shape)
    assert law.at(0.0)[0, 0] == 0.0
    assert_allclose(law.at(edges[1:])[0], np.cumsum((speeds @ weights) * half), atol=1e-9)
    # A line that starts at a phase makes the speed jump there: look just before the end of each piece.
    end = np.nextafter(edges[1:], 0.0)
    gained = (accelerations @ weights) * half
    assert_allclose(law.at(end)[1] - law.at(edges[:-1])[1], gained, atol=1e-8)
    assert np.abs(accelerations).max() <= law.largest_acceleration() * (1 + 1e-12)


@given(laws)
def test_speed_range_bounds_the_speed(law):
    times = np.union1d(np.linspace(0.0, DURATION, 20001), law.lines[3])
    inside = law.at(times[times < DURATION])[1]
    for low, high in (law.speed_range(), law.speed_range(DURATION)):
        assert low - 1e-9 <= inside.min()
        assert inside.max() <= high + 1e-9


def test_speed_range_of_a_short_run_is_tight():
    law = speed.harmonic(NOMINAL, np.array([0.1]), np.array([2.0]), np.zeros(1))
    assert law.speed_range() == pytest.approx((90.0, 110.0))
    assert law.speed_range(np.pi / 12) == pytest.approx((100.0, 105.0), abs=0.02)


@given(laws, st.floats(0.0, 120.0))
def test_samples_until_is_the_first_sample_at_the_angle(law, angle):
    n = law.samples_until(angle, STEP)
    assert law.at(n * STEP)[0, 0] >= angle
    assert n == 0 or law.at((n - 1) * STEP)[0, 0] < angle


@given(laws, laws)
def test_deviations_add(a, b):
    if a.tachogram.size and b.tachogram.size:
        b = speed.SpeedLaw(b.nominal, b.lines)
    times = np.linspace(0.0, DURATION, 50)
    undisturbed = speed.constant(NOMINAL).at(times)
    assert_allclose((a + b).at(times), a.at(times) + b.at(times) - undisturbed, atol=1e-8)


def test_deviation_waits_for_its_start():
    law = speed.harmonic(NOMINAL, np.array([0.1]), np.array([10.7]), np.array([1.0]), start=1.0)
    times = [0.5, np.nextafter(1.0, 0.0), 1.0]
    assert_allclose(law.at(times)[1] / NOMINAL, [1.0, 1.0, 1.0 + 0.1 * np.sin(1.0)])


def test_tachogram_passes_its_points_and_holds_outside():
    law = speed.tachogram(NOMINAL, np.array([1.0, 2.0]), np.array([0.1, -0.1]))
    assert_allclose(law.at([0.0, 1.0, 1.25, 2.0, 9.0])[1], [110.0, 110.0, 105.0, 90.0, 90.0])


def test_random_deviation_has_its_rms_and_band():
    law = speed.band_limited_random(NOMINAL, 0.02, 5.0, 50.0, 16, seed=7)
    deviation = law.at(np.linspace(0.0, 400.0, 200001))[1] / NOMINAL - 1.0
    assert deviation.std() == pytest.approx(0.02, rel=0.02)
    spectrum = np.abs(np.fft.rfft(deviation * np.hanning(deviation.size))) ** 2
    frequency = 2 * np.pi * np.fft.rfftfreq(deviation.size, 400.0 / 200000)
    assert spectrum[(frequency > 4.9) & (frequency < 50.1)].sum() > 0.999 * spectrum.sum()
    again, other = (speed.band_limited_random(NOMINAL, 0.02, 5.0, 50.0, 16, seed).lines for seed in (7, 8))
    assert np.array_equal(law.lines, again)
    assert not np.array_equal(law.lines, other)


def turning_back(deviation: float) -> speed.SpeedLaw:
    """A law that is steady for two seconds and negative from then on."""
    ripple = speed.harmonic(NOMINAL, np.array([0.01]), np.array([1.0]), np.zeros(1))
    return speed.tachogram(NOMINAL, np.array([2.0, 2.1]), np.array([deviation, -1.5])) + ripple


def test_spindle_may_turn_back_after_the_end():
    law = turning_back(-0.4)
    n = law.samples_until(100.0, STEP)
    assert law.at(n * STEP)[0, 0] >= 100.0 > law.at((n - 1) * STEP)[0, 0]


one, two, none = np.ones(1), np.ones(2), np.zeros(1)
standing = speed.tachogram(NOMINAL, one, -1.2 * one)


@refusals(
    (lambda: standing.samples_until(1.0, STEP), "speed falls to -20 rad/s"),
    (lambda: turning_back(-0.4).samples_until(140.0, STEP), "speed falls to"),
    (lambda: turning_back(-0.7).samples_until(100.0, STEP), "speed falls to"),
    (lambda: speed.harmonic(1.0, two, one, two), "2 amplitudes, 1 frequencies and 2 phases"),
    (lambda: speed.harmonic(1.0, one, none, one), "frequency 0 rad/s"),
    (lambda: speed.tachogram(1.0, two, one), "2 times and 1 deviations"),
    (lambda: speed.tachogram(1.0, two, two), "increase"),
    (lambda: speed.tachogram(1.0, -one, one), "start at 0 s"),
    (lambda: speed.band_limited_random(1.0, 0.1, 5.0, 5.0, 4, 0), "band 5-5 rad/s"),
    (lambda: speed.constant(1.0) + speed.constant(2.0), "1.0 and 2.0 rad/s"),
    (lambda: speed.tachogram(1.0, one, one) + speed.tachogram(1.0, one, one), "two tachograms"),
)
def test_what_cannot_be_is_refused(make, message):
    assert_refused(make, message)
