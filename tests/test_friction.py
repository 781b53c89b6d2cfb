# SPDX-License-Identifier: Apache-2.0
"""Friction of the feed drive against formulas: Stribeck curve, presliding, rest, reversals."""

import control
import numpy as np
import pytest
from cells import cuts, in_blocks
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from lathe_rc.errors import InputError
from lathe_rc.plants.feed import FeedDrive
from lathe_rc.plants.feed_models import dc_screw, fourth_order
from lathe_rc.plants.friction import Friction, mobility

STEP = 1 / 64000
GAIN, LAG, FORCE = 0.1, 0.045, 1000.0  # [m/s], [s], [N] at a command of 1
MASS = FORCE * LAG / GAIN
LAWS = pytest.mark.parametrize("law", ["stribeck", "lugre"])


def rubbing(law, lag=LAG, **values):
    default = {"coulomb": 200.0, "static": 300.0, "speed": 5e-3, "viscous": 150.0, "stiffness": 1e7, "damping": 1e4}
    return Friction(law, mobility(GAIN, lag, FORCE), **{**default, **values})


def drive(friction, lags=(LAG,), step=STEP, **options):
    return FeedDrive(dc_screw(GAIN, lags), step=step, friction=friction, **options)


def run(machine, command, lengths=None):
    """Position and velocity."""
    motion = np.full((5, command.size), np.nan)
    in_blocks(lengths or [command.size], machine.block, command, *motion)
    return motion[:2]


@LAWS
@pytest.mark.parametrize("lags", [(LAG,), (5e-3, LAG)])
@pytest.mark.parametrize("command", [0.35, 0.6, -1.0])
def test_steady_force_is_the_stribeck_curve(law, lags, command):
    """The motor's force beyond that of its own equation, F1·(u - v/k), is Fc + (Fs - Fc)·e^… + Fv·v."""
    friction = rubbing(law)
    speed = run(drive(friction, lags), np.full(64_000, command))[1][-1]
    force = FORCE * (command - speed / GAIN)
    assert speed * command > 0.0
    assert force == pytest.approx(friction.steady(speed), rel=1e-6)


def test_presliding_is_a_spring_with_a_damper():
    """Far below Fs the slide is the mass F1·T/k on σ0 and σ1 + Fv + F1/k, and rests at F/σ0."""
    command = 1e-4
    position = run(drive(rubbing("lugre")), np.full(32_000, command))[0]
    spring = control.tf([FORCE * command], [MASS, FORCE / GAIN + 1e4 + 150.0, 1e7])
    expected = control.step_response(spring, np.arange(32_000) * STEP).outputs
    assert_allclose(position, expected, atol=4e-3 * expected.max())
    assert position[-1] == pytest.approx(FORCE * command / 1e7, rel=3e-3)


@pytest.mark.parametrize("lags", [(LAG,), (5e-3, LAG)])
def test_slide_rests_to_the_bit_below_fs_and_breaks_away_above(lags):
    position, velocity = run(drive(rubbing("stribeck"), lags), np.repeat([0.29, -0.29, 0.5], 6400))
    assert not position[:12_800].any()
    assert not velocity[:12_800].any()
    assert velocity[-1] > 0.01


@LAWS
def test_slide_stops_in_the_time_that_the_force_needs(law):
    """Coasting under Fc alone: v falls by (Fc + F1·v/k)/m and stays at 0; LuGre springs back by micrometres."""
    friction = rubbing(law, static=200.0, viscous=0.0, damping=3e4)
    command = np.repeat([1.0, 0.0], [64_000, 64_000])
    position, velocity = run(drive(friction), command)
    start = velocity[63_999]
    assert start == pytest.approx(0.8 * GAIN, rel=1e-5)
    expected = LAG * np.log1p(FORCE * start / GAIN / 200.0)
    stopped = np.flatnonzero(velocity[64_000:] < 1e-3 * start)[0] * STEP
    assert stopped == pytest.approx(expected, rel=0.02)
    assert np.ptp(position[-6400:]) <= (0.0 if law == "stribeck" else 1e-8)


@LAWS
def test_slide_stands_at_a_reversal_until_the_error_has_changed_sides(law):
    """The quadrant error: under a position loop of gain Kp the set point goes on by 2·Fc/(F1·Kp) meanwhile."""
    gain, step = 40.0, 2e-3
    machine = drive(rubbing(law, coulomb=20.0, static=20.0, viscous=0.0, stiffness=1e8), step=step)
    wanted = 20e-3 * np.sin(2 * np.pi * 0.02 * step * np.arange(30_000))
    position, velocity, effort, motor, measured = np.zeros((5, wanted.size))
    for n in range(wanted.size):
        command = np.array([gain * (wanted[n] - (position[n - 1] if n else 0.0))])
        machine.block(n, command, *(a[n : n + 1] for a in (position, velocity, effort, motor, measured)))
    for turn in (position.max(), position.min()):
        error = (wanted - turn)[np.abs(position - turn) <= (0.0 if law == "stribeck" else 6 * 20.0 / 1e8)]
        close = 0.03 if law == "stribeck" else 0.08
        assert error.max() == pytest.approx(0.02 / gain, rel=close)
        assert error.min() == pytest.approx(-0.02 / gain, rel=close)


@LAWS
@given(lengths=cuts)
def test_cuts_leave_no_trace(law, lengths):
    command = np.sin(np.arange(sum(lengths)) / 40.0)
    one, two = (run(drive(rubbing(law), step=1e-3), command, how) for how in (lengths, None))
    assert_array_equal(one, two)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rubbing("lugre", static=100.0), "friction: 100 N at rest and 200 N in motion; allowed: no less"),
        (lambda: rubbing("lugre", coulomb=0.0), "friction: force = 0; allowed: above 0"),
        (lambda: rubbing("lugre", damping=-1.0), "friction: damping = -1; allowed: 0 or more"),
        (lambda: drive(rubbing("lugre", lag=0.1)), "friction with a mobility .*; allowed: one whose poles the drive"),
        (lambda: FeedDrive(fourth_order(), step=STEP, friction=rubbing("lugre")), "allowed: one whose poles"),
        (lambda: drive(rubbing("lugre"), (LAG, 0.01), speed_limit=0.1), "speed limit = 0.1 m/s with friction and 2 l"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make, message):
    with pytest.raises(InputError, match=message) as refusal:
        make()
    assert len(str(refusal.value).splitlines()) == 1
