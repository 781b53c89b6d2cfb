# SPDX-License-Identifier: Apache-2.0
"""Allowance: the walk's statistics, the run-out over the angle, seeds, blocks."""

import numpy as np
import pytest
from machines import assert_refused, refusals, run
from numpy.testing import assert_allclose

from lathe_machine.signals.allowance import PAPER_RMS, Allowance, Walk, mean_reverting, unbounded

STEP = 1 / 64000
STILL = Walk(1.0, 0.0, 0.0)


def make(walk=STILL, order=(), amplitude=(), phase=(), seed=1, name="allowance"):
    return Allowance(
        walk, order=np.array(order), amplitude=np.array(amplitude), phase=np.array(phase), seed=seed, name=name
    )


def draw(allowance, angle, lengths=None):
    return run(lambda _, *parts: allowance.block(*parts), 1, angle, lengths=lengths)[0]


def test_mean_reverting_walk_has_its_rms_and_autocorrelation():
    """4000 correlation times; the estimate of the RMS has a standard deviation of 1.6 %."""
    step, time = 0.02, 1.0
    walk = draw(make(mean_reverting(PAPER_RMS, time, step)), np.zeros(200_000))
    assert walk.std() == pytest.approx(PAPER_RMS, rel=0.04)
    for lag in (10, 50, 100):
        assert np.mean(walk[lag:] * walk[:-lag]) / PAPER_RMS**2 == pytest.approx(np.exp(-lag * step / time), abs=0.06)


@pytest.mark.parametrize("step", [STEP, 0.05, 3.0])
def test_walk_is_stationary_from_the_first_sample_on_whatever_the_step(step):
    """Over many seeds the first and a later sample have the same RMS: 2000 draws, standard deviation 1.6 %."""
    walks = np.array([draw(make(mean_reverting(1.0, 0.5, step), seed=seed), np.zeros(4)) for seed in range(2000)])
    assert_allclose(walks.std(axis=0), 1.0, rtol=0.06)
    assert_allclose(np.mean(walks[:, 0] * walks[:, 3]), np.exp(-3 * step / 0.5), atol=0.08)


def test_innovations_are_white_and_normal():
    walk = mean_reverting(1.0, 0.5, 0.01)
    values = draw(make(walk), np.zeros(100_000))
    kicks = (values[1:] - walk.keep * values[:-1]) / walk.kick
    assert kicks.std() == pytest.approx(1.0, rel=0.01)
    assert abs(np.corrcoef(kicks[1:], kicks[:-1])[0, 1]) < 0.015
    assert np.mean(np.abs(kicks) < 1.0) == pytest.approx(0.6827, abs=0.01)


def test_unbounded_walk_grows_with_the_root_of_time():
    rate, step = 2e-6, 0.01
    ends = [draw(make(unbounded(rate, step), seed=seed), np.zeros(401))[[0, 100, 400]] for seed in range(2000)]
    assert_allclose(np.std(ends, axis=0), rate * np.sqrt([0.0, 1.0, 4.0]), rtol=0.06)


def test_run_out_turns_with_the_spindle_and_adds_to_the_walk():
    angle = np.linspace(0.0, 30.0, 1000)
    walk, orders = mean_reverting(PAPER_RMS, 0.1, STEP), ([1, 3], [30e-6, 5e-6], [0.4, -1.0])
    run_out = 30e-6 * np.sin(angle + 0.4) + 5e-6 * np.sin(3 * angle - 1.0)
    assert_allclose(draw(make(STILL, *orders), angle), run_out, atol=1e-18)
    assert_allclose(draw(make(walk, *orders), angle), draw(make(walk), angle) + run_out)


@refusals(
    (lambda: mean_reverting(-1e-6, 1.0, STEP), r"allowance: RMS -1e-06 m; allowed: 0 or more"),
    (lambda: mean_reverting(1e-6, 0.0, STEP), r"allowance: correlation time 0 s"),
    (lambda: mean_reverting(1e-6, np.inf, STEP), r"allowance: correlation time inf s; .* has a rate instead"),
    (lambda: unbounded(-1.0, STEP), r"allowance: rate -1 m/√s"),
    (lambda: make(order=[1.0], amplitude=[1e-6, 1e-6], phase=[0.0]), r"run-out: 1 orders, 2 amplitudes"),
    (lambda: make(order=[1.5], amplitude=[1e-6], phase=[0.0]), r"run-out: order 1.5; allowed: whole"),
)
def test_what_cannot_be_is_refused(make, message):
    assert_refused(make, message)
