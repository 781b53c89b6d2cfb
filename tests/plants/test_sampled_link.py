# SPDX-License-Identifier: Apache-2.0
"""The corrective link: the drive in z, the laws, and the link in blocks before the feed drive."""

import numpy as np
import pytest
from cells import cuts, in_blocks
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused
from numpy.testing import assert_allclose
from scipy.signal import cont2discrete, lfilter

from lathe_machine.control.sampled_link import (
    SampledDrive,
    SampledLink,
    closed_loop,
    design,
    paper,
    ripple_free,
    towards,
)
from lathe_machine.plants.feed import FeedDrive
from lathe_machine.plants.feed_models import sampled

DRIVE = SampledDrive(6.25, 0.08, 0.16)
STEP = 1 / 64000

drives = st.builds(SampledDrive, st.floats(0.5, 50.0), st.floats(0.01, 0.5), st.floats(0.02, 0.3))


def make(law="ripple_free", **changes):
    return SampledLink(law, **{"gain": 6.25, "lag": 0.08, "step": 1e-3, "divisor": 160, **changes})


def command_of(link, set_point, measurement=None, lengths=None):
    measurement = np.zeros_like(set_point) if measurement is None else measurement
    command = np.full(set_point.size, np.nan)
    in_blocks(lengths or [set_point.size], link.block, set_point, measurement, command)
    return command


# --- the drive in z


def test_drive_of_the_paper():
    """Spec: b1 = .5677, b0 = .2970, d = .1353; the printed .325·(1.88z + 1) has 9 % too much gain."""
    assert_allclose([DRIVE.b1, DRIVE.b0, DRIVE.d], [0.5677, 0.2970, 0.1353], atol=5e-5)
    assert pytest.approx(0.09, abs=0.01) == 0.325 / DRIVE.b0 - 1


@given(drives)
def test_drive_in_z_is_that_of_the_hold(drive):
    top, bottom, _ = cont2discrete(([drive.gain], [drive.lag, 1.0, 0.0]), drive.period)
    assert_allclose(drive.numerator, top[0][1:], rtol=1e-7)
    assert_allclose(drive.denominator, bottom, rtol=1e-9)
    assert_allclose(drive.late(0.0), [drive.b1, drive.b0, 0.0], atol=1e-12 * drive.b1)


@given(drives, st.integers(0, 50))
def test_late_drive_is_what_is_seen_of_it(drive, late):
    """Step response of B(z)/(z·(z-1)·(z-d)) against the motion some 50ths of a period ago."""
    steps = 50
    motion = np.empty((5, 12 * steps))
    FeedDrive(sampled(drive.gain, drive.lag), step=drive.period / steps).block(0, np.ones(12 * steps), *motion)
    seen = np.concatenate((np.zeros(late), motion[0]))[: 12 * steps : steps]
    top = drive.late(late / steps * drive.period)
    expected = lfilter(np.concatenate(([0.0], top)), np.append(drive.denominator, 0.0), np.ones(12))
    assert_allclose(seen, expected, rtol=1e-9, atol=1e-9 * expected[-1])


# --- the laws


@given(drives, st.floats(0.0, 2.0))
def test_link_makes_the_desired_function(drive, ratio):
    link, z = towards(drive, ratio), np.exp(1j * np.linspace(0.1, 3.0, 20))
    loop = np.polyval(link.numerator, z) / np.polyval(link.denominator, z)
    loop = loop * np.polyval(drive.numerator, z) / np.polyval(drive.denominator, z)
    half, s = drive.period / 2, 2 / drive.period * (z - 1) / (z + 1)
    desired = drive.gain * (1 - half * s) * (1 + ratio * half * s) / (s * (1 + half * s))
    assert_allclose(loop, desired, rtol=1e-7)


def test_laws_are_those_of_the_spec():
    whole = DRIVE.b1 + DRIVE.b0
    one = paper(DRIVE)
    assert_allclose(one.numerator, np.array([1.0, -DRIVE.d]) / DRIVE.b1)  # K·T = 1
    assert_allclose(one.denominator, [1.0, DRIVE.b0 / DRIVE.b1])
    assert_allclose(towards(DRIVE, 1.0).numerator, [*one.numerator, 0.0], atol=1e-15)
    other = ripple_free(DRIVE)
    assert_allclose(other.numerator, np.array([1.0, -DRIVE.d]) / whole)
    assert_allclose(other.denominator, [1.0, DRIVE.b0 / whole])


@given(drives, st.floats(0.0, 1.0))
def test_ripple_free_loop_ends_after_its_periods(drive, part):
    """All poles at 0, but d, which the link cancels; the command for a step ends after two periods."""
    delay = part * drive.period
    link = ripple_free(drive, delay)
    found = closed_loop(drive, link, delay)
    order = found.size - 1
    assert_allclose(found, np.concatenate(([1.0, -drive.d], np.zeros(order - 1))), atol=1e-9)


def test_delay_goes_to_none():
    """Numerator and denominator have then a common root at 0."""
    with_delay, without = ripple_free(DRIVE, 1e-12), ripple_free(DRIVE)
    assert_allclose(with_delay.numerator, [*without.numerator, 0.0], atol=1e-9)
    assert_allclose(with_delay.denominator, [*without.denominator, 0.0], atol=1e-9)


# --- in blocks


