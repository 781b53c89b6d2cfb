# SPDX-License-Identifier: Apache-2.0
"""The periodic law: its terms, its memory and filter, anti-windup, quantisation, blocks."""

import dataclasses

import numpy as np
import pytest
from cells import cuts, in_blocks
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter1d

from lathe_machine.control.periodic import _SWITCH, PRESETS, PeriodicController, samples_in
from lathe_machine.transfer import LinearSystem
from lathe_papers.formulas.hyperstability import NOMINAL, plant, popov_bound
from lathe_papers.formulas.periodic_loop import PeriodicLoop, disturbance, steady_derivatives
from lathe_rc.errors import InputError

STEP = 0.01
SAMPLES = 100
GAINS = dataclasses.replace(PRESETS["published"], switch_time=0.5)


#: δ̃·h0·v alone: the other terms are off, or too small to be seen
MEMORY_ALONE = dataclasses.replace(GAINS, h11=1e-12, h12=0.0, lead=0.02, lag=0.02)


def make(gains=GAINS, *, samples=SAMPLES, **options):
    options = {"limit": 1e9, "memory_filter": 0.0, **options}
    return PeriodicController(gains, period=samples * STEP, step_s=STEP, **options)


def drive(controller, wanted, measured, lengths=None, first=0):
    command = np.empty(wanted.size)

    def block(start, *parts):
        controller.block(first + start, *parts)

    in_blocks(lengths or [wanted.size], block, wanted, measured, command)
    return command


def filtered(signal, gains=GAINS):
    output = np.empty(signal.size)
    LinearSystem(gains.filter, STEP, "tustin").block(signal, output)
    return output


def signals(size, seed=1):
    """Smooth r and y, so that the filters do not make them huge."""
    time = np.arange(size) * STEP
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, 2)
    return 0.5 * (1 - np.cos(time)) + 0.1 * np.sin(2 * time), 0.4 * np.sin(time + phase[0]) - 0.4 * np.sin(phase[0])


# --- the law


def test_law_is_eq_16_written_out():
    """Against arrays of a whole run, without limits and filter."""
    wanted, measured = signals(3 * SAMPLES)
    n = np.arange(wanted.size)
    v, output = filtered(wanted - measured), filtered(measured)
    s = output.clip(-1, 1)
    weighted = v * -np.expm1(-n * STEP / GAINS.switch_time)
    u1 = GAINS.h0 * weighted.reshape(3, SAMPLES).cumsum(axis=0).ravel()
    integral = STEP * np.append(0.0, np.cumsum(s * weighted)[:-1])
    u2 = (GAINS.h11 * integral + GAINS.h12 * s * weighted) * s
    controller = make()
    assert_allclose(drive(controller, wanted, measured), u1 + u2, rtol=1e-9, atol=1e-7)
    assert np.abs(output).max() > 1.0  # so that sat is in use
    assert controller.integrator == pytest.approx(STEP * np.sum(s * weighted), rel=1e-9)
    assert controller.largest_memory == pytest.approx(np.abs(u1).max())
    assert controller.largest_demand == pytest.approx(np.abs(u1 + u2).max())
    assert controller.saturated == 0


def test_memory_repeats_after_exactly_a_period():
    """A pulse of the error; then no error."""
    wanted = np.zeros(4 * SAMPLES)
    wanted[30] = 1.0
    command = drive(make(MEMORY_ALONE), wanted, np.zeros(wanted.size))
    assert command[30] != 0.0
    assert_allclose(command[SAMPLES:].reshape(3, -1), np.tile(command[:SAMPLES], (3, 1)), atol=1e-12)


@pytest.mark.parametrize("sigma", [0.01, 0.037, 0.1])
def test_memory_is_read_through_a_gaussian_without_delay(sigma):
    samples = 300
    wanted = np.zeros(2 * samples)
    wanted[60:240] = np.random.default_rng(3).normal(size=180)
    command = drive(make(MEMORY_ALONE, samples=samples, memory_filter=sigma), wanted, np.zeros(wanted.size))
    expected = gaussian_filter1d(command[:samples], sigma / STEP, truncate=8.0, mode="constant")
    assert_allclose(command[samples:], expected, atol=2e-5 * np.abs(command).max())


# --- limits


