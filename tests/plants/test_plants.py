# SPDX-License-Identifier: Apache-2.0
"""The coarse drive and its sensor: the difference equation against the differential equation."""

import numpy as np
import pytest
from cells import cuts
from hypothesis import given
from hypothesis import strategies as st
from machines import amplitude, run
from numpy.testing import assert_allclose
from scipy.signal import lsim

from lathe_machine.plants.electrodynamic import ElectrodynamicDrive
from lathe_machine.plants.linear import DiscretePlant, discretise, second_order
from lathe_rc.signals.noise import Sensor

WN, ZETA, TAU = 1038.0, 0.804, 0.36e-3
STEP = 1 / 64000
A, B = second_order(WN, ZETA)
FREQUENCIES = np.linspace(10.0, 6000.0, 50)


def continuous(frequency):
    """Wi of spec/learning.md."""
    p = 1j * frequency
    return np.exp(-p * TAU) / (1 + 2 * ZETA * p / WN + (p / WN) ** 2)


def drive(command, lengths=None, **options):
    """Position, velocity and current of a drive."""
    values = {"natural_frequency": WN, "damping": ZETA, "delay": TAU, "stroke": 1e9, "moving_mass": 1.2}
    machine = ElectrodynamicDrive(**values | {"force_constant": 30.0, "step": STEP, "method": "foh"} | options)
    return run(lambda _, *parts: machine.block(*parts), 3, command, lengths=lengths)


# --- frequency response


@pytest.mark.parametrize("rate", [10_000, 64_000, 100_000])
def test_foh_is_the_drive_behind_a_linear_interpolator(rate):
    """A triangle of two steps has the response sinc²; what it folds back is below 1e-5 here."""
    plant = discretise(A, B, TAU, 1 / rate, "foh")
    triangle = np.sinc(FREQUENCIES / (2 * np.pi * rate)) ** 2
    assert_allclose(plant.response(FREQUENCIES), continuous(FREQUENCIES) * triangle, rtol=0, atol=1e-4)
    assert_allclose(plant.response(100.0), continuous(100.0), rtol=2e-5)


@pytest.mark.parametrize("samples", [0.0, 23.0, 23.25])
def test_tustin_warps_the_frequency_and_interpolates_the_delay(samples):
    plant = discretise(A, B, samples * STEP, STEP, "tustin")
    p = 2j / STEP * np.tan(FREQUENCIES * STEP / 2)
    z = np.exp(1j * FREQUENCIES * STEP)
    whole, part = divmod(samples, 1.0)
    delay = z**-whole * (1 - part + part / z)
    assert_allclose(plant.response(FREQUENCIES), delay / (1 + 2 * ZETA * p / WN + (p / WN) ** 2), rtol=1e-9)


@given(st.integers(1, 6), st.integers(0, 5), st.integers(0, 1000))
def test_response_solves_the_difference_equation(order, delay, seed):
    """States that do not act on themselves among them: their row has no pivot of its own."""
    random = np.random.default_rng(seed)
    transition = random.normal(size=(order, order)) * random.choice([0.0, 0.3, 0.9], (order, order))
    weights = random.normal(size=(order, 3))
    z = np.exp(1j * FREQUENCIES * STEP)[:, None, None]
    driven = weights[:, :1] + weights[:, 1:2] / z + weights[:, 2:] / z**2
    position = np.linalg.solve(np.eye(order) - transition / z, driven)[:, 0, 0] * z[:, 0, 0] ** -delay
    found = DiscretePlant(transition, weights, delay, 0.0, STEP).response(FREQUENCIES)
    assert_allclose(found, position, rtol=0, atol=1e-9 * np.abs(position).max())


def test_integrator_has_no_response_at_rest():
    plant = discretise(np.zeros((1, 1)), np.ones(1), 0.0, STEP, "tustin")
    at_rest, moving = plant.response([0.0, 100.0])
    assert not np.isfinite(at_rest)
    assert_allclose(moving, 1 / (2j / STEP * np.tan(100.0 * STEP / 2)), rtol=1e-12)