def test_command_for_a_step_without_an_answer():
    """By hand: u[n] = (e[n] - d·e[n-1])/(b1 + b0) - b0/(b1 + b0)·u[n-1], held for 160 samples."""
    command = command_of(make(), np.ones(480))
    whole, past = DRIVE.b1 + DRIVE.b0, []
    for n in range(3):
        past.append((1.0 - DRIVE.d * (n > 0)) / whole - (DRIVE.b0 / whole * past[-1] if past else 0.0))
    assert_allclose(command, np.repeat(past, 160))


def test_only_samples_that_are_multiples_matter():
    random = np.random.default_rng(3)
    set_point, measurement = random.normal(size=(2, 1000))
    used = np.arange(1000) // 160 * 160
    assert np.array_equal(
        command_of(make(), set_point, measurement), command_of(make(), set_point[used], measurement[used])
    )


@given(cuts, st.integers(1, 200), st.sampled_from(["paper", "ripple_free"]), st.floats(0.0, 1.0))
def test_cuts_change_nothing(lengths, divisor, law, part):
    set_point, measurement = np.random.default_rng(4).normal(size=(2, sum(lengths)))
    whole, cut = (
        (make(law, divisor=divisor, limit=2.0, delay=part * divisor * 1e-3) for _ in range(2))
        if law == "ripple_free"
        else (make(law, divisor=divisor, limit=2.0) for _ in range(2))
    )
    assert np.array_equal(command_of(cut, set_point, measurement, lengths), command_of(whole, set_point, measurement))
    assert cut.saturated == whole.saturated


def servo(link, machine, set_point, delay=0):
    """Both in turns, a period at a time, as nodes of a cell; the measurement is seen ``delay`` samples late.

    Returns:
        Position of the slide and command.
    """
    measured = np.zeros(delay + set_point.size)
    motion, command = np.zeros((5, set_point.size)), np.zeros(set_point.size)
    # A block may be as long as the measurement is late: what it needs is then there before it begins.
    for k in range(0, set_point.size, delay):
        block = slice(k, k + delay)
        link.block(k, set_point[block], measured[block], command[block])
        machine.block(k, command[block], *motion[:, block])
        measured[k + delay : k + 2 * delay] = motion[4, block]
    return motion[0], command


@pytest.mark.parametrize("period", [1280, 5120, 10240])
@pytest.mark.parametrize("backlash", [0.0, 0.1])
def test_servo_that_knows_of_the_delay_of_its_cell(period, backlash):
    """The cell's default: 64 samples, 1 ms, at 64 kHz; periods of 20, 80 and 160 ms."""
    options = {"step": STEP, "divisor": period}
    set_point = np.ones(12 * period)
    known = SampledLink("ripple_free", gain=6.25, lag=0.08, delay=64 * STEP, **options)
    machine = FeedDrive(sampled(), step=STEP, backlash=backlash)
    position, command = servo(known, machine, set_point, 64)
    assert np.all(np.diff(position) >= -1e-12)
    assert position[-1] == pytest.approx(1.0, abs=1e-9)
    assert position.max() <= 1.0 + 1e-9
    assert np.abs(command).max() == pytest.approx(1.0 / (known.drive.b1 + known.drive.b0))
    unaware = SampledLink("ripple_free", gain=6.25, lag=0.08, **options)
    assert servo(unaware, FeedDrive(sampled(), step=STEP), set_point, 64)[0].max() > 1.003


def test_link_remembers_the_command_that_it_gave():
    """By hand: 1/(b1 + b0) = 1.157 is cut to 0.5, and 0.5 is what the next command starts from."""
    link = make(limit=0.5)
    command = command_of(link, np.ones(320))
    whole = DRIVE.b1 + DRIVE.b0
    assert command[0] == 0.5
    assert link.saturated == 2
    other = make(limit=0.5)
    command = command_of(other, np.repeat([1.0, 0.5], 160))
    assert command[160] == pytest.approx((0.5 - DRIVE.d) / whole - DRIVE.b0 / whole * 0.5)
    assert other.saturated == 1


def test_servo_with_a_limited_command_arrives():
    """A peak of 36 at T = 20 ms is cut off; the slide still arrives, and without much overshoot."""
    link = SampledLink("ripple_free", gain=6.25, lag=0.08, step=STEP, divisor=1280, delay=64 * STEP, limit=2.0)
    position, command = servo(link, FeedDrive(sampled(), step=STEP), np.ones(100 * 1280), 64)
    assert np.abs(command).max() == 2.0
    assert 3 < link.saturated < 30
    assert position[-1] == pytest.approx(1.0, abs=1e-6)
    assert position.max() < 1.5


# --- bad input


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"law": "paper", "divisor": 320}, r": paper with K = 6.25 1/s, .* T = 0.32 s is unstable .* or ripple_free"),
        ({"gain": 0.0}, "K = 0 1/s; allowed: above 0"),
        ({"lag": np.nan}, "T1 = nan s; allowed: above 0"),
        ({"step": np.inf}, "T = inf s; allowed: above 0"),
        ({"delay": 0.2}, "delay = 0.2 s; allowed: from 0 to the period, 0.16 s"),
        ({"delay": -1e-3}, "delay = -0.001 s; allowed: from 0"),
        ({"law": "paper", "delay": 0.2}, "delay = 0.2 s; allowed: from 0"),
        ({"divisor": 0}, "divisor = 0; allowed: from 1"),
        ({"limit": 0.0}, "limit = 0; allowed: above 0"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(changes, message):
    assert_refused(lambda: make(**changes), message)


def test_design_by_name():
    assert design("paper", DRIVE, 0.01) == paper(DRIVE)
    assert design("ripple_free", DRIVE, 0.01) == ripple_free(DRIVE, 0.01)
