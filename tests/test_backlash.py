# SPDX-License-Identifier: Apache-2.0
"""Backlash: the load follows at the flanks of the gap and rests between them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_rc.plants.feed import follow


def path(motor, half, start=0.0):
    load, places = start, []
    for place in motor:
        load = follow(load, half, place)
        places.append(load)
    return np.array(places)


moves = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=20)
halves = st.floats(0.0, 0.5)


def test_load_lags_by_half_the_gap_either_way():
    motor = np.concatenate((np.linspace(0.0, 1.0, 101), np.linspace(1.0, 0.0, 101)))
    load = path(motor, 0.1)
    assert_allclose(load[:101], np.maximum(motor[:101] - 0.1, 0.0), atol=1e-15)
    assert_allclose(load[101:], np.minimum(motor[101:] + 0.1, 0.9), atol=1e-15)


def test_sine_loses_half_the_gap_of_its_amplitude():
    motor = np.sin(np.linspace(0.0, 20.0 * np.pi, 4001))
    load = path(motor, 0.2)[1000:]
    assert load.max() == pytest.approx(0.8, abs=1e-6)
    assert load.min() == pytest.approx(-0.8, abs=1e-6)


@given(moves, halves)
def test_load_stays_within_the_gap(motor, half):
    assert np.all(np.abs(path(motor, half) - motor) <= half * (1 + 1e-12) + 1e-15)


@given(moves)
def test_without_a_gap_load_and_motor_are_one(motor):
    assert np.array_equal(path(motor, 0.0), motor)


@given(st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=20))
def test_motions_within_the_gap_move_nothing(motor):
    assert not np.any(path(motor, 0.5))


@given(moves, halves)
def test_stops_on_the_way_change_nothing(motor, half):
    fine = np.concatenate([np.linspace(a, b, 8)[1:] for a, b in zip([0.0, *motor[:-1]], motor, strict=True)])
    assert_allclose(path(fine, half)[6::7], path(motor, half), atol=1e-12)
