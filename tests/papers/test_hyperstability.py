# SPDX-License-Identifier: Apache-2.0
"""Conditions of hyperstability: against state space, against drives drawn from the box, against the spec."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_machine.control.periodic import PRESETS
from lathe_machine.signals.example_002 import PERIOD, fill_disturbance, fill_reference
from lathe_papers.formulas import hyperstability as hs
from lathe_papers.formulas.periodic_loop import disturbance, steady_derivatives, transient

PUBLISHED = PRESETS["published"]
TIME = np.arange(5000) * PERIOD / 5000
inside = st.tuples(*(st.floats(low, high) for low, high in hs.BOX)).map(np.array)


def matrices(drive, lead):
    """N, b and c of eq. 8 with the signs of a corrected, and a."""
    gain, *a = drive
    b = np.array([0.0, 0.0, 0.0, 1.0])
    c = gain * np.array([1.0, 3 * lead, 3 * lead**2, lead**3])
    return np.diag(np.ones(3), 1), b, c, np.array(a)


def test_response_is_that_of_eq_14_in_state_space():
    n, b, c, a = matrices(hs.NOMINAL, 0.17)
    chi, frequency = 110.0, np.array([0.0, 0.3, 3.0, 30.0, 300.0])
    closed = n - np.outer(b, a + chi * c)
    expected = [c @ np.linalg.solve(1j * w * np.eye(4) - closed, b) for w in frequency]
    assert_allclose(1 / (hs.inverse_response(hs.NOMINAL[None], 0.17, 0.0, frequency)[0] + chi), expected, rtol=1e-9)


def test_eq_14_with_lag_neglected_is_decided_by_the_limit():
    """(a4 - 3/T)/(K·T³) at the corner where it is least."""
    found = hs.positivity(hs.corners(), 0.17, 0.0)
    assert found.least_gain == pytest.approx((3 / 0.17 - 8.5) / (18.6 * 0.17**3))
    assert found.least_gain == pytest.approx(100.1, abs=0.05)
    assert np.isinf(found.frequency)
    assert found.possible
    assert PUBLISHED.reference_gain > found.least_gain


def test_eq_14_with_lag_is_met_by_nothing():
    """Of fourth order at high frequencies a loop is not positive, whatever its gain."""
    for drives in (hs.NOMINAL[None], hs.corners()):
        found = hs.positivity(drives, PUBLISHED.lead, PUBLISHED.lag)
        assert not found.possible
        assert found.least_gain > 2 * found.hurwitz_gain
        assert 50 < found.frequency < 300


@settings(max_examples=20)
@given(inside)
def test_box_is_no_worse_than_its_corners(drive):
    for lag in (0.0, 0.01):
        corners = hs.positivity(hs.corners(), 0.17, lag).least_gain
        assert hs.positivity(drive[None], 0.17, lag).least_gain <= corners * (1 + 1e-12)


@pytest.mark.parametrize("drive", [hs.NOMINAL, *hs.corners()[[3, 20]]])
def test_hurwitz_gain_is_where_a_pole_crosses(drive):
    gain, a1, a2, a3, a4 = drive
    limit = hs.positivity(drive[None], 0.17, 0.01).hurwitz_gain
    for factor, stable in ((0.999, True), (1.001, False)):
        top = limit * factor * gain * np.poly([-1 / 0.17] * 3) * 0.17**3
        poles = np.roots(np.polyadd(np.polymul([1, a4, a3, a2, a1], np.poly([-100.0] * 3) * 1e-6), top))
        assert (poles.real.max() < 0) == stable


# --- what the drive needs


def test_parts_make_the_signals_of_the_example():
    wanted, load = np.empty((2, TIME.size))
    fill_reference(0, TIME[1], wanted)
    fill_disturbance(0, TIME[1], 0.5, load)
    assert_allclose(steady_derivatives(TIME)[0] + transient(TIME), wanted, atol=1e-12)
    assert_allclose(disturbance(TIME), load, atol=1e-12)


def test_derivatives_are_those_of_the_reference():
    step = TIME[1]
    rows = steady_derivatives(TIME)
    away = np.abs(TIME - PERIOD / 2) > 0.1  # the third jumps there
    for low, high in itertools.pairwise(rows):
        assert_allclose(np.gradient(low, step)[away][1:-1], high[away][1:-1], atol=1e-4 * np.abs(high).max())
    assert rows[3].max() - rows[3].min() == pytest.approx(12 * (0.04 * np.pi) ** 3, rel=0.6)


def test_needed_input_is_that_of_the_spec():
    needed = np.abs(
        hs.required_input(np.vstack((hs.NOMINAL, hs.corners())), steady_derivatives(TIME), disturbance(TIME))
    )
    assert needed[0].max() == pytest.approx(0.891, abs=1e-3)
    assert needed[1:].max() == pytest.approx(1.10, abs=0.015)


def test_bound_of_a_constant():
    theta = np.full(1000, 3.0)
    assert hs.popov_bound(PUBLISHED, 20.0, theta, 0.025) == pytest.approx(-9 * 25 / 80 - 400 / 400)


# --- learning


def test_factor_without_nonlinear_gain_is_the_linear_one():
    """1 - h0·G/(1 + h0·G) = 1/(1 + h0·G)."""
    frequency = np.geomspace(0.1, 100, 20)
    g = 1 / hs.inverse_response(hs.NOMINAL[None], 0.17, 0.01, frequency)
    assert_allclose(hs.learning_factor(hs.NOMINAL[None], PUBLISHED, 0.0, 0.0, frequency), np.abs(1 / (1 + 40 * g)))


def test_published_memory_grows_where_the_spec_says():
    """5-14 rad/s, by y_F."""
    found = hs.learning(hs.NOMINAL[None], PUBLISHED, 0.0)
    assert found.grows_from[0] == pytest.approx(5.4, abs=0.1)
    assert found.grows_from[1] > 14
    assert found.largest > 1.4


def test_filter_lowers_the_factor_where_it_is_large():
    bare, smooth = (hs.learning(hs.corners(), PUBLISHED, sigma) for sigma in (0.0, 0.1))
    assert smooth.grows_from == bare.grows_from
    assert smooth.largest < bare.largest


def test_quantised_gains_learn_everywhere():
    """At every corner and every y_F, and with filter only."""
    gains = PRESETS["quantised"]
    assert hs.learning(hs.corners(), gains, gains.memory_filter).largest < 1.0
    assert hs.learning(hs.corners(), gains, 0.0).largest > 1.0
    assert gains.reference_gain > hs.positivity(hs.corners(), gains.lead, 0.0).least_gain
    never = dataclasses.replace(gains, h0=1e-9, h12=0.0)
    assert hs.learning(hs.NOMINAL[None], never, 0.0).grows_from == (np.inf, np.inf)