def test_command_is_limited_and_counted():
    wanted, measured = signals(3 * SAMPLES)
    free, controller = drive(make(anti_windup=False), wanted, measured), make(anti_windup=False, limit=5.0)
    command = drive(controller, wanted, measured)
    assert np.abs(command).max() == 5.0
    assert controller.saturated == (np.abs(command) == 5.0).sum() > 0
    assert controller.largest_demand > 5.0
    first = np.flatnonzero(np.abs(free) > 5.0)[0]
    assert_allclose(command[:first], free[:first])


def test_anti_windup_stops_integrator_and_memory():
    """The error stays, the limit is reached: the paper's law winds up, this one does not."""
    wanted, measured = np.full(20 * SAMPLES, 0.8), np.full(20 * SAMPLES, 0.5)
    paper, real = make(anti_windup=False, limit=1.0), make(limit=1.0)
    for controller in (paper, real):
        assert drive(controller, wanted, measured)[-1] == 1.0
    assert real.integrator < 0.1 * paper.integrator
    assert paper.largest_memory > 50.0
    assert paper.state.values[_SWITCH] == pytest.approx(GAINS.switch_low, abs=1e-2), "the limit works against the error"
    # Before the switch has opened, the transient of the filters may store a sample that is within the limit.
    assert np.abs(real.state.ring).max() <= 1.0


def test_limit_that_helps_the_error_does_not_stop_learning():
    """Demand beyond the limit but with the sign against the error: (S(u) - u)·v > 0."""
    gains = dataclasses.replace(GAINS, h12=0.0, lead=0.02, lag=0.02)
    controller = make(gains, limit=1.0)
    controller.state.ring[:] = 3.0
    drive(controller, np.full(SAMPLES, -0.01), np.zeros(SAMPLES))
    assert controller.saturated == SAMPLES
    stored = controller.state.ring[1:]  # δ̃ is 0 in the first sample
    assert np.all((stored < 3.0) & (stored > 1.0))


# --- quantisation


def test_measurement_and_command_are_quantised():
    wanted, measured = signals(2 * SAMPLES)
    exact = drive(make(), wanted, np.rint(measured / 1e-2) * 1e-2)
    rounded = drive(make(measurement_step=1e-2, command_step=0.5), wanted, measured)
    assert_allclose(rounded, np.rint(exact / 0.5) * 0.5)
    assert np.abs(rounded - exact).max() > 0.1


# --- eq. 15


def test_integral_of_eq_15_and_its_bound():
    wanted, measured = signals(2 * SAMPLES)
    ideal = np.random.default_rng(5).normal(size=SAMPLES)
    controller = make(limit=3.0, ideal=ideal)
    command = drive(controller, wanted, measured)
    v = filtered(wanted - measured)
    mu = np.tile(ideal, 2) + GAINS.reference_gain * v - command
    assert controller.popov_integral == pytest.approx(-STEP * np.sum(mu * v), rel=1e-9)
    theta = GAINS.reference_gain * filtered(wanted)[:SAMPLES] + ideal
    assert controller.popov_bound == pytest.approx(popov_bound(GAINS, GAINS.reference_gain, theta, STEP), rel=1e-9)


def test_bound_that_was_broken_stays_broken():
    """An error that the command does nothing about: -∫(u° + χ*v - S(u))·v falls for ever."""
    wanted = np.full(100 * SAMPLES, 0.1)
    controller = make(dataclasses.replace(GAINS, reference_gain=1.0), limit=1e-6, ideal=np.zeros(SAMPLES))
    assert controller.popov_holds
    drive(controller, wanted, np.zeros(wanted.size))
    assert controller.popov_integral < controller.popov_bound
    assert not controller.popov_holds


def test_without_ideal_the_command_of_a_period_before_stands_for_it():
    wanted, measured = signals(3 * SAMPLES)
    controller = make(limit=3.0)
    command = drive(controller, wanted, measured)
    v = filtered(wanted - measured)
    needed = np.append(np.zeros(SAMPLES), command[:-SAMPLES])
    expected = STEP * np.sum((command - needed - GAINS.reference_gain * v) * v)
    assert controller.popov_integral == pytest.approx(expected, rel=1e-9)


# --- blocks


