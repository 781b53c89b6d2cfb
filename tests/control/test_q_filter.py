# SPDX-License-Identifier: Apache-2.0
"""Zero-phase Q filters: response, gain at 0, phase, what they cost and what they refuse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_machine.control.q_filter import Exponential, Gaussian, LowPass, MovingAverage, Weights
from lathe_rc.errors import InputError

CYCLE = 4096
WIDTHS = st.floats(0.01, 60.0)


def low_pass(width, cycle):
    """A low-pass with a band about as wide as the others' of this width."""
    return LowPass(0.3 / (1.0 + width), 0.9 / (1.0 + width), 1e-4, cycle)


KINDS = [Exponential, MovingAverage, Gaussian, low_pass]
kinds = st.sampled_from(KINDS)


def smooth(q, points):
    """The filter over ``points``, which stand for a chunk with its margins."""
    smoothed = np.empty(q.chunk)
    q.smooth(points, smoothed)
    return smoothed


@given(kinds, WIDTHS, st.floats(0.0, np.pi), st.floats(0.0, 2 * np.pi))
def test_phase_is_zero_and_gain_the_response(kind, width, radians, phase):
    """Also the promise that `response` is of the filter as it runs, and that it is 1 at 0."""
    q = kind(width, CYCLE)
    assert q.response(np.zeros(1))[0] == pytest.approx(1.0, abs=1e-12)
    wave = np.cos(radians * np.arange(-q.reach, q.chunk + q.reach) + phase)
    expected = 1.0 + q.response(np.array([radians]))[0] * wave[q.reach : q.reach + q.chunk]
    assert_allclose(smooth(q, 1.0 + wave), expected, atol=1e-10)


@pytest.mark.parametrize("kind", [Exponential, MovingAverage, Gaussian])
@pytest.mark.parametrize("width", [1.0, 7.3])
def test_widths_mean_the_same_for_long_waves(kind, width):
    radians = np.array([0.01, 0.02]) / width
    lost = 1 - kind(width, CYCLE).response(radians)
    # The moving average leaves out the half of its middle point: its width is right to a tenth of a point.
    assert_allclose(lost, (width * radians) ** 2, rtol=0.08 if kind is MovingAverage else 2e-3)


def test_exponential_has_its_closed_form():
    radians = np.linspace(0.0, np.pi, 20)
    closed = 1 / (1 + 4 * 1.14**2 * np.sin(radians / 2) ** 2)
    assert_allclose(Exponential(1.14, CYCLE).response(radians), closed, rtol=1e-14)


def test_exponential_nears_the_form_of_the_paper_on_a_fine_grid():
    frequency = np.array([500.0, 1000.0, 1500.0, 2000.0])
    grid_angle = 2 * np.pi / 8192
    q = Exponential(67e-6 * 100.0 / grid_angle, 8192)
    assert_allclose(q.response(frequency / 100.0 * grid_angle), 1 / (1 + (frequency * 67e-6) ** 2), rtol=1e-4)


def test_gaussian_and_moving_average_have_their_closed_forms():
    radians = np.linspace(0.01, 1.0, 20)
    assert_allclose(Gaussian(5.0, CYCLE).response(radians), np.exp(-((5.0 * radians) ** 2)), atol=1e-9)
    # 2·5 + 1 points to each side of the middle and none of the ends: a mean of 11 points
    q = MovingAverage(5.5 / np.sqrt(6.0), CYCLE)
    assert_allclose(q.response(radians), np.sin(5.5 * radians) / (11 * np.sin(radians / 2)), atol=1e-12)


@given(st.floats(0.05, 1.0), st.floats(0.02, 0.8), st.sampled_from([1e-2, 1e-3, 1e-5]))
def test_low_pass_keeps_its_ripple(passed, beyond, ripple):
    stopped = min(passed + beyond, np.pi)
    q = LowPass(passed, stopped, ripple, 1 << 14)
    assert np.abs(q.response(np.linspace(0.0, passed, 99)) - 1).max() < 1.05 * ripple
    assert np.abs(q.response(np.linspace(stopped, np.pi, 99))).max() < 1.05 * ripple


@pytest.mark.parametrize("kind", [Exponential, MovingAverage, Gaussian])
def test_cost_of_a_point_is_independent_of_the_width(kind):
    """The passes over chunk and margins, as multiples of the chunk: the kernels do a fixed amount for each point."""
    for width in (0.5, 5.0, 50.0, 500.0, 5000.0):
        q = kind(width, 1 << 20)
        whole = q.chunk + 2 * q.reach
        assert whole <= 3 * q.chunk
        assert kind is not Gaussian or whole <= q._length < 4 * q.chunk
    assert_allclose(kind(0.0, CYCLE).response(np.array([0.5, 3.0])), 1.0)
    smallest = kind(0.8, 64)
    assert smallest.chunk + smallest.reach <= 64


@pytest.mark.parametrize("width", [400.0, 1e7, 1e9])
@pytest.mark.parametrize("kind", KINDS)
def test_filter_wider_than_the_memory_is_refused_before_it_is_made(kind, width):
    with pytest.raises(InputError, match=r"reaches \d+ grid points to each side; allowed: less than half the cycle of"):
        kind(width, 64)


@pytest.mark.parametrize(("passed", "stopped"), [(0.5, 0.4), (0.5, 0.5), (0.5, 4.0), (0.0, 0.1)])
def test_bands_out_of_order_are_refused(passed, stopped):
    with pytest.raises(InputError, match="allowed: 0 < pass < stop <="):
        LowPass(passed, stopped, 1e-3, CYCLE)


@given(st.lists(st.floats(0.01, 1.0), min_size=1, max_size=40))
def test_any_symmetric_kernel_is_scaled_to_unit_gain(weights):
    q = Weights(np.array(weights), CYCLE)
    assert_allclose(smooth(q, np.ones(q.chunk + 2 * q.reach)), 1.0, atol=1e-12)
