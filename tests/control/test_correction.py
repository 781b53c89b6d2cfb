# SPDX-License-Identifier: Apache-2.0
"""Corrections and lead laws against the drive that they answer, at varying speed."""

import numpy as np
import pytest
from cells import cuts, spans
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from test_identification import respond
from test_repetitive import GRID, STEP, TURN, make

from lathe_machine.control.correction import Correction, CorrectionLaw
from lathe_machine.control.interpolation import derivative_responses, read_derivatives
from lathe_machine.control.lead import LeadLaw
from lathe_rc.errors import InputError
from lathe_rc.signals import speed

NOMINAL = 1000 * np.pi / 30
WN, ZETA, TAU = 1038.0, 0.804, 0.36e-3
TAPS = tuple((np.cos(0.3 * np.arange(24.0)) / np.arange(2.0, 26.0)).tolist())  # 8 ms, far longer than the lead
SWING = speed.harmonic(NOMINAL, np.array([0.1]), np.array([213.0]), np.zeros(1))


def follow(law, lead_law, *, points, constant=0.0, spindle=SWING, seconds=0.4, lengths=None):
    """Read a frozen memory through a correction and a drive; returns angle and position."""
    correction = Correction(law, WN, ZETA, lead=1e-3, lag=0.3e-3, taps=TAPS, interval=0.35e-3)
    ahead = {"lead_law": lead_law, "lead_time": TAU, "speed_law": spindle, "constant": constant}
    controller = make(**ahead, correction=correction, nominal=NOMINAL, delay=1000)
    controller.remember(points)
    controller.learning = False
    samples = int(seconds / STEP)
    angle, rate, _ = spindle.at(np.arange(samples) * STEP)
    past = np.concatenate((np.zeros(1000), angle))[:samples]
    command = np.empty(samples)
    for start, stop in spans(lengths or [samples]):
        part = slice(start, min(stop, samples))
        given = {"angle": angle[part], "speed": rate[part], "past_angle": past[part]}
        list(controller.block(start, **given, error=np.zeros(angle[part].size), command=command[part]))
    return angle, command, respond(command)


def profile(angle):
    return np.sin(2 * angle + 0.3) + 0.2 * np.cos(5 * angle)


POINTS = profile(np.arange(GRID) * TURN / GRID)
SETTLED = slice(3000, None)


def largest_error(law, lead_law, **changes):
    angle, _, position = follow(law, lead_law, points=POINTS, **changes)
    return np.abs(position - profile(angle))[SETTLED].max()


def test_term_with_the_acceleration_is_what_the_quasi_static_inverse_lacks():
    """(dΩ/dt)·s/ωn² of two waves: 10.5·213·2/1038² of the amplitude, behind the drive."""
    left = largest_error(CorrectionLaw.SECOND_ORDER_INVERSE, LeadLaw.EXACT_PREVIEW)
    assert 0.3 < left / (0.1 * NOMINAL * 213.0 * 2 / WN**2) < 1.6


def test_each_term_of_the_lead_brings_it_nearer_to_the_preview():
    """With that, the dynamic inverse makes the drive transparent at any speed: what is left is interpolation."""
    laws = (LeadLaw.CONSTANT_ANGLE, LeadLaw.VARIABLE, LeadLaw.VARIABLE_SECOND_ORDER, LeadLaw.EXACT_PREVIEW)
    left = [largest_error(CorrectionLaw.SECOND_ORDER_INVERSE_DYNAMIC, law) for law in laws]
    assert left == sorted(left, reverse=True)
    assert left[0] > 10 * left[1] > 50 * left[3]
    assert left[3] < 3e-6


def test_exact_correction_is_the_drive_at_nominal_speed_whatever_the_speed():
    """Paper 000, eq. (17): the angle sees the model with constant parameters."""
    angle, _, position = follow(CorrectionLaw.EXACT, LeadLaw.EXACT_PREVIEW, points=POINTS)
    expected = np.zeros(angle.size)
    for waves, amplitude in ((2, np.exp(0.3j)), (5, 0.2j)):
        s = 1j * waves * NOMINAL
        z = 1 / (1 + 2 * ZETA * s / WN + (s / WN) ** 2)
        expected += (amplitude * z * np.exp(1j * waves * angle)).imag
    assert_allclose(position[SETTLED], expected[SETTLED], atol=5e-6)


