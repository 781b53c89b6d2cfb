# SPDX-License-Identifier: Apache-2.0
"""Models of a drive and their fits: against SciPy's own step responses, and against the models that made the data."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import assert_refused
from numpy.testing import assert_allclose
from scipy.integrate import trapezoid
from scipy.signal import step as scipy_step

from lathe_papers.formulas.step_fit import (
    Delay,
    FirstOrder,
    SecondOrder,
    StepResponse,
    fit_delay,
    fit_first_order,
    fit_second_order,
    read_csv,
)

DRIVE = SecondOrder(1038.0, 0.804, 0.36e-3)
TIME = np.linspace(0.0, 12e-3, 1000)
FITS = [
    fit_first_order,
    fit_delay,
    lambda m: fit_second_order(m, delayed=False),
    lambda m: fit_second_order(m, delayed=True),
]


def measure(model, time=TIME, noise=0.0):
    return StepResponse(time, model.step(time) + noise * np.random.default_rng(1).normal(size=time.size))


# --- models


@pytest.mark.parametrize("damping", [None, 0.1, 0.804, 0.999999, 1.0, 1.000001, 1.5, 20.0])
def test_step_response_is_scipys(damping):
    """Of a first-order model, and of second-order ones on either side of critical damping."""
    time, wn = np.linspace(0.0, 20e-3, 400), 1038.0
    model = SecondOrder(wn, damping) if damping else FirstOrder(2e-3)
    _, expected = scipy_step(([1.0], [1 / wn**2, 2 * damping / wn, 1.0] if damping else [2e-3, 1.0]), T=time)
    assert_allclose(model.step(time), expected, atol=1e-6)


@pytest.mark.parametrize("model", [FirstOrder(2e-3), SecondOrder(1038.0, 0.3), SecondOrder(1038.0, 3.0), DRIVE])
def test_nothing_happens_before_the_step_or_its_delay(model):
    early = getattr(model, "delay", 0.0) - np.array([1e-3, 1e-6, 0.0])
    assert_allclose(model.step(early), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    "model", [FirstOrder(2e-3), Delay(2e-3), SecondOrder(1038.0, 0.3), SecondOrder(900.0, 2.0), DRIVE]
)
def test_frequency_response_is_that_of_the_step(model):
    """W(jω) = 1 - jω·∫(1 - h)·e^{-jωt}dt."""
    time = np.linspace(0.0, 60e-3, 600_001)
    for frequency in (0.0, 100.0, 1000.0):
        turning = (1 - model.step(time)) * np.exp(-1j * frequency * time)
        by_step = 1 - 1j * frequency * trapezoid(turning, time)
        assert_allclose(model.response(np.array([frequency])), by_step, atol=1e-4)


# --- fits

orders = st.floats(np.log(20.0), np.log(5000.0)).map(np.exp)


@given(orders, st.floats(0.15, 4.0), st.floats(0.02, 1.5))
@settings(max_examples=20)
def test_second_order_with_delay_is_recovered(wn, damping, part):
    true = SecondOrder(wn, damping, part / wn)
    slowest = wn * (damping - np.sqrt(max(damping**2 - 1, 0.0)))
    measured = measure(true, np.linspace(0.0, true.delay + 10 / slowest, 800))
    found = fit_second_order(measured, delayed=True)
    assert measured.rms(found) < 1e-6
    assert_allclose(found.step(measured.time), true.step(measured.time), atol=1e-4)


@given(orders, st.floats(0.15, 4.0))
def test_second_order_is_recovered(wn, damping):
    true = SecondOrder(wn, damping)
    slowest = wn * (damping - np.sqrt(max(damping**2 - 1, 0.0)))
    found = fit_second_order(measure(true, np.linspace(0.0, 10 / slowest, 800)), delayed=False)
    assert found.natural_frequency == pytest.approx(wn, rel=1e-4)
    assert found.damping == pytest.approx(damping, rel=1e-4)
    assert found.delay == 0.0


@given(st.floats(1e-4, 1.0))
def test_first_order_is_recovered(time_constant):
    measured = measure(FirstOrder(time_constant), np.linspace(0.0, 8 * time_constant, 500))
    assert fit_first_order(measured).time_constant == pytest.approx(time_constant, rel=1e-6)


def test_delay_is_recovered_to_a_sample():
    found = fit_delay(measure(Delay(3.3e-3)))
    assert found.delay == pytest.approx(3.3e-3, abs=TIME[1])


@pytest.mark.parametrize("model", [DRIVE, SecondOrder(1038.0, 0.15), FirstOrder(2e-3)])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_no_other_delay_fits_better(model, noise):
    measured = measure(model, noise=noise)
    best = measured.rms(fit_delay(measured))
    assert best <= min(measured.rms(Delay(t)) for t in TIME) * (1 + 1e-12)


def test_no_neighbour_fits_better():
    measured = measure(DRIVE, noise=0.01)
    first = fit_first_order(measured).time_constant
    assert measured.rms(FirstOrder(first)) <= min(
        measured.rms(FirstOrder(first * f)) for f in (0.99, 0.999, 1.001, 1.01)
    )
    second = fit_second_order(measured, delayed=False)
    for wn, zeta in ((1.001, 1.0), (0.999, 1.0), (1.0, 1.001), (1.0, 0.999)):
        beside = SecondOrder(second.natural_frequency * wn, second.damping * zeta)
        assert measured.rms(second) <= measured.rms(beside)


def test_fits_of_the_drive_are_those_of_the_paper():
    """Paper 000 prints T0 = 2 ms for eqs 18 and 19."""
    measured = measure(DRIVE)
    assert fit_first_order(measured).time_constant == pytest.approx(2e-3, rel=0.02)
    assert fit_delay(measured).delay == pytest.approx(2e-3, rel=0.1)


def test_more_parameters_leave_less():
    measured = measure(DRIVE, noise=0.005)
    rms = [measured.rms(fit(measured)) for fit in FITS]
    assert rms[1] > rms[0] > rms[2] > rms[3]
    assert rms[3] == pytest.approx(0.005, rel=0.1)


def test_residual_is_taken_over_time_not_over_samples():
    """Ten times as many samples in one part do not make it count more."""
    uneven = np.unique(np.concatenate((TIME, np.linspace(0.0, 2e-3, 2000))))
    for fit in FITS:
        a, b = measure(DRIVE), measure(DRIVE, uneven)
        assert a.rms(fit(a)) == pytest.approx(b.rms(fit(b)), rel=0.01, abs=1e-6)
    assert fit_first_order(a).time_constant == pytest.approx(fit_first_order(b).time_constant, rel=1e-3)


def test_response_that_is_there_at_once_is_fitted_too():
    measured = StepResponse(np.linspace(0.0, 1.0, 20), np.ones(20))
    for fit in FITS:
        assert measured.rms(fit(measured)) < 0.2


# --- files

GOOD = "".join(f"{t * 1e3:.9g}, {h:.9g}\n" for t, h in zip(TIME[::10], DRIVE.step(TIME[::10]), strict=True))


def written(folder, text):
    path = folder / "step.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_csv_is_read(tmp_path):
    measured = read_csv(written(tmp_path, "# tool drive\ntime_ms, response\n\n" + GOOD))
    assert_allclose(measured.time, TIME[::10], atol=1e-11)
    assert_allclose(measured.response, DRIVE.step(TIME[::10]), atol=1e-8)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (None, "cannot be read"),
        ("t,h\n" + GOOD, "columns 't', 'h'; allowed: time and response"),
        ("time_ms,response\n" + GOOD + "3,1\n", "is followed by 0.003 s; allowed: increasing"),
        ("time_ms,response\n" + GOOD + "13,225\n", "ends at 225; allowed: near 1"),
    ],
)
def test_bad_csv_is_refused_in_one_line(tmp_path, text, reason):
    path = tmp_path if text is None else written(tmp_path, text)
    assert_refused(lambda: read_csv(path), f"^{path}.*{reason}")


@pytest.mark.parametrize(
    ("time", "response", "reason"),
    [
        (TIME[:7], np.ones(7), "7 times"),
        (TIME, np.ones(3), "3 values"),
        (np.append(TIME[:-1], np.nan), np.ones(TIME.size), "finite"),
        (TIME + 5e-3, np.ones(TIME.size), "from near 0"),
        (TIME - 13e-3, np.ones(TIME.size), "from near 0"),
    ],
)
def test_what_is_no_step_response_is_refused(time, response, reason):
    assert_refused(lambda: StepResponse(time, response), reason)
