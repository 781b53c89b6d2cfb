# SPDX-License-Identifier: Apache-2.0
"""The parameters behind the table of paper 001."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lathe_machine.plants.linear import discretise
from lathe_machine.plants.linear import second_order as matrices
from lathe_papers.formulas.responses import lead, lead_lag
from lathe_papers.formulas.structures import cycles, steady_error, supremum
from lathe_papers.formulas.tuning import (
    FREQUENCIES,
    HIGHEST,
    LEAD_LAG,
    LIMITS,
    PLAIN,
    PRINTED,
    START,
    nearest,
    smallest_deviation,
)
from lathe_rc.errors import LatheError


@pytest.mark.parametrize(
    ("tuning", "largest", "supremum"), [(START, 0.105, 1.0), (PLAIN, 0.098, 0.97), (LEAD_LAG, 0.055, 0.9505)]
)
def test_tunings_are_as_near_to_the_paper_as_the_spec_says(tuning, largest, supremum):
    assert np.abs(tuning.deviations()).max() < largest
    assert max(tuning.suprema()) < supremum


def test_start_lacks_two_entries_that_plain_has_within_the_limits():
    assert np.count_nonzero(np.abs(START.deviations()) <= 0.1) == 14
    assert np.all(np.abs(PLAIN.deviations()) <= LIMITS[:, None])


@pytest.mark.parametrize("tuning", [START, PLAIN, LEAD_LAG])
def test_suprema_are_those_of_a_dense_grid(tuning):
    channels = zip((tuning.coarse, tuning.fine), HIGHEST, strict=True)
    dense = [np.abs(channel.factor(np.linspace(0.0, highest, 200_001))).max() for channel, highest in channels]
    assert_allclose(tuning.suprema(), dense, rtol=1e-6)


@pytest.mark.parametrize("tuning", [PLAIN, LEAD_LAG])
def test_table_is_what_enough_cycles_leave(tuning):
    """The structures, cycle by cycle: each channel's memory learns from its own error alone."""
    coarse, fine = tuning.coarse, tuning.fine
    factors = np.abs([channel.factor(FREQUENCIES) for channel in (coarse, fine)])
    memory = np.zeros((3, 4), dtype=complex)  # of the first channel, a second coarse one and the piezo
    for _ in range(int(cycles(factors, 1e-12).max())):
        first = 1.0 - coarse.z(FREQUENCIES) * memory[0]
        second = first - coarse.z(FREQUENCIES) * memory[1]
        piezo = first - fine.z(FREQUENCIES) * memory[2]
        for place, (channel, error) in enumerate(((coarse, first), (coarse, second), (fine, piezo))):
            memory[place] = channel.q(FREQUENCIES) * memory[place] + error
    direct = first - fine.drive(FREQUENCIES) * first
    assert_allclose(np.abs([first, direct, second, piezo]), tuning.table(), rtol=1e-4)


@pytest.mark.parametrize("tuning", [PLAIN, LEAD_LAG])
@pytest.mark.parametrize("speed", [0.9, 1.0, 1.1])
def test_a_cell_of_default_rates_has_the_same_errors(tuning, speed):
    """Drives as difference equations at 64 kHz, Q over 1024 points whose width is fixed at 1000 rpm."""
    nominal, points, step = 1000 * np.pi / 30, 1024, 1 / 64_000
    errors = []
    for channel in (tuning.coarse, tuning.fine):
        a, b = matrices(channel.natural_frequency, channel.damping)
        drive = discretise(a, b, channel.delay, step, "foh")
        width = channel.q_time * nominal * points / (2 * np.pi)

        def q(frequency, width=width):
            return 1 / (1 + 4 * width**2 * np.sin(np.pi * frequency / (speed * nominal * points)) ** 2)

        def z(frequency, channel=channel, drive=drive):
            corrections = lead(frequency, channel.lead_time) * lead_lag(frequency, *channel.lead_lag)
            return drive.response(frequency) * corrections

        assert supremum(lambda w, q=q, z=z: q(w) - z(w), points / 2 * speed * nominal).magnitude < 0.98
        errors.append(steady_error(q(FREQUENCIES), z(FREQUENCIES)))
    if speed == 1.0:
        coarse, fine = errors
        direct = coarse * (1.0 - drive.response(FREQUENCIES))
        run = np.abs([coarse, direct, coarse**2, coarse * fine])
        assert_allclose(run, tuning.table(), rtol=3e-3)
        assert np.all(np.abs(run / PRINTED - 1.0) <= LIMITS[:, None])


def test_nearest_changes_as_few_digits_as_it_can():
    assert nearest() == PLAIN == replace(START, coarse=replace(START.coarse, q_time=66.9e-6))
    assert nearest(limits=np.full(4, 0.11)) == START
    with pytest.raises(LatheError, match="within 1 steps"):
        nearest(limits=np.full(4, 0.01), changes=1)


def test_search_betters_the_start_even_from_three_starts():
    found = smallest_deviation(lead_lag=True, starts=3, digits=4)
    best, start = (np.abs(np.log(tuning.table() / PRINTED)).max() for tuning in (found, START))
    assert best < 0.06 < start
    assert max(found.suprema()) < 0.951
    for channel, start in ((found.coarse, START.coarse), (found.fine, START.fine)):
        assert 0.75 <= channel.natural_frequency / start.natural_frequency <= 1.34
        assert 0.74 <= channel.damping / start.damping <= 1.34
        assert all(1e-4 <= time <= 2e-3 for time in channel.lead_lag)


def test_weights_shift_the_deviation_to_the_heavy_row():
    found = smallest_deviation(lead_lag=False, weights=LIMITS / 0.1, starts=2, digits=4)
    deviations = np.abs(found.deviations()).max(axis=1)
    assert found.coarse.lead_lag == found.fine.lead_lag == (0.0, 0.0)
    assert deviations[[0, 1, 3]].max() < 0.088
    assert 0.10 < deviations[2] < 0.135


def test_search_gives_up_where_nothing_is_stable_enough():
    with pytest.raises(LatheError, match=r"margin of 0\.9"):
        smallest_deviation(lead_lag=False, margin=0.9, starts=1)