def test_constant_lead_belongs_to_the_angle():
    """With Wk2's own lag answered by a constant angle, one wave comes out in phase at any speed."""
    waves = 2
    z = 1 / (1 + 2 * ZETA * 1j * waves * NOMINAL / WN + (1j * waves * NOMINAL / WN) ** 2)
    points = np.sin(waves * np.arange(GRID) * TURN / GRID)
    constant = -np.angle(z) / waves
    angle, _, position = follow(CorrectionLaw.EXACT, LeadLaw.EXACT_PREVIEW, points=points, constant=constant)
    assert_allclose(position[SETTLED], abs(z) * np.sin(waves * angle[SETTLED]), atol=5e-6)


def test_lead_lag_has_its_response():
    steady = speed.constant(NOMINAL)
    waves = 8
    points = np.sin(waves * np.arange(GRID) * TURN / GRID)
    angle, command, _ = follow(CorrectionLaw.LEAD_LAG, LeadLaw.VARIABLE, points=points, spindle=steady)
    p = 1j * waves * NOMINAL
    z = (1 + p * 1e-3) / (1 + p * 0.3e-3) * np.exp(p * TAU)
    assert_allclose(command[SETTLED], (z * np.exp(1j * waves * angle[SETTLED])).imag, atol=5e-4)


def test_fir_filter_has_its_response_at_any_speed():
    """Each tap has a lead of its own, and the late ones read the cycle before."""
    waves = 8
    points = np.sin(waves * np.arange(GRID) * TURN / GRID)
    for turning in (0.8 * NOMINAL, NOMINAL):
        angle, command, _ = follow(CorrectionLaw.FIR, LeadLaw.VARIABLE, points=points, spindle=speed.constant(turning))
        p = 1j * waves * turning
        z = sum(tap * np.exp(p * (TAU - k * 0.35e-3)) for k, tap in enumerate(TAPS))
        assert_allclose(command[SETTLED], (z * np.exp(1j * waves * angle[SETTLED])).imag, atol=5e-4)


@given(cuts, st.sampled_from(list(CorrectionLaw)), st.sampled_from(list(LeadLaw)))
def test_cuts_change_nothing(lengths, law, lead_law):
    seconds = sum(lengths) * STEP
    whole = follow(law, lead_law, points=POINTS, seconds=seconds)[1]
    assert np.array_equal(whole, follow(law, lead_law, points=POINTS, seconds=seconds, lengths=lengths)[1])


def test_corrections_without_their_numbers_are_refused():
    with pytest.raises(InputError, match="lag = 0 s with correction lead_lag; allowed: above 0"):
        Correction(CorrectionLaw.LEAD_LAG, WN, ZETA)
    with pytest.raises(InputError, match=r"0 taps in steps of 0\.001 s with correction fir; allowed: 1"):
        Correction(CorrectionLaw.FIR, WN, ZETA, interval=1e-3)


@given(st.floats(0.0, np.pi), st.floats(0.0, TURN))
def test_derivatives_have_their_responses_on_the_grid(radians, phase):
    """At the grid points the interpolation is exact, so the differences alone are seen."""
    ring = np.cos(radians * np.arange(16) + phase)
    value, first, second = read_derivatives(ring, 8, 0.0)
    assert value == ring[8]
    wave = np.exp(1j * (radians * 8 + phase))
    assert first == pytest.approx((1j * (8 * np.sin(radians) - np.sin(2 * radians)) / 6 * wave).real, abs=1e-12)
    assert second == pytest.approx(((16 * np.cos(radians) - np.cos(2 * radians) - 15) / 6 * wave).real, abs=1e-12)


def test_derivatives_of_a_long_wave_are_those_of_the_wave():
    radians = np.array([0.02, 0.05])
    value, first, second = derivative_responses(radians)
    assert_allclose(value, 1.0, atol=1e-6)
    assert_allclose(first, 1j * radians, rtol=1e-5)
    assert_allclose(second, -(radians**2), rtol=1e-5)
