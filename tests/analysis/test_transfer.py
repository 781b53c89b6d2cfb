# SPDX-License-Identifier: Apache-2.0
"""Linear systems from transfer functions: exact for their holds, whatever the blocks."""

import warnings

import numpy as np
import pytest
from cells import cuts
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused, refusals
from machines import run as run_in_blocks
from numpy.testing import assert_allclose
from scipy import signal

from lathe_machine.transfer import LinearSystem, TransferFunction, discretise

STEP = 1e-3
SYSTEMS = [
    ((3.0,), (1.0,)),
    ((1.0, 2.0), (1.0, 3.0)),
    ((1.0,), (1.0, 0.0)),
    ((19.0,), (1.0, 10.2, 46.9, 48.0, 21.5)),  # paper 002
    ((10.2, 0.0, 0.0), (1e-6, 2e-3, 1.0, 33.0)),  # poles far apart
]
INPUT = np.sin(0.05 * np.arange(600)) + 0.3


def run(system, signal, lengths=None):
    return run_in_blocks(lambda _, *parts: system.block(*parts), 1, signal, lengths=lengths)[0]


@pytest.mark.parametrize("hold", ["foh", "zoh"])
@pytest.mark.parametrize(("top", "bottom"), SYSTEMS)
def test_holds_are_exact_for_ramps_and_for_steps(top, bottom, hold):
    found = run(LinearSystem(TransferFunction(top, bottom), STEP, hold), INPUT)
    # At rest before the first sample: the ramp to it begins a step earlier.
    rise = np.append(0.0, INPUT) if hold == "foh" else INPUT
    _, expected, _ = signal.lsim((top, bottom), rise, STEP * np.arange(rise.size), interp=hold == "foh")
    assert_allclose(found, expected[-INPUT.size :], atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize(("top", "bottom"), SYSTEMS)
def test_tustin_has_the_bilinear_response(top, bottom):
    system = discretise(TransferFunction(top, bottom), STEP, "tustin")
    z = np.exp(1j * np.array([0.01, 0.1, 1.0]))
    one = np.eye(system.now.size)
    found = [
        system.through
        + system.output @ np.linalg.solve(one - system.transition / point, system.before / point + system.now)
        for point in z
    ]
    p = 2.0 / STEP * (z - 1.0) / (z + 1.0)
    assert_allclose(found, np.polyval(top, p) / np.polyval(bottom, p), rtol=1e-8)


@given(cuts, st.sampled_from(SYSTEMS), st.sampled_from(["foh", "zoh", "tustin"]))
def test_blocks_change_no_bit(lengths, polynomials, hold):
    whole, cut = (LinearSystem(TransferFunction(*polynomials), STEP, hold) for _ in range(2))
    command = np.resize(INPUT, sum(lengths))
    assert np.array_equal(run(cut, command, lengths), run(whole, command))


def test_product_has_both_responses():
    first, second = (TransferFunction(*SYSTEMS[k]) for k in (1, 3))
    frequency = np.array([0.1, 1.0, 10.0])
    assert_allclose((first * second).response(frequency), first.response(frequency) * second.response(frequency))
    assert_allclose(np.sort_complex((first * second).poles), np.sort_complex([*first.poles, *second.poles]))


def test_gain_of_zero_is_silent_and_gives_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not np.any(run(LinearSystem(TransferFunction((0.0,), (1.0, 1.0)), STEP), INPUT))


@refusals(
    (lambda: TransferFunction((1.0, 0.0), (1.0,)), "of degrees 1 over 0; allowed: a numerator of no higher degree"),
    (lambda: TransferFunction((1.0,), (0.0,)), "allowed: a denominator that is not zero"),
    (lambda: TransferFunction((np.inf,), (1.0,)), "allowed: finite coefficients"),
)
def test_improper_functions_are_refused(make, message):
    assert_refused(make, message)
