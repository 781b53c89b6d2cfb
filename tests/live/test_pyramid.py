# SPDX-License-Identifier: Apache-2.0
"""The pyramid of a timeline: no extreme is lost, no gap is closed, memory is bounded."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from lathe_live.pyramid import MOST_CELLS, Pyramid

VALUES = st.floats(-1e3, 1e3, width=32) | st.just(np.nan)
SIGNALS = st.integers(1, 90).flatmap(lambda size: arrays.arrays(np.float64, (size, 2), elements=VALUES))


def filled(values, first, pieces, most):
    """A pyramid that takes the revolutions in pieces; at the borders of pieces, in two parts."""
    pyramid, begin = Pyramid(2, most), 0
    while begin < len(values):
        end = begin + next(pieces)
        pyramid.put(first + max(begin - 1, 0), *2 * [values[max(begin - 1, 0) : end]])
        begin = end
    return pyramid


@given(SIGNALS, st.integers(0, 10**9), st.integers(1, 30), st.sampled_from([4, 16, 128]), st.data())
def test_the_extremes_of_every_range_at_every_zoom_are_those_of_its_values(values, first, piece, most, data):
    """Cell by cell; the cells cover the range, are at most as many as asked for, and a gap remains one."""
    pyramid = filled(values, first, iter(lambda: piece, None), most)
    begin, end = sorted(data.draw(st.tuples(*2 * [st.integers(0, len(values) - 1)])))
    cells = data.draw(st.integers(1, 100))
    bands = pyramid.bands(first + begin, first + end, cells)
    assert 1 <= len(bands.low) == len(bands.high) <= cells
    assert bands.first <= first + begin
    assert first + end < bands.first + bands.every * len(bands.low)
    assert len(pyramid._levels[0]) <= most
    for k, (low, high) in enumerate(zip(bands.low, bands.high, strict=True)):
        place = bands.first - first + k * bands.every
        raw = values[place : place + bands.every]
        assert np.array_equal(low, np.fmin.reduce(raw), equal_nan=True)
        assert np.array_equal(high, np.fmax.reduce(raw), equal_nan=True)


def test_a_million_revolutions_take_bounded_memory_and_each_extreme_is_seen_at_every_zoom():
    """One revolution in a million is higher than the others; the pyramid has less than 6 MB per signal."""
    pyramid, values = Pyramid(1), np.random.default_rng(1).random((1000, 1))
    for first in range(0, 1_000_000, 1000):
        pyramid.put(first, -values, values + 25.0 * (first == 654_000) * (np.arange(1000) == 321)[:, None])
    for width in (10**6, 10**5, 10**3, 10):
        for cells in (1, 7, 500, 4096):
            bands = pyramid.bands(654_321 - width // 2, 654_321 + width // 2, cells)
            place = int(bands.high[:, 0].argmax())
            assert bands.high[place, 0] > 25.0
            assert 0 <= 654_321 - bands.first - place * bands.every < bands.every
    assert sum(level.nbytes for level in pyramid._levels) < 6e6


def test_an_angle_that_jumps_far_ahead_takes_no_more_memory():
    pyramid = Pyramid(1)
    for first in (5, 10**15):
        pyramid.put(first, np.array([[-1.0]]), np.array([[2.0]]))
    bands = pyramid.bands(0, 2 * 10**15, 512)
    assert np.isnan(bands.low[1:-1]).all()
    assert (bands.low[[0, -1], 0].tolist(), bands.high[[0, -1], 0].tolist()) == ([-1.0, -1.0], [2.0, 2.0])
    assert len(pyramid._levels[0]) <= MOST_CELLS
