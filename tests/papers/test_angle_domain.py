# SPDX-License-Identifier: Apache-2.0
"""The plant in the angle domain against the chain rule, against the time domain and against perturbation theory."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from lathe_papers.formulas.angle_domain import (
    COEFFICIENTS,
    AngleDomain,
    Harmonic,
    exact,
    harmonic_errors,
    linearised,
    operator_powers,
    quasi_static,
    speed_derivatives,
)
from lathe_rc.errors import InputError
from lathe_rc.signals import speed

NOMINAL = 1000 * np.pi / 30
WN, ZETA = 1038.0, 0.804
DRIVE = np.array([1.0, 2 * ZETA / WN, 1 / WN**2])
ONE = np.ones(1)

numbers = st.floats(-2.0, 2.0)


def swing(amplitude, frequency, phase=0.3):
    return speed.harmonic(NOMINAL, np.array([amplitude]), np.array([frequency]), np.array([phase]))


def turns(count, points=256):
    return np.linspace(0.0, count * 2 * np.pi, int(count * points) + 1)


def from_roots(*roots):
    """a_0 = 1, a_1, ... of a polynomial with these roots."""
    rising = np.real(np.poly(roots))[::-1]
    return rising / rising[0]


# --- coefficients


@given(st.lists(numbers, min_size=2, max_size=6), st.lists(numbers, min_size=1, max_size=7), numbers)
def test_powers_of_p_are_the_chain_rule(angle, signal, t):
    """d^i/dt^i of X(φ(t)) for polynomials X and φ."""
    order = 5
    phi, x = Polynomial(angle), Polynomial(signal)
    derivatives = np.array([[phi.deriv(j + 1)(t)] for j in range(order)])
    powers = operator_powers(derivatives, order)[..., 0]
    by_angle = np.array([x.deriv(k)(phi(t)) if k else x(phi(t)) for k in range(order + 1)])
    both = x(phi)
    by_time = np.array([both.deriv(i)(t) if i else both(t) for i in range(order + 1)])
    terms = np.abs(powers) @ np.abs(by_angle)
    scale = Polynomial(np.abs(signal))(Polynomial(np.abs(angle)))
    size = np.array([scale.deriv(i)(abs(t)) if i else scale(abs(t)) for i in range(order + 1)])
    assert np.all(np.abs(powers @ by_angle - by_time) <= 1e-10 * (terms + size) + 1e-300)


@given(st.lists(numbers, min_size=1, max_size=5), st.floats(1.0, 500.0))
def test_at_constant_speed_all_sets_are_equal(polynomial, omega):
    a = np.array(polynomial)
    still = np.zeros((max(a.size - 1, 1), 3))
    still[0] = omega
    expected = quasi_static(a, still[0])
    assert_allclose(exact(a, still), expected, rtol=1e-12)
    assert_allclose(linearised(a, omega, still[0]), expected, rtol=1e-12)


@given(numbers, numbers, st.floats(1.0, 500.0), st.floats(0.5, 1.5))
def test_first_order_is_exact_in_all_sets(a0, a1, nominal, ratio):
    a, omega = np.array([a0, a1]), np.array([nominal * ratio])
    assert_allclose(exact(a, omega[None]), [[a0], [a1 * omega[0]]], atol=1e-12)
    assert_allclose(quasi_static(a, omega), exact(a, omega[None]), atol=1e-12)
    assert_allclose(linearised(a, nominal, omega), exact(a, omega[None]), atol=1e-9)


@given(st.lists(st.floats(0.1, 2.0), min_size=3, max_size=5))
def test_linearised_is_the_tangent_of_quasi_static(polynomial):
    a = np.array(polynomial)
    power = np.arange(a.size)
    for deviation in (1e-3, 1e-4):
        omega = np.array([NOMINAL * (1 + deviation)])
        rest = (quasi_static(a, omega) - linearised(a, NOMINAL, omega))[:, 0] / (a * NOMINAL**power)
        assert_allclose(rest, power * (power - 1) / 2 * deviation**2, rtol=0.01, atol=1e-15)


@given(st.floats(0.01, 0.3), st.floats(1.0, 300.0), st.floats(0.0, 6.0), st.floats(0.01, 1.0))
def test_each_derivative_of_the_speed_is_that_of_the_one_before(amplitude, frequency, phase, t):
    law = swing(amplitude, frequency, phase) + swing(0.05, 40.0)
    h = 1e-4 / max(frequency, 40.0)
    before, at, after = (speed_derivatives(law, np.array([t + d]), 5)[:, 0] for d in (-h, 0.0, h))
    largest = NOMINAL * np.array([amplitude * frequency**m + 0.05 * 40.0**m for m in range(5)])
    assert np.all(np.abs((after - before)[:-1] / (2 * h) - at[1:]) <= 1e-6 * largest[1:])


def test_lines_that_start_later_have_no_derivatives_before():
    law = speed.harmonic(NOMINAL, np.array([0.1]), np.array([50.0]), np.zeros(1), start=0.5)
    assert np.all(speed_derivatives(law, np.array([0.4]), 4)[1:] == 0.0)
    assert np.all(speed_derivatives(law, np.array([0.51]), 4)[1:] != 0.0)


# --- responses

PLANTS = {
    "first order": (from_roots(-300.0), ONE),
    "drive": (DRIVE, ONE),
    "second order with zero": (DRIVE, np.array([1.0, 2e-3])),
    "proper": (DRIVE, np.array([1.0, 1e-3, 0.5e-6])),
    "third order": (from_roots(-400.0, -500 + 600j, -500 - 600j), np.array([1.0, 1e-3])),
    "fourth order": (
        from_roots(-300 + 200j, -300 - 200j, -500 + 600j, -500 - 600j),
        np.array([1.0, 1e-3, 1e-6, 1e-10]),
    ),
}


@pytest.mark.parametrize("name", PLANTS)
def test_exact_coefficients_alone_give_the_truth(name):
    domain = AngleDomain(*PLANTS[name], swing(0.2, 213.0), turns(3))
    signal = Harmonic(2, 0.4)
    truth, response = domain.truth(signal), domain.response(signal, "exact")
    settled = domain.angle >= 2 * np.pi
    assert_allclose(response[settled], truth[settled], atol=2e-6 * np.abs(truth).max())
    if PLANTS[name][1] is ONE:
        assert_allclose(response, truth, atol=2e-6 * np.abs(truth).max())
    if name != "first order":
        for kind in ("quasi_static", "linearised"):
            assert np.abs(domain.response(signal, kind) - truth)[settled].max() > 1e-3


@pytest.mark.parametrize("kind", COEFFICIENTS)
@pytest.mark.parametrize("name", PLANTS)
def test_at_constant_speed_all_give_the_frequency_response(name, kind):
    a, b = PLANTS[name]
    angle = turns(4)
    domain = AngleDomain(a, b, speed.constant(NOMINAL), angle)
    p = 2j * NOMINAL
    response = np.polyval(b[::-1], p) / np.polyval(a[::-1], p)
    expected = np.imag(response * np.exp(2j * angle))
    last = angle > 3 * 2 * np.pi
    assert_allclose(domain.response(Harmonic(2), kind)[last], expected[last], atol=1e-6)
    assert_allclose(domain.truth(Harmonic(2))[last], expected[last], atol=1e-6)


def test_truth_is_that_of_an_integrator_of_its_own():
    law, angle = swing(0.3, 106.0), turns(2)
    signal = Harmonic(3, 1.0)

    def slope(t, x):
        y = signal(law.at(t)[0], 0)[0]
        return [x[1], (y - x[0] - DRIVE[1] * x[1]) / DRIVE[2]]

    done = solve_ivp(slope, (0.0, 0.2), [0.0, 0.0], rtol=1e-10, atol=1e-12, method="DOP853", dense_output=True)
    domain = AngleDomain(DRIVE, ONE, law, angle)
    times = np.interp(angle, law.at(np.linspace(0, 0.2, 200_001))[0], np.linspace(0, 0.2, 200_001))
    assert_allclose(domain.truth(signal), done.sol(times)[0], atol=1e-6)


def test_signal_may_be_a_spline():
    grid = np.linspace(0, 2 * np.pi, 257)
    values = np.sin(2 * grid)
    values[-1] = values[0]
    spline = CubicSpline(grid, values, bc_type="periodic")
    domain = AngleDomain(DRIVE, np.array([1.0, 1e-3]), swing(0.1, 106.0), turns(2))
    assert_allclose(domain.response(spline, "exact"), domain.response(Harmonic(2), "exact"), atol=1e-5)


def test_tachogram_is_exact_up_to_second_order():
    """A speed that ramps: dΩ/dt is known everywhere, the second derivative is not."""
    law = speed.tachogram(NOMINAL, np.array([0.0, 0.06, 0.12]), np.array([0.0, 0.2, -0.2]))
    domain = AngleDomain(DRIVE, ONE, law, turns(2))
    assert_allclose(domain.response(Harmonic(2), "exact"), domain.truth(Harmonic(2)), atol=2e-5)
    assert np.abs(domain.response(Harmonic(2), "quasi_static") - domain.truth(Harmonic(2))).max() > 1e-3
    with pytest.raises(InputError, match="tachogram"):
        AngleDomain(*PLANTS["third order"], law, turns(2)).response(Harmonic(2), "exact")


# --- what the approximations miss, to first order


@pytest.mark.parametrize(("amplitude", "frequency"), [(0.01, 10.7), (0.1, 10.7), (0.1, 106.0), (0.1, 213.0)])
def test_quasi_static_misses_the_acceleration(amplitude, frequency):
    """a_2·(dΩ/dt)·sX is left out, and the plant filters it."""
    law = swing(amplitude, frequency)
    domain = AngleDomain(DRIVE, ONE, law, turns(NOMINAL / frequency + 2, 128))
    p = 2j * NOMINAL
    gain = abs(1 / np.polyval(DRIVE[::-1], p))
    estimate = DRIVE[2] * amplitude * NOMINAL * frequency * 2 * gain**2
    assert harmonic_errors(domain, 2, 2 * np.pi)["quasi_static"] == pytest.approx(estimate, rel=0.3 * amplitude + 0.05)


@pytest.mark.parametrize("amplitude", [0.05, 0.1])
def test_linearised_misses_the_square_of_the_deviation(amplitude):
    """a_2·ΔΩ²·s²X, for a deviation so slow that the acceleration does not count."""
    domain = AngleDomain(DRIVE, ONE, swing(amplitude, 2.0), turns(NOMINAL / 2.0 + 2, 128))
    gain = abs(1 / np.polyval(DRIVE[::-1], 2j * NOMINAL))
    estimate = DRIVE[2] * (amplitude * NOMINAL) ** 2 * 4 * gain**2
    assert harmonic_errors(domain, 2, 2 * np.pi)["linearised"] == pytest.approx(estimate, rel=0.1)


@given(st.floats(0.02, 0.3), st.floats(20.0, 300.0), st.integers(1, 4))
def test_exact_is_never_worse(amplitude, frequency, waves):
    domain = AngleDomain(DRIVE, ONE, swing(amplitude, frequency), turns(2, 128))
    errors = harmonic_errors(domain, waves, 2 * np.pi)
    assume(errors["quasi_static"] > 1e-4)
    assert errors["exact"] < 0.01 * errors["quasi_static"]


def test_error_over_all_phases_is_the_envelope():
    domain = AngleDomain(DRIVE, ONE, swing(0.2, 106.0), turns(3))
    settled = domain.angle >= 2 * np.pi
    by_phase = []
    for phase in np.linspace(0, np.pi, 40, endpoint=False):
        signal = Harmonic(2, phase)
        error = domain.response(signal, "quasi_static") - domain.truth(signal)
        by_phase.append(np.abs(error[settled]).max())
    assert harmonic_errors(domain, 2, 2 * np.pi)["quasi_static"] == pytest.approx(max(by_phase), rel=0.01)


# --- refusals


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"denominator": ONE}, "plant of 1 coefficients a"),
        ({"denominator": np.array([1.0, 0.0])}, "the last not 0"),
        ({"numerator": np.ones(4)}, "4 b"),
        ({"angle": np.array([1.0, 2.0])}, "increasing from 0"),
        ({"angle": np.array([0.0, 2.0, 1.0])}, "increasing from 0"),
        ({"angle": np.zeros(1)}, "two or more"),
        ({"law": swing(1.5, 10.0)}, "stand still"),
    ],
)
def test_bad_input_is_refused(change, text):
    given_ = {"denominator": DRIVE, "numerator": ONE, "law": swing(0.1, 10.0), "angle": turns(1)}
    with pytest.raises(InputError, match=text):
        AngleDomain(**{**given_, **change})


def test_linearised_equation_without_solution_is_refused():
    domain = AngleDomain(DRIVE, ONE, swing(0.6, 50.0), turns(2))
    assert np.all(np.isfinite(domain.response(Harmonic(2), "exact")))
    with pytest.raises(InputError, match="A_2 falls to 0"):
        domain.response(Harmonic(2), "linearised")