@given(cuts, st.sampled_from([0.0, 0.02, 0.15]), st.booleans(), st.sampled_from([0.0, 1e-3]), st.integers(0, 10**9))
def test_cuts_change_nothing(lengths, sigma, anti_windup, quantisation, first):
    wanted, measured = signals(sum(lengths))
    steps = {"measurement_step": quantisation, "command_step": quantisation}
    whole, cut = (make(limit=4.0, memory_filter=sigma, anti_windup=anti_windup, **steps) for _ in range(2))
    assert np.array_equal(drive(cut, wanted, measured, lengths, first), drive(whole, wanted, measured, first=first))
    assert np.array_equal(cut.state.values, whole.state.values)


def test_kernel_closes_the_loop_as_blocks_of_one_sample_do():
    time = np.arange(300) * STEP
    wanted, load = steady_derivatives(time)[0], disturbance(time)
    whole, single = (PeriodicLoop(make(memory_filter=0.05), plant(NOMINAL)) for _ in range(2))
    output, command = np.empty((2, time.size))
    whole.block(0, wanted, load, output, command)
    outside = make(memory_filter=0.05)
    measured, given_command = np.empty((2, time.size))
    in_blocks([1] * time.size, single.block, wanted, load, measured, given_command)
    assert np.array_equal(measured, output)
    assert np.array_equal(drive(outside, wanted, output), command)


# --- refusals


@pytest.mark.parametrize(
    ("period", "step", "nearest"),
    [
        (25.0, 0.0075, "nearest 24.9975 or 25.005 s"),
        (0.003, 0.01, "nearest 0.01 s"),
        (1.0, 0.3, "nearest 0.9 or 1.2 s"),
    ],
)
def test_period_of_broken_steps_is_refused(period, step, nearest):
    with pytest.raises(InputError, match=f"a whole number of steps, {nearest}$"):
        samples_in(period, step)
    for whole in (1 / 1000, 0.005, 1 / 64000):
        assert samples_in(25.0, whole) == round(25.0 / whole)


@pytest.mark.parametrize(
    ("gains", "options", "message"),
    [
        ({"h0": 0.0}, {}, "h0 = 0; allowed: above 0"),
        ({"h11": 0.0}, {}, "h11 = 0; allowed: above 0"),
        ({"h12": -1.0}, {}, "h12 = -1; allowed: from 0"),
        ({"lag": np.nan}, {}, "lag = nan; allowed: above 0"),
        ({"switch_low": 1.0}, {}, "switch_low = 1; allowed: between 0 and 1"),
        ({}, {"limit": -2.0}, "limit = -2; allowed: above 0"),
        ({}, {"memory_filter": -0.1}, "memory_filter = -0.1; allowed: from 0"),
        ({}, {"measurement_step": -1e-4}, "measurement_step = -0.0001; allowed: from 0"),
        ({}, {"memory_filter": 0.2}, "memory_filter = 0.2 s reaches 100 samples .* 100 samples .up to 0.198 s"),
        ({}, {"ideal": np.zeros(99)}, "ideal input of shape .99,.; allowed: one value for each of 100 samples"),
    ],
)
def test_what_cannot_be_is_refused(gains, options, message):
    with pytest.raises(InputError, match=message):
        make(dataclasses.replace(GAINS, **gains), **options)


@pytest.mark.parametrize("memory_filter", [0.0, 0.03])
def test_a_frozen_memory_repeats_what_it_holds_and_learns_nothing(memory_filter):
    controller = make(memory_filter=memory_filter)
    wanted, measured = signals(6 * SAMPLES)
    drive(controller, wanted[: 3 * SAMPLES], measured[: 3 * SAMPLES])
    controller.learning = False
    integrator, nothing = controller.integrator, np.zeros(8 * SAMPLES)
    # Long enough for the filters on r and y to forget; the adaptive part is 0 with y.
    found = drive(controller, nothing, nothing, first=3 * SAMPLES)
    assert_allclose(found[-SAMPLES:], found[-2 * SAMPLES : -SAMPLES], rtol=1e-9, atol=1e-9)
    assert np.ptp(found[-SAMPLES:]) > 0.0
    assert controller.integrator == integrator
    controller.learning = True
    drive(controller, wanted[3 * SAMPLES :], measured[3 * SAMPLES :], first=11 * SAMPLES)
    assert controller.integrator != integrator
