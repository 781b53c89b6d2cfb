# SPDX-License-Identifier: Apache-2.0
"""Form errors, revolution by revolution."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_rc.analysis.metrology import form_errors
from lathe_rc.signals import speed

TURN = 2 * np.pi


def steady(revolutions, samples=1000):
    """Angles at a steady speed, ``samples`` a revolution."""
    return np.arange(round(revolutions * samples)) * (TURN / samples)


def test_sine_has_its_rms_and_largest():
    angle = steady(3)
    found = form_errors(angle, np.floor(angle / TURN + 1e-9) * np.sin(4 * angle) + 0.5)
    assert_allclose(found.rms, np.sqrt(np.arange(3) ** 2 / 2 + 0.25))
    assert_allclose(found.largest, [0.5, 1.5, 2.5], rtol=1e-4)
    assert list(found.starts) == [0, 1000, 2000, 3000]


@given(st.floats(-1.0, 1.0), st.floats(0.1, 0.6))
def test_speed_does_not_weigh_on_the_error(level, swing):
    """A form error fixed to the angle has the same RMS however the spindle hurries through it."""
    law = speed.harmonic(100.0, np.array([swing]), np.array([100.0]), np.array([0.3]))
    angle = law.at(np.arange(20_000) / 64_000)[0]
    found = form_errors(angle, np.where(np.mod(angle, TURN) < np.pi / 2, 1.0, level))
    assert_allclose(found.rms, np.sqrt(0.25 + 0.75 * level**2), atol=2e-3)


@given(st.integers(2, 5000).filter(lambda samples: samples % 1000 != 999))  # there rounding decides
def test_incomplete_revolution_is_left_out(samples):
    complete = samples // 1000
    angle = steady(samples / 1000)
    found = form_errors(angle, np.where(np.arange(samples) < complete * 1000, 1.0, 100.0))
    assert_allclose(found.rms, np.ones(complete))
    assert_allclose(found.largest, np.ones(complete))
    assert list(found.starts) == [1000 * revolution for revolution in range(complete + 1)]


def test_last_sample_before_the_end_completes_a_revolution():
    """A run of whole revolutions ends before the first sample of the next."""
    angle = np.arange(0.0, 2 * TURN, 0.01)
    assert form_errors(angle, np.ones(angle.size)).rms.size == 2
    assert form_errors(angle[:-3], np.ones(angle.size - 3)).rms.size == 1


@pytest.mark.parametrize("samples", [0, 1, 2, 5])
def test_very_short_run_has_no_revolution(samples):
    found = form_errors(np.arange(samples) * 1e-3, np.ones(samples))
    assert found.rms.size == found.largest.size == 0
    assert list(found.starts) == [0]
