# SPDX-License-Identifier: Apache-2.0
"""Models from step responses and their inverses: known plants come back, others as well as they can."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lathe_commission.reduced_order import ChannelStep, fit, fit_inverse, of_measurement, step_of
from lathe_machine.control.decoupler import FULL_W1, LAG, PAPER, REALISTIC, gain, lags
from lathe_machine.transfer import TransferFunction
from lathe_rc.errors import InputError
from lathe_rc.signals.measurement_file import read

TIME = np.arange(1001) * 1e-3
FREQUENCY = np.geomspace(0.3, 100.0, 40)


def measured(plant, time=TIME):
    return ChannelStep(time, step_of(plant, time))


def test_step_response_is_analytic():
    """Two lags: 1 - (T1·e^{-t/T1} - T2·e^{-t/T2})/(T1 - T2)."""
    expected = 1 - (0.22 * np.exp(-TIME / 0.22) - 0.17 * np.exp(-TIME / 0.17)) / 0.05
    assert_allclose(step_of(lags(0.17, 0.22), TIME), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("plant", "orders"),
    [
        (PAPER.w1, {"zeros": 0, "poles": 2, "oscillating": False}),
        (PAPER.w1, {"zeros": 0, "poles": 2}),
        (PAPER.w2, {"zeros": 0, "poles": 1, "integrator": True}),
        (PAPER.w4, {"zeros": 0, "poles": 1}),
        (REALISTIC.w3, {"zeros": 0, "poles": 2}),
        (TransferFunction((0.3, 2.0), (0.01, 0.25, 1.0)), {"zeros": 1, "poles": 2}),
        (TransferFunction((5.0,), (1.0, 0.0)), {"zeros": 0, "poles": 0, "integrator": True}),
    ],
)
def test_known_plant_comes_back(plant, orders):
    found = fit(measured(plant), **orders)
    scale = np.abs(found.wanted).max()
    assert found.rms < 1e-6 * scale
    assert_allclose(found.transfer.response(FREQUENCY), plant.response(FREQUENCY), rtol=1e-3)


def test_reduced_order_of_the_full_plant():
    """The best model of this order has a small residual, a zero more helps, and no denominator near it does better."""
    channel = measured(FULL_W1, np.arange(201) * 1e-2)
    two = fit(channel, zeros=0, poles=2)
    assert two.rms < 0.01 * channel.response[-1]
    assert fit(channel, zeros=1, poles=3).rms < 0.1 * two.rms
    top = two.transfer.numerator[0]
    for factor in (0.97, 1.03):
        for name in range(2):
            bottom = np.array(two.transfer.denominator)
            bottom[name] *= factor
            other = step_of(TransferFunction((top,), tuple(bottom)), channel.time)
            assert np.sqrt(np.mean((other - channel.response) ** 2)) > two.rms


def test_noise_does_not_lead_the_fit_astray():
    clean = step_of(PAPER.w1, TIME)
    noisy = ChannelStep(TIME, clean + np.random.default_rng(1).normal(scale=10.0, size=TIME.size))
    found = fit(noisy, zeros=0, poles=2, oscillating=False)
    assert found.rms == pytest.approx(10.0, rel=0.1)
    assert np.sqrt(np.mean((found.found - clean) ** 2)) < 2.0


@pytest.mark.parametrize("plant", [PAPER.w1, PAPER.w2])
def test_inverse_makes_a_step_again(plant):
    """Nonlinear programming does no worse than the model's own inverse, from which the paper starts."""
    channel = measured(plant, np.arange(4001) * 1e-4)
    found = fit_inverse(plant, channel)
    product = found.transfer.response(FREQUENCY) * plant.response(FREQUENCY)
    assert_allclose(product[FREQUENCY < 30], 1.0, atol=0.1)
    ideal = -np.expm1(-channel.time / LAG) - channel.time / LAG * np.exp(-channel.time / LAG)
    assert found.rms <= np.sqrt(np.mean((ideal - 1.0) ** 2)) * 1.001
    assert np.all(-1 / found.transfer.poles.real >= LAG * (1 - 1e-6))
    assert found.found[-1] == pytest.approx(1.0, abs=0.02)


def test_inverse_of_a_model_suits_the_plant_better_than_the_exact_inverse_of_the_model():
    channel = measured(FULL_W1, np.arange(4001) * 2.5e-4)
    model = fit(channel, zeros=0, poles=2, oscillating=False).transfer
    wrong = gain(1.2) * model
    assert fit_inverse(wrong, channel).rms == pytest.approx(fit_inverse(model, channel).rms, rel=1e-3)


def test_csv_gives_the_same_as_arrays(tmp_path):
    channel, path = measured(PAPER.w1), tmp_path / "step.csv"
    rows = np.stack((channel.time, channel.response), axis=1)
    np.savetxt(path, rows, "%.17g", delimiter=",", header="time_s,response", comments="")
    found = of_measurement(read(path))
    assert np.array_equal(found.time, channel.time)
    assert np.array_equal(found.response, channel.response)
    path.write_text("s,response\n0,1\n")
    with pytest.raises(InputError, match="columns 's', 'response'; allowed: time and response"):
        of_measurement(read(path))


@pytest.mark.parametrize(
    ("time", "response", "message"),
    [
        (TIME[:10], TIME[:10], "10 times, 10 values; allowed: 16"),
        (TIME, TIME[:-1], "1001 times, 1000 values"),
        (TIME, np.where(TIME > 0.5, np.nan, TIME), "not all numbers are finite"),
        (TIME + 0.1, TIME, r"times from 0\.1 s"),
        (TIME**2, TIME, "in even steps"),
        (TIME, TIME * 0, "0 throughout"),
    ],
)
def test_what_is_no_response_is_refused(time, response, message):
    with pytest.raises(InputError, match=message):
        ChannelStep(time, response)


@pytest.mark.parametrize(("zeros", "poles", "integrator"), [(2, 2, False), (0, 0, False), (0, 9, False), (-1, 2, True)])
def test_orders_that_make_no_model_and_coarse_records_are_refused(zeros, poles, integrator):
    with pytest.raises(InputError, match=f"{zeros} zeros, {poles} poles"):
        fit(measured(PAPER.w1), zeros=zeros, poles=poles, integrator=integrator)
    with pytest.raises(InputError, match=r"steps of 0\.01 s, lags from 0\.001 s"):
        fit_inverse(PAPER.w1, measured(PAPER.w1, TIME * 10))