@pytest.mark.parametrize("method", ["foh", "tustin"])
def test_drive_answers_a_sine_as_its_response_says(method):
    frequency = 2 * np.pi * 200.0  # 320 samples a period
    time = np.arange(12800) * STEP
    position = drive(np.sin(frequency * time), method=method)[0]
    expected = discretise(A, B, TAU, STEP, method).response(frequency)
    assert_allclose(amplitude(position, frequency, 320, STEP), expected, rtol=1e-9)


# --- time


@pytest.mark.parametrize("eighths", [0, 3, 8 * 23, 8 * 23 + 1, 8 * 23 + 7])
def test_foh_is_exact_for_commands_linear_between_samples(eighths):
    """Against a simulation with eight times the rate, where the delayed command's kinks are samples too."""
    command = np.random.default_rng(1).normal(size=300).cumsum()
    position, velocity, _ = drive(command, delay=eighths / 8 * STEP)
    fine = np.arange(-8, 300 * 8) / 8  # from sample -1 on: the command rises from 0 there to its first value
    delayed = np.interp(fine - eighths / 8, np.arange(-1, 300), np.append(0.0, command), left=0.0)
    _, _, states = lsim((A, B[:, None], np.eye(2), np.zeros((2, 1))), delayed, (fine + 1) * STEP)
    assert_allclose(position, states[8::8, 0], rtol=1e-9, atol=1e-9)
    assert_allclose(velocity, states[8::8, 1], rtol=1e-9, atol=1e-6)


def test_current_is_what_the_acceleration_asks_for():
    time = np.arange(6400) * STEP
    _, velocity, current = drive(1e-3 * np.sin(500.0 * time))
    acceleration = np.gradient(velocity, STEP)[1000:-1]
    assert_allclose(current[1000:-1] * 30.0 / 1.2, acceleration, atol=1e-3 * np.abs(acceleration).max())


def test_end_stop_holds_the_carriage_until_it_is_driven_back():
    command = np.where(np.arange(6400) < 3200, 3e-3, -0.5e-3)
    position, velocity, _ = drive(command, stroke=1e-3)
    at_stop = position == 1e-3
    assert position.max() == 1e-3
    assert np.all(velocity[at_stop] <= 0.0)
    arrived, left = np.flatnonzero(at_stop)[[0, -1]]
    assert np.all(at_stop[arrived : left + 1])
    assert 3200 < left < 3300
    assert position[-1] == pytest.approx(-0.5e-3)


# --- sensor


def sense(true, lengths=None, name="drive", seed=1, noise=0.0, resolution=0.0):
    sensor = Sensor(noise, resolution, seed, name)
    return run(lambda _, *parts: sensor.measure(*parts), 1, true, lengths=lengths)[0]


@given(cuts)
def test_noise_does_not_depend_on_cuts(lengths):
    true = np.zeros(sum(lengths))
    assert np.array_equal(sense(true, lengths, noise=1.0), sense(true, noise=1.0))


def test_noise_is_white_and_has_its_rms():
    noise = sense(np.zeros(100_000), noise=2e-7)
    assert noise.std() == pytest.approx(2e-7, rel=0.01)
    assert noise.mean() == pytest.approx(0.0, abs=2e-9)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.01


def test_each_sensor_and_seed_has_its_own_noise():
    true = np.zeros(1000)
    streams = [sense(true, noise=1.0, name=name, seed=seed) for name in ("a", "b") for seed in (0, 1)]
    assert np.abs(np.corrcoef(streams) - np.eye(4)).max() < 0.15


@given(st.floats(1e-9, 1e-6))
def test_quantisation_rounds_to_the_nearest_step(resolution):
    true = np.random.default_rng(4).normal(scale=1e-4, size=1000)
    measured = sense(true, resolution=resolution)
    assert np.abs(measured - true).max() <= resolution / 2 * (1 + 1e-9)
    assert_allclose(measured / resolution, np.rint(measured / resolution), atol=1e-6)
