# SPDX-License-Identifier: Apache-2.0
"""The PID controller against its transfer function, its limits, converters, set point and divisor."""

from dataclasses import replace

import numpy as np
import pytest
from cells import cuts, in_blocks
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_machine.control.pid import FORCE, POSITION, Pid, PidGains, enable_integrator
from lathe_machine.transfer import LinearSystem
from lathe_rc.errors import InputError

STEP = 1 / 64000
GAINS, ONLY_GAIN = PidGains(0.8, 5.0, 0.02, 900.0), PidGains(1.0, 0.0, 0.0, 1.0)


def make(gains=GAINS, **options):
    return Pid(gains, **{"low": -1e9, "high": 1e9, "step": STEP, **options})


def drive(pid, set_point, measurement=None, lengths=None):
    measurement = np.zeros_like(set_point) if measurement is None else measurement
    command = np.empty_like(set_point)
    in_blocks(lengths or [set_point.size], pid.block, set_point, measurement, command)
    return command


@pytest.mark.parametrize(
    "gains",
    [GAINS, FORCE, POSITION, PidGains(2.0, 0.0, 0.0, 1.0), PidGains(0.0, 3.0, 0.0, 1.0), PidGains(1.0, 0.0, 0.1, 50.0)],
)
def test_without_limits_it_is_its_transfer_function(gains):
    error = np.random.default_rng(1).normal(size=2000)
    expected = np.empty_like(error)
    LinearSystem(gains.transfer, STEP, "foh").block(error, expected)
    pid = make(gains)
    assert_allclose(drive(pid, error), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
    assert (pid.saturated, pid.clamped, pid.slowed) == (0, 0, 0)


def test_transfer_function_is_the_sum_of_its_parts():
    p = 1j * np.array([0.3, 20.0, 900.0, 1e5])
    expected = 0.8 + 5.0 / p + 0.02 * 900.0 * p / (p + 900.0)
    assert_allclose(GAINS.transfer.response(p.imag), expected, rtol=1e-12)


def test_gains_of_the_paper_are_converted():
    """0.52733 %/N and 1351.02 %/mm."""
    assert FORCE.proportional * 1.0 * 100 == pytest.approx(0.52733)
    assert POSITION.proportional * 1e-3 * 100 == pytest.approx(1351.02)
    assert POSITION.integral * 1e-3 * 100 == pytest.approx(11069.17)
    assert POSITION.derivative * 1e-3 * 100 == pytest.approx(45.2539)
    assert (FORCE.integral * 100, FORCE.derivative * 100) == pytest.approx((1.4848, 0.046435))


def test_clamping_stops_the_integral_at_a_limit():
    up = 6400
    error = np.concatenate((np.full(up, 0.6), np.full(up, -0.6)))
    pid = make(PidGains(1.0, 100.0, 0.0, 1.0), low=-1.0, high=1.0)
    command = drive(pid, error)
    assert command.max() == 1.0
    # The integral stopped where the sum reached the limit: 0.4, and a turn of the error is answered at once.
    assert command[up] == pytest.approx(0.4 - 0.6, abs=2 * 100 * 0.6 * STEP)
    assert pid.clamped == pid.saturated == np.count_nonzero(np.abs(command) == 1.0) > 5000


def test_integral_leaves_a_limit():
    """The error drives back: the integral runs though the command is at the limit."""
    pid = make(PidGains(0.1, 100.0, 0.0, 1.0), low=-1.0, high=1.0)
    drive(pid, np.full(3000, 0.5))
    before = pid.state[0]
    drive(pid, np.full(10, -0.5))
    assert pid.state[0] < before


@given(st.floats(0.1, 2.0), st.integers(0, 5))
def test_command_stays_within_its_limits_and_cuts_are_counted(limit, seed):
    error = np.random.default_rng(seed).normal(size=500)
    pid = make(low=-limit, high=0.5 * limit, dac=0.07)
    command = drive(pid, error)
    assert command.min() >= -limit
    assert command.max() <= 0.5 * limit
    assert 0 < pid.saturated <= 500


@given(st.floats(1e-3, 0.3), st.floats(1e-3, 0.3))
def test_converters_round_to_the_nearest_step(adc, dac):
    measurement = np.random.default_rng(3).normal(size=300)
    read = -drive(make(ONLY_GAIN, adc=adc), np.zeros(300), measurement)
    command = drive(make(ONLY_GAIN, dac=dac), measurement)
    for rounded, step in ((read, adc), (command, dac)):
        assert np.abs(rounded - measurement).max() <= step / 2 * (1 + 1e-9)
        assert_allclose(rounded / step, np.rint(rounded / step), atol=1e-9 / step)


def test_ramp_limits_the_rate_of_the_set_point():
    pid = make(ONLY_GAIN, ramp=10.0)
    command = drive(pid, np.full(10_000, 1.0))
    assert_allclose(np.diff(command[:6000]), 10.0 * STEP, rtol=1e-9)
    assert np.all(command[6400:] == 1.0)
    assert pid.slowed == pytest.approx(6400, abs=2)


def test_smoothing_ends_a_ramp_as_an_exponential():
    command = drive(make(ONLY_GAIN, smoothing=0.02), np.ones(6400))
    assert_allclose(command, -np.expm1(-np.arange(1, 6401) * STEP / 0.02), rtol=1e-9)
    both = drive(make(ONLY_GAIN, smoothing=0.02, ramp=10.0), np.ones(6400))
    assert np.diff(both).max() == pytest.approx(10.0 * STEP)
    assert both.max() < 1.0


@given(cuts, st.integers(2, 9))
def test_divisor_computes_at_absolute_samples_and_holds(lengths, divisor):
    random = np.random.default_rng(4)
    set_point, measurement = random.normal(size=(2, sum(lengths)))
    command = drive(make(divisor=divisor), set_point, measurement, lengths)
    slow = drive(make(step=STEP * divisor), set_point[::divisor].copy(), measurement[::divisor].copy())
    assert np.array_equal(command, np.repeat(slow, divisor)[: command.size])


@given(cuts)
def test_cuts_change_nothing(lengths):
    random = np.random.default_rng(5)
    set_point, measurement = random.normal(size=(2, sum(lengths)))
    options = {"low": -1.0, "high": 1.0, "adc": 0.01, "dac": 0.02, "ramp": 300.0, "smoothing": 1e-3, "divisor": 3}
    whole, cut = make(**options), make(**options)
    assert np.array_equal(drive(cut, set_point, measurement, lengths), drive(whole, set_point, measurement))
    assert np.array_equal(whole.state, cut.state)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"low": 1.0, "high": 1.0}, "PID: limits 1 to 1; allowed: a lower one below"),
        ({"divisor": 0}, "PID: divisor 0; allowed: 1 or more"),
        ({"adc": -1.0}, "PID: ADC step -1; allowed: 0 for none"),
        ({"dac": np.inf}, "PID: DAC step inf"),
        ({"ramp": np.nan}, "PID: ramp nan"),
        ({"smoothing": -0.1}, "PID: smoothing -0.1"),
        ({"proportional": np.nan}, "PID gains P nan, .*; allowed: finite gains and N above 0"),
        ({"filter": 0.0}, ", N 0; allowed: finite gains and N above 0"),
    ],
)
def test_what_cannot_work_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        replace(GAINS, **options) if options.keys() <= {"proportional", "filter"} else make(**options)


