# SPDX-License-Identifier: Apache-2.0
"""Margins and step data of loops, and gains that are made for them."""

import control
import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_machine.analysis.pid_tuning import delay, evaluate, fastest, response, state_space, tune
from lathe_machine.control.decoupler import FULL_W1, PAPER, compensators, gain, lags
from lathe_machine.control.pid import FORCE, POSITION, PidGains
from lathe_machine.transfer import TransferFunction
from lathe_rc.errors import InputError


def test_force_loop_is_that_of_the_paper():
    """Paper 004, Fig. 12, on the full plant."""
    loop = evaluate(FULL_W1, FORCE)
    assert loop.stable
    assert loop.rise == pytest.approx(0.0743, abs=5e-4)
    assert loop.settling == pytest.approx(0.211, abs=2e-3)
    assert loop.overshoot == pytest.approx(0.059, abs=2e-3)
    assert 20 * np.log10(loop.gain_margin) == pytest.approx(16.2, abs=0.05)
    assert loop.gain_frequency == pytest.approx(59.6, abs=0.1)
    assert loop.phase_frequency == pytest.approx(16.4, abs=0.1)


def test_position_loop_is_not_that_of_the_paper():
    """Fig. 11 has a gain margin of 3.5 dB; with the W2 that is printed the loop has none at all."""
    loop = evaluate(PAPER.w2, POSITION)
    assert loop.stable
    assert np.isinf(loop.gain_margin)
    assert loop.overshoot == pytest.approx(0.136, abs=2e-3)
    assert loop.settling == pytest.approx(0.255, abs=2e-3)


def test_integrator_with_a_gain_is_analytic():
    """K/p closes to a lag 1/K: rise ln 9/K, settling ln 50/K, 90° at K."""
    loop = evaluate(TransferFunction((2.0,), (1.0, 0.0)), PidGains(3.0, 0.0, 0.0, 1.0))
    assert loop.rise == pytest.approx(np.log(9.0) / 6.0, rel=2e-3)
    assert loop.settling == pytest.approx(np.log(50.0) / 6.0, rel=2e-3)
    assert loop.overshoot == pytest.approx(0.0, abs=1e-6)
    assert loop.phase_margin == pytest.approx(np.pi / 2, abs=1e-6)
    assert loop.phase_frequency == pytest.approx(6.0, rel=1e-6)


@pytest.mark.parametrize("wait", [1e-4, 0.05])
def test_delay_takes_its_part_of_the_phase_margin(wait):
    """K·e^{-pτ}/p: margin π/2 - Kτ, gain margin π/(2Kτ) at π/(2τ)."""
    loop = evaluate(TransferFunction((10.0,), (1.0, 0.0)), PidGains(1.0, 0.0, 0.0, 1.0), wait)
    assert loop.phase_margin == pytest.approx(np.pi / 2 - 10.0 * wait, abs=1e-4)
    assert loop.gain_margin == pytest.approx(np.pi / (20.0 * wait), rel=1e-3)
    assert loop.gain_frequency == pytest.approx(np.pi / (2.0 * wait), rel=1e-3)
    assert loop.stable


def test_loop_with_too_much_delay_is_not_stable():
    loop = evaluate(TransferFunction((10.0,), (1.0, 0.0)), PidGains(1.0, 0.0, 0.0, 1.0), 0.17)
    assert not loop.stable
    assert loop.phase_margin < 0.0
    assert np.isnan(loop.rise)


@settings(max_examples=25)
@given(
    st.floats(0.1, 1e4), st.lists(st.floats(0.01, 0.5), min_size=1, max_size=3), st.booleans(), st.floats(1.0, 40.0),
    st.floats(0.5, 1.2), st.floats(0.0, 0.01),
)  # fmt: skip
def test_tuned_loop_crosses_over_as_asked(size, times, integrator, crossover, margin, wait):
    plant = gain(size) * lags(*times) * (TransferFunction((1.0,), (1.0, 0.0)) if integrator else gain(1.0))
    try:
        gains = tune(plant, crossover=crossover, phase_margin=margin, wait=wait)
    except InputError:
        reject()
    there = gains.transfer.response(crossover) * plant.response(crossover) * np.exp(-1j * crossover * wait)
    assert abs(there) == pytest.approx(1.0, rel=1e-9)
    assert np.pi + np.angle(there) == pytest.approx(margin, abs=1e-9)
    assert gains.proportional > 0.0
    assert gains.derivative >= 0.0


def test_systems_of_python_control_are_plants_too():
    plant = control.tf([1188.9], [1.0]) * control.tf([1.0], [0.2, 1.0]) * control.tf([1.0], [0.1, 1.0])
    same = gain(1188.9) * lags(0.2, 0.1)
    assert_allclose(response(plant, [1.0, 9.0]), response(same, [1.0, 9.0]), rtol=1e-12)
    theirs, ours = (tune(each, crossover=9.0, phase_margin=1.0).proportional for each in (plant, same))
    assert theirs == pytest.approx(ours)
    assert evaluate(plant, FORCE).overshoot == pytest.approx(evaluate(same, FORCE).overshoot)


def test_fastest_keeps_both_margins():
    gains = fastest(FULL_W1, band=(2.0, 60.0), phase_margin=1.0, gain_margin=4.0)
    loop = evaluate(FULL_W1, gains)
    assert loop.stable
    assert loop.gain_margin >= 4.0
    assert loop.phase_margin == pytest.approx(1.0, abs=1e-3)
    assert loop.phase_frequency > evaluate(FULL_W1, FORCE).phase_frequency
    with pytest.raises(InputError, match=r"30 to 60 rad/s has margins .* or a shorter delay"):
        fastest(FULL_W1, band=(30.0, 60.0), phase_margin=1.0, gain_margin=8.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"crossover": 0.0, "phase_margin": 1.0}, "crossover 0 rad/s"),
        ({"crossover": 5.0, "phase_margin": 2.0}, "the margin below 90°"),
        ({"crossover": 500.0, "phase_margin": 1.0}, "which no PID brings to a margin"),
    ],
)
def test_what_cannot_be_tuned_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        tune(FULL_W1, **options)


def test_realisation_is_the_transfer_function():
    frequency = np.geomspace(0.1, 2000.0, 30)
    for transfer in (*compensators(PAPER), FORCE.transfer, gain(3.0), gain(0.0)):
        assert_allclose(response(state_space(transfer), frequency), transfer.response(frequency), rtol=1e-6)
    assert state_space(gain(3.0)).nstates == 0


def test_delay_is_a_delay():
    frequency = np.linspace(0.0, 1500.0, 30)
    assert_allclose(response(delay(1e-3), frequency), np.exp(-1e-3j * frequency), atol=1e-4)
    assert delay(0.0).nstates == 0
