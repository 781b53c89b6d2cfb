# SPDX-License-Identifier: Apache-2.0
"""The compensators of paper 004: inverses, leak, presets, and what they do to the plant."""

import numpy as np
import pytest
from cells import in_blocks
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused
from numpy.testing import assert_allclose

from lathe_machine.control.decoupler import (
    FULL_W1,
    LEAK,
    PAPER,
    PRESETS,
    REALISTIC,
    Channels,
    Decoupler,
    compensators,
    inverse,
    lags,
)
from lathe_machine.transfer import LinearSystem, TransferFunction

STEP = 1 / 64000
FREQUENCY = np.geomspace(0.5, 500.0, 60)
times = st.floats(0.01, 0.5)


def drive(decoupler, u1, u2, lengths=None):
    v = np.empty((2, u1.size))
    in_blocks(lengths or [u1.size], lambda _, *parts: decoupler.block(*parts), u1, u2, *v)
    return v


@given(times, st.lists(times, min_size=1, max_size=2), st.none() | times, st.floats(1e-4, 1e-2))
def test_inverse_misses_by_its_lags_only(first, others, zero, lag):
    """As many lags as the plant has more poles than zeros; a zero of the plant becomes a pole of its inverse."""
    plant = TransferFunction((7.0,) if zero is None else (7.0 * zero, 7.0), (first, 1.0)) * lags(*others)
    expected = (1.0 + 1j * FREQUENCY * lag) ** -(len(others) + (zero is None))
    assert_allclose(inverse(plant, lag).response(FREQUENCY) * plant.response(FREQUENCY), expected, rtol=1e-9)


@pytest.mark.parametrize("preset", PRESETS)
def test_compensators_are_those_of_the_paper(preset):
    """K1 = W2·W4/W1 and K2 = W1·W3/W2 with (1 + 0.001p)² and the leak, by hand."""
    p = 1j * FREQUENCY
    w3 = (
        0.385e-6 / (0.003 * p**2 + 0.0005 * p + 1)
        if preset == "paper"
        else -0.385e-6 / ((0.003 * p) ** 2 + 0.0005 * p + 1)
    )
    w1 = 1179.0 / ((0.17 * p + 1) * (0.22 * p + 1))
    both = (0.001 * p + 1) ** 2
    k1 = 4.38e-3 / ((p + 0.05) * (0.045 * p + 1)) * 233.3e3 / (0.075 * p + 1) / w1 / both
    k2 = w1 * w3 * p * (0.045 * p + 1) / 4.38e-3 / both
    found = compensators(PRESETS[preset])
    assert_allclose(found[0].response(FREQUENCY), k1, rtol=1e-9)
    assert_allclose(found[1].response(FREQUENCY), k2, rtol=1e-9)


@pytest.mark.parametrize("channels", PRESETS.values())
def test_both_loops_no_longer_see_each_other(channels):
    """F/u2 and y/u1 against what they are without K1 and K2, where inverse and leak are good."""
    k1, k2 = (k.response(FREQUENCY) for k in compensators(channels))
    w1, w2, w3, w4 = (part.response(FREQUENCY) for part in (channels.w1, channels.w2, channels.w3, channels.w4))
    before, after = w4 * w2, w4 * w2 - w1 * k1
    assert np.abs(after / before)[(FREQUENCY > 5) & (FREQUENCY < 50)].max() < 0.11
    # u1 reaches y by W3·W1 and takes W4·W3 with it: what is left is the loop through the force.
    left = w3 * (w1 - w4 * w2 * k2) - w2 * k2
    ideal = -w3 * w4 * w3 * w1
    slow = FREQUENCY < 10.0
    assert_allclose(left[slow], ideal[slow], atol=0.05 * np.abs(w3 * w1)[slow].max())


def test_leak_bounds_what_a_wrong_model_lets_through():
    exact, leaking = (compensators(PAPER, leak=leak)[0] for leak in (0.0, LEAK))
    assert min(np.abs(exact.poles)) == 0.0
    assert min(np.abs(leaking.poles)) == pytest.approx(LEAK)
    assert_allclose(leaking.response(50.0), exact.response(50.0), rtol=2e-3)


def test_integrators_that_cancel_need_no_leak():
    """W1 and W2 with an integrator each: K1 has none."""
    integrating = TransferFunction((2.0,), (0.1, 1.0, 0.0))
    k1, k2 = compensators(Channels(integrating, PAPER.w2, PAPER.w3, PAPER.w4))
    assert all(np.abs(k.poles).min() > 1.0 for k in (k1, k2))


def test_presets_differ_in_the_deflection_only():
    assert (PAPER.w1, PAPER.w2, PAPER.w4) == (REALISTIC.w1, REALISTIC.w2, REALISTIC.w4)
    for channels, frequency, damping, sign in ((PAPER, 2.9, 0.005, 1), (REALISTIC, 53.0, 0.083, -1)):
        pole = channels.w3.poles[0]
        assert abs(pole) / (2 * np.pi) == pytest.approx(frequency, abs=0.06)
        assert -pole.real / abs(pole) == pytest.approx(damping, abs=6e-4)
        assert np.sign(channels.w3.response(0.0).real) == sign
    assert FULL_W1.response(0.0) == pytest.approx(1188.9)


def test_units_are_those_of_the_paper():
    """11.79 N/%, 0.0438 mm/s/%, 0.000385 mm/N, 233.3 N/mm."""
    assert PAPER.w1.response(0.0).real * 0.01 == pytest.approx(11.79)
    assert abs(PAPER.w2.response(1e-3)) * 1e-3 * 0.01 * 1e3 == pytest.approx(0.0438)
    assert PAPER.w3.response(0.0).real * 1e3 == pytest.approx(0.000385)
    assert PAPER.w4.response(0.0).real * 1e-3 == pytest.approx(233.3)


def test_blocks_are_the_cross_of_two_linear_systems_of_which_each_may_be_off():
    u1, u2 = np.random.default_rng(1).normal(size=(2, 3000)).cumsum(axis=1)
    k1, k2 = compensators(REALISTIC)
    v1, v2 = np.empty((2, 3000))
    LinearSystem(k1, STEP).block(u2, v1)
    LinearSystem(k2, STEP).block(u1, v2)
    assert_allclose(drive(Decoupler(k1, k2, STEP), u1, u2), [u1 - v1, u2 - v2], rtol=1e-12)
    assert_allclose(drive(Decoupler(k1, None, STEP), u1, u2), [u1 - v1, u2], rtol=1e-12)
    assert_allclose(drive(Decoupler(None, k2, STEP), u1, u2), [u1, u2 - v2], rtol=1e-12)


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (lambda: inverse(TransferFunction((-0.1, 1.0), (0.1, 1.0))), "a zero that is not stable"),
        (lambda: inverse(TransferFunction((0.0,), (0.1, 1.0))), ": 0, or a zero"),
        (lambda: inverse(PAPER.w1, 0.0), "lag 0 s; allowed: above 0"),
        (lambda: compensators(PAPER, leak=-0.1), r"leak -0\.1 rad/s; allowed: 0 for none"),
    ],
)
def test_compensator_that_cannot_be_built_is_refused_in_one_line(refused, message):
    assert_refused(refused, message)