def test_an_integral_that_stands_goes_on_where_it_was():
    pid = make(PidGains(2.0, 30.0, 0.0, 1.0))
    error = np.full(3000, 0.1)
    first = drive(pid, error[:1000])
    enable_integrator(pid.state, on=False, waits=False)
    second = drive(pid, error[1000:2000])
    assert_allclose(second, first[-1], rtol=1e-12)
    enable_integrator(pid.state, on=True, waits=False)
    third = drive(pid, error[2000:])
    whole = drive(make(PidGains(2.0, 30.0, 0.0, 1.0)), error[:2000])
    assert_allclose(third, whole[1000:], rtol=1e-12)


@pytest.mark.parametrize("options", [{"ramp": 5.0}, {"smoothing": 0.01}])
def test_a_set_point_comes_from_the_measurement_after_a_wait(options):
    pid = make(ONLY_GAIN, **options)
    drive(pid, np.ones(64_000))
    enable_integrator(pid.state, on=True, waits=True)
    assert_allclose(drive(pid, np.ones(100), np.full(100, 0.3)), 0.0, atol=1e-12)
    enable_integrator(pid.state, on=True, waits=False)
    error = drive(pid, np.ones(64_000), np.full(64_000, 0.3))
    assert error[0] < 0.01
    assert_allclose(error[-1], 0.7, rtol=1e-9)
    at_once = make(ONLY_GAIN)
    enable_integrator(at_once.state, on=True, waits=True)
    assert_allclose(drive(at_once, np.ones(10), np.full(10, 0.3)), 0.7)
