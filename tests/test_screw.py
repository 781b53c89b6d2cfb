# SPDX-License-Identifier: Apache-2.0
"""The screw of a feed drive against its formula: pitch error, warming, who sees it."""

import numpy as np
import pytest
from cells import cuts, in_blocks
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from lathe_rc.errors import InputError
from lathe_rc.plants.feed import FeedDrive
from lathe_rc.plants.feed_models import dc_screw
from lathe_rc.plants.screw import Screw

STEP = 1e-3
WRONG = {"slope": 20e-6, "lead": 5e-3, "amplitude": 3e-6, "phase": 0.7}


def run(screw, command, lengths=None, **options):
    """Position, velocity, effort, motor, measured."""
    machine = FeedDrive(dc_screw(0.1, (0.045,)), step=STEP, screw=screw, **options)
    motion = np.full((5, command.size), np.nan)
    in_blocks(lengths or [command.size], machine.block, command, *motion)
    return motion


def test_pitch_error_is_that_of_the_place():
    position, velocity, _, motor, _ = run(Screw(**WRONG), np.sin(np.arange(8000) / 900.0))
    wave = 3e-6 * (np.sin(2 * np.pi * motor / 5e-3 + 0.7) - np.sin(0.7))
    assert_allclose(position - motor, 20e-6 * motor + wave, atol=1e-15)
    assert_allclose(np.diff(position) / STEP, (velocity[1:] + velocity[:-1]) / 2, atol=5e-4 * velocity.max())


def test_screw_warms_with_the_way_and_grows_from_its_bearing():
    """At a steady speed ΔT = (R·v + A)·(1 - e^{-t/T}); α·ΔT of the way from the bearing is added."""
    screw = Screw(heating=50.0, surroundings=-1.0, time=20.0, anchor=-0.2)
    position, velocity, _, motor, _ = run(screw, np.full(40_000, 0.5))
    time = STEP * np.arange(40_000)
    rise = (50.0 * 0.05 - 1.0) * -np.expm1(-time / 20.0)
    assert_allclose((position - motor)[1000:], (11.5e-6 * rise * (motor + 0.2))[1000:], atol=3e-8)
    assert_allclose((position - motor)[-1], 11.5e-6 * rise[-1] * (motor[-1] + 0.2), rtol=5e-3)
    assert_allclose(np.diff(position[1000:]) / STEP, (velocity[1001:] + velocity[1000:-1]) / 2, rtol=1e-9)


@pytest.mark.parametrize(("feedback", "sees"), [("motor", 3), ("load", 0)])
def test_only_a_sensor_at_the_load_sees_it_and_backlash_comes_behind(feedback, sees):
    command = np.sin(np.arange(8000) / 900.0)
    motion = run(Screw(**WRONG), command, feedback=feedback)
    assert_array_equal(motion[4], motion[sees])
    loose = run(Screw(**WRONG), command, backlash=40e-6)[0]
    assert np.ptp(motion[0] - loose) == pytest.approx(40e-6)
    assert_array_equal(motion[3], run(Screw(), command)[3])


@given(lengths=cuts)
def test_cuts_leave_no_trace(lengths):
    command = np.sin(np.arange(sum(lengths)) / 40.0)
    one, two = (run(Screw(**WRONG, heating=1e3, time=1.0), command, how) for how in (lengths, None))
    assert_array_equal(one, two)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"lead": 0.0}, "screw: lead = 0; allowed: above 0"),
        ({"time": -1.0}, "screw: time = -1; allowed: above 0"),
        ({"amplitude": 1e-3, "lead": 5e-3}, "screw: pitch error of 0 m/m and 0.001 m over a lead of 0.005 m; allowed"),
    ],
)
def test_what_cannot_be_is_refused(values, message):
    with pytest.raises(InputError, match=message):
        Screw(**values).check()
