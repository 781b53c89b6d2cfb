# SPDX-License-Identifier: Apache-2.0
"""The feed drive: models against their step responses, limits, backlash, sampling, sensor, friction, screw."""

from functools import reduce

import control
import numpy as np
import pytest
from cells import cuts
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused, refusals
from machines import run as run_in_blocks
from numpy.testing import assert_allclose, assert_array_equal

from lathe_machine.control.limits import CommandLimits
from lathe_machine.plants.feed import FeedDrive
from lathe_machine.plants.feed_models import APPROXIMATE_LAGS, FULL_LAGS, dc_screw, fourth_order, sampled
from lathe_machine.plants.friction import Friction, mobility
from lathe_machine.plants.hysteresis import plays
from lathe_machine.plants.screw import Screw
from lathe_machine.transfer import LinearSystem, TransferFunction

STEP = 1 / 64000
COARSE = 1e-3
MODELS = {
    "fourth_order": fourth_order(),
    "cross": dc_screw(4.38e-3, (0.045,)),
    "approximate": dc_screw(1e-3, APPROXIMATE_LAGS),
    "approximate with a zero": dc_screw(1e-3, APPROXIMATE_LAGS, 0.075),
    "full": dc_screw(1e-3, FULL_LAGS),
    "sampled": sampled(),
}


def run(machine, command, lengths=None):
    """Position, velocity, effort, motor, measured."""
    return run_in_blocks(machine.block, 5, command, lengths=lengths)


def step_of(model, time):
    return control.step_response(control.tf(model.numerator, model.denominator), time).outputs


# --- the models


@pytest.mark.parametrize("step", [STEP, COARSE])
@pytest.mark.parametrize("name", MODELS)
def test_step_response_is_exact(name, step):
    model, samples = MODELS[name], 4000
    position, velocity, effort, motor, measured = run(FeedDrive(model, step=step), np.ones(samples))
    time = np.arange(samples) * step
    expected = step_of(model, time)
    assert_allclose(position, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())
    assert_allclose(np.diff(expected) / step, (velocity[1:] + velocity[:-1]) / 2, atol=1e-3 * np.abs(velocity).max())
    assert np.array_equal(position, motor)
    assert np.array_equal(position, measured)
    assert np.all(effort == 1.0)


@pytest.mark.parametrize(
    ("lags", "gain", "printed"),
    [(APPROXIMATE_LAGS, 11.79, (0.17, 0.22)), (FULL_LAGS, 11.889, (0.11304, 0.2679, 0.01659, 0.01659))],
)
def test_zero_makes_room_for_the_lag_of_the_cut(lags, gain, printed):
    """Speed of the longitudinal drive, through the cut's lag of 75 ms, is W1 of paper 004."""
    velocity = run(FeedDrive(dc_screw(gain, lags, 0.075), step=COARSE), np.ones(2000))[1]
    force = np.empty(2000)
    LinearSystem(TransferFunction((1.0,), (0.075, 1.0)), COARSE, "foh").block(velocity, force)
    w1 = TransferFunction((gain,), tuple(reduce(np.polymul, [(lag, 1.0) for lag in printed])))
    assert_allclose(force, step_of(w1, np.arange(2000) * COARSE), atol=1e-4 * gain)


def test_response_of_the_difference_equation():
    frequency = np.array([1.0, 10.0, 100.0])
    for model in MODELS.values():
        # the hold is half a step late
        expected = model.response(frequency) * np.exp(-0.5j * frequency * STEP)
        assert_allclose(FeedDrive(model, step=STEP).response(frequency), expected, rtol=1e-6)


@given(st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=30), st.floats(-1.0, 1.0))
def test_position_does_not_depend_on_the_command_of_its_sample(commands, other):
    """A loop without delay can be closed sample by sample."""
    changed = np.array(commands)
    changed[-1] = other
    for model in MODELS.values():
        one, two = (run(FeedDrive(model, step=COARSE), np.array(c)) for c in (commands, changed))
        assert np.array_equal(one[:2], two[:2])


# --- limits


def test_command_is_cut_off_and_counted():
    command = 2.0 * np.sin(np.arange(1000) / 50)
    machine = FeedDrive(sampled(), step=COARSE, command_limit=1.5)
    position, _, effort, *_ = run(machine, command)
    assert_array_equal(effort, command.clip(-1.5, 1.5))
    assert_array_equal(position, run(FeedDrive(sampled(), step=COARSE), effort)[0])
    assert machine.saturated == np.count_nonzero(np.abs(command) > 1.5) > 0


@given(st.sampled_from(list(MODELS)), st.lists(st.floats(-5.0, 5.0), min_size=1, max_size=6))
def test_speed_stays_within_its_limit(name, levels):
    free = np.abs(run(FeedDrive(MODELS[name], step=COARSE), np.ones(2000))[1]).max()
    limit = 0.6 * free
    machine = FeedDrive(MODELS[name], step=COARSE, speed_limit=limit)
    position, velocity, *_ = run(machine, np.repeat(levels, 200))
    assert np.abs(velocity).max() <= limit
    assert np.abs(np.diff(position)).max(initial=0.0) <= limit * COARSE * (1 + 1e-9)
    assert machine.limited >= np.count_nonzero(np.abs(velocity) == limit) - 1


@pytest.mark.parametrize("name", [n for n in MODELS if n != "fourth_order"])
def test_limited_speed_reaches_its_limit_and_does_not_wind_up(name):
    """After a command far beyond the limit, however long, the drive slows down as if it had never been there."""
    model = MODELS[name]
    limit = 0.5 * model.numerator[-1]

    def after(samples):
        machine = FeedDrive(model, step=COARSE, speed_limit=limit)
        pushed = run(machine, np.full(samples, 4.0))
        assert pushed[1][-1] == pytest.approx(limit, rel=1e-9)
        assert machine.limited > samples / 2
        position, velocity, *_ = run(machine, np.zeros(3000))
        return position - position[0], velocity

    short, long = after(2000), after(9000)
    assert_allclose(long[0], short[0], atol=1e-6 * limit)
    assert_allclose(long[1], short[1], atol=1e-6 * limit)
    # nothing left to unwind: it slows down from the first moment on, as it would from steady running
    assert np.all(np.diff(long[1]) <= 1e-9 * limit)
    steady = FeedDrive(model, step=COARSE)
    run(steady, np.full(9000, 0.5))
    position, velocity, *_ = run(steady, np.zeros(3000))
    assert_allclose(short[1], velocity, atol=2e-3 * limit)
    assert_allclose(short[0], position - position[0], atol=2e-3 * limit)


def test_limited_fourth_order_drive_comes_to_rest_where_the_free_one_does():
    limited, free = FeedDrive(fourth_order(), step=COARSE, speed_limit=0.1), FeedDrive(fourth_order(), step=COARSE)
    slow, quick = (run(machine, np.ones(60_000))[0] for machine in (limited, free))
    assert (slow[-1], quick[-1]) == pytest.approx((19.0 / 21.5, 19.0 / 21.5), rel=1e-6)
    assert limited.limited > 1000
    assert free.limited == 0
    assert slow.max() <= quick.max()


# --- backlash, sensor


@pytest.mark.parametrize("feedback", ["motor", "load"])
def test_load_follows_behind_the_gap_and_the_sensor_rounds(feedback):
    command = np.sin(np.arange(4000) / 300)
    machine = FeedDrive(sampled(), step=COARSE, backlash=0.2, feedback=feedback, resolution=1e-3)
    position, velocity, _, motor, measured = run(machine, command)
    assert_allclose(motor, run(FeedDrive(sampled(), step=COARSE), command)[0])
    assert_array_equal(position, plays(np.array([0.1]), np.zeros(1), motor)[:, 0])
    standing = np.diff(position) == 0.0
    assert 100 < standing.sum() < 3000
    assert not np.any(velocity[1:][standing])
    moving = ~standing[:-1]
    assert_allclose(velocity[1:-1][moving], np.gradient(motor, COARSE)[1:-1][moving], atol=1e-3)
    assert_allclose(measured, 1e-3 * np.rint({"motor": motor, "load": position}[feedback] / 1e-3))


# --- sampling


@given(cuts, st.integers(1, 50))
def test_command_is_taken_at_multiples_of_the_divisor(lengths, divisor):
    command = np.random.default_rng(1).normal(size=sum(lengths))
    slow = run(FeedDrive(sampled(), step=COARSE, divisor=divisor), command, lengths)
    held = command[np.arange(command.size) // divisor * divisor]
    assert np.array_equal(slow, run(FeedDrive(sampled(), step=COARSE), held))


# ---- limits of the motion that is commanded

LIMITS = CommandLimits(2e-3, 2e-3, 20e-3, 0.5)


def run_limited(model, command, limits, lengths=None, **options):
    """Position, velocity, effort, motor, measured; and which samples are clipped."""
    machine = FeedDrive(model, step=COARSE, limits=limits, **options)
    clipped = np.empty(command.size, np.uint8)

    def block(first, *parts):
        machine.block(first, *parts, clipped=clipped[first : first + parts[0].size])

    return run_in_blocks(block, 5, command, lengths=lengths), clipped


def peaks(signal, period):
    """Largest magnitude of a signal at rest at 0 before, and of its first three derivatives."""
    whole = np.concatenate((np.zeros(3), signal))
    return [np.abs(np.diff(whole, order)).max() / period**order for order in range(4)]


LEVELS = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=6)


@given(levels=LEVELS, divisor=st.sampled_from([1, 5, 20]), speed_limit=st.sampled_from([np.inf, 1.5e-3]))
def test_a_commanded_speed_keeps_within_its_limits_and_the_slide_within_its_stroke(levels, divisor, speed_limit):
    command = np.repeat(levels, 3000)
    motion, clipped = run_limited(
        MODELS["cross"], command, LIMITS, divisor=divisor, command_limit=1.0, speed_limit=speed_limit
    )
    position, _, effort, *_ = motion
    speed, acceleration, jerk, _ = peaks(4.38e-3 * effort[::divisor], COARSE * divisor)
    assert speed <= LIMITS.velocity * 1.001
    assert acceleration <= LIMITS.acceleration * 1.001
    assert jerk <= LIMITS.jerk * 1.001
    assert np.abs(position).max() <= LIMITS.stroke * (1 + 1e-9)
    held = command[np.arange(command.size) // divisor * divisor]
    assert_array_equal(clipped > 0, effort != held)


@given(levels=LEVELS, divisor=st.sampled_from([1, 5]))
def test_what_the_command_limit_alone_cuts_off_is_told(levels, divisor):
    command = np.repeat(levels, 100)
    lengths = [7] * (command.size // 7) + [command.size % 7]
    motion, cut = run_limited(MODELS["cross"], command, CommandLimits(), lengths, divisor=divisor, command_limit=0.5)
    held = command[np.arange(command.size) // divisor * divisor]
    assert_array_equal(motion[2], held.clip(-0.5, 0.5))
    assert_array_equal(cut > 0, np.abs(held) > 0.5)


def test_a_slide_is_stopped_at_its_stroke_and_comes_back():
    command = np.concatenate((np.ones(6000), -0.3 * np.ones(4000)))
    (position, *_), clipped = run_limited(MODELS["approximate with a zero"], command, CommandLimits(stroke=1e-3))
    assert_allclose(position[5999], 1e-3, rtol=1e-3)
    assert position[-1] < 0.8e-3
    assert not clipped[6000:].any()


def test_a_commanded_position_keeps_within_its_limits():
    limits, gain = CommandLimits(0.5, 0.4, 0.5, 2.0), 19.0 / 21.5
    command = np.repeat([0.9, -0.2, 0.3, 0.3], 5000)
    (_, _, effort, *_), clipped = run_limited(fourth_order(), command, limits)
    for found, limit in zip(peaks(gain * effort, COARSE), (0.5, 0.4, 0.5, 2.0), strict=True):
        assert found <= limit * 1.001
    assert_allclose(gain * effort[4999], 0.5, rtol=1e-6)
    assert_array_equal(effort[-4000:], command[-4000:])
    assert clipped[:5000].all()
    assert not clipped[-4000:].any()


@pytest.mark.parametrize("name", ["cross", "approximate with a zero", "fourth_order"])
def test_what_keeps_within_the_limits_goes_through_to_the_bit(name):
    command = 0.02 * (1.0 - np.cos(np.arange(8000) * COARSE)) ** 2
    free = run(FeedDrive(MODELS[name], step=COARSE), command)
    assert_array_equal(run_limited(MODELS[name], command, CommandLimits(1.0, 1.0, 5.0, 50.0))[0], free)


# --- friction: Stribeck curve, presliding, rest, reversals

GAIN, LAG, FORCE = 0.1, 0.045, 1000.0  # [m/s], [s], [N] at a command of 1
MASS = FORCE * LAG / GAIN
LAWS = pytest.mark.parametrize("law", ["stribeck", "lugre"])


def rubbing(law, lag=LAG, **values):
    default = {"coulomb": 200.0, "static": 300.0, "speed": 5e-3, "viscous": 150.0, "stiffness": 1e7, "damping": 1e4}
    return Friction(law, mobility(GAIN, lag, FORCE), **{**default, **values})


def rubbed(friction, lags=(LAG,), step=STEP, **options):
    return FeedDrive(dc_screw(GAIN, lags), step=step, friction=friction, **options)


@LAWS
@pytest.mark.parametrize("lags", [(LAG,), (5e-3, LAG)])
@pytest.mark.parametrize("command", [0.35, 0.6, -1.0])
def test_steady_force_is_the_stribeck_curve(law, lags, command):
    """The motor's force beyond that of its own equation, F1·(u - v/k), is Fc + (Fs - Fc)·e^… + Fv·v."""
    friction = rubbing(law)
    speed = run(rubbed(friction, lags), np.full(64_000, command))[1][-1]
    force = FORCE * (command - speed / GAIN)
    assert speed * command > 0.0
    assert force == pytest.approx(friction.steady(speed), rel=1e-6)


def test_presliding_is_a_spring_with_a_damper():
    """Far below Fs the slide is the mass F1·T/k on σ0 and σ1 + Fv + F1/k, and rests at F/σ0."""
    command = 1e-4
    position = run(rubbed(rubbing("lugre")), np.full(32_000, command))[0]
    spring = control.tf([FORCE * command], [MASS, FORCE / GAIN + 1e4 + 150.0, 1e7])
    expected = control.step_response(spring, np.arange(32_000) * STEP).outputs
    assert_allclose(position, expected, atol=4e-3 * expected.max())
    assert position[-1] == pytest.approx(FORCE * command / 1e7, rel=3e-3)


@pytest.mark.parametrize("lags", [(LAG,), (5e-3, LAG)])
def test_slide_rests_to_the_bit_below_fs_and_breaks_away_above(lags):
    position, velocity, *_ = run(rubbed(rubbing("stribeck"), lags), np.repeat([0.29, -0.29, 0.5], 6400))
    assert not position[:12_800].any()
    assert not velocity[:12_800].any()
    assert velocity[-1] > 0.01


@LAWS
def test_slide_stops_in_the_time_that_the_force_needs(law):
    """Coasting under Fc alone: v falls by (Fc + F1·v/k)/m and stays at 0; LuGre springs back by micrometres."""
    friction = rubbing(law, static=200.0, viscous=0.0, damping=3e4)
    command = np.repeat([1.0, 0.0], [64_000, 64_000])
    position, velocity, *_ = run(rubbed(friction), command)
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
    machine = rubbed(rubbing(law, coulomb=20.0, static=20.0, viscous=0.0, stiffness=1e8), step=step)
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


# --- the screw: pitch error, warming, who sees it

WRONG = {"slope": 20e-6, "lead": 5e-3, "amplitude": 3e-6, "phase": 0.7}


def turned(screw, command, **options):
    """Position, velocity, effort, motor, measured of a drive with a screw."""
    return run(FeedDrive(dc_screw(0.1, (0.045,)), step=COARSE, screw=screw, **options), command)


def test_pitch_error_is_that_of_the_place():
    position, velocity, _, motor, _ = turned(Screw(**WRONG), np.sin(np.arange(8000) / 900.0))
    wave = 3e-6 * (np.sin(2 * np.pi * motor / 5e-3 + 0.7) - np.sin(0.7))
    assert_allclose(position - motor, 20e-6 * motor + wave, atol=1e-15)
    assert_allclose(np.diff(position) / COARSE, (velocity[1:] + velocity[:-1]) / 2, atol=5e-4 * velocity.max())


def test_screw_warms_with_the_way_and_grows_from_its_bearing():
    """At a steady speed ΔT = (R·v + A)·(1 - e^{-t/T}); α·ΔT of the way from the bearing is added."""
    screw = Screw(heating=50.0, surroundings=-1.0, time=20.0, anchor=-0.2)
    position, velocity, _, motor, _ = turned(screw, np.full(40_000, 0.5))
    time = COARSE * np.arange(40_000)
    rise = (50.0 * 0.05 - 1.0) * -np.expm1(-time / 20.0)
    assert_allclose((position - motor)[1000:], (11.5e-6 * rise * (motor + 0.2))[1000:], atol=3e-8)
    assert_allclose((position - motor)[-1], 11.5e-6 * rise[-1] * (motor[-1] + 0.2), rtol=5e-3)
    assert_allclose(np.diff(position[1000:]) / COARSE, (velocity[1001:] + velocity[1000:-1]) / 2, rtol=1e-9)


@pytest.mark.parametrize(("feedback", "sees"), [("motor", 3), ("load", 0)])
def test_only_a_sensor_at_the_load_sees_it_and_backlash_comes_behind(feedback, sees):
    command = np.sin(np.arange(8000) / 900.0)
    motion = turned(Screw(**WRONG), command, feedback=feedback)
    assert_array_equal(motion[4], motion[sees])
    loose = turned(Screw(**WRONG), command, backlash=40e-6)[0]
    assert np.ptp(motion[0] - loose) == pytest.approx(40e-6)
    assert_array_equal(motion[3], turned(Screw(), command)[3])


# --- blocks, bad input


@given(cuts, st.sampled_from(list(MODELS)), st.integers(1, 20))
def test_cuts_change_nothing(lengths, name, divisor):
    command = np.random.default_rng(2).normal(size=sum(lengths)).cumsum()
    options = {
        "divisor": divisor, "command_limit": 3.0, "speed_limit": 1e-3, "backlash": 1e-4, "resolution": 1e-6,
    }  # fmt: skip
    whole, cut = (FeedDrive(MODELS[name], step=STEP, **options) for _ in range(2))
    assert_array_equal(run(cut, command, lengths), run(whole, command))
    assert (cut.saturated, cut.limited) == (whole.saturated, whole.limited)


@pytest.mark.parametrize(
    "options",
    [
        {"limits": LIMITS, "divisor": 7},
        {"friction": rubbing("stribeck")},
        {"friction": rubbing("lugre")},
        {"screw": Screw(**WRONG, heating=1e3, time=1.0)},
    ],
    ids=["limits", "stribeck", "lugre", "screw"],
)
@given(lengths=cuts)
def test_cuts_change_nothing_of_limits_friction_and_screw(options, lengths):
    command = np.sin(np.arange(sum(lengths)) / 40.0)
    limits = {"limits": CommandLimits(), **options}
    whole, cut = (run_limited(dc_screw(GAIN, (LAG,)), command, lengths=how, **limits) for how in (None, lengths))
    assert_array_equal(whole[0], cut[0])
    assert_array_equal(whole[1], cut[1])


DOUBLE_INTEGRATOR = TransferFunction((1.0,), (1.0, 1.0, 0.0, 0.0))


def made_of(model=MODELS["sampled"], **options):
    return lambda: FeedDrive(model, step=STEP, **options)


def test_a_command_for_an_acceleration_is_allowed_without_limits():
    made_of(DOUBLE_INTEGRATOR)()


@refusals(
    (lambda: dc_screw(1.0, (0.1, 0.0)), r"lags of the feed drive = \[0.1, 0.0\] s; allowed: above 0"),
    (made_of(dc_screw(1.0, (0.1,), 0.05)), "allowed: a numerator lower by two or more"),
    (made_of(TransferFunction((1.0,), (1.0, 1.0))), "of degrees 0 over 1; allowed"),
    (made_of(divisor=0), "divisor = 0; allowed: above 0"),
    (made_of(command_limit=0.0), "command limit = 0; allowed: above 0"),
    (made_of(speed_limit=np.nan), "speed limit = nan; allowed: above 0"),
    (made_of(backlash=-1e-6), "backlash = -1e-06 m; allowed: 0 for none"),
    (made_of(resolution=np.inf), "resolution = inf m; allowed: 0 for none"),
    (made_of(DOUBLE_INTEGRATOR, limits=LIMITS), "neither a position nor a speed"),
    (lambda: rubbing("lugre", static=100.0), "friction: 100 N at rest and 200 N in motion; allowed: no less"),
    (lambda: rubbing("lugre", coulomb=0.0), "friction: force = 0; allowed: above 0"),
    (lambda: rubbing("lugre", damping=-1.0), "friction: damping = -1; allowed: 0 or more"),
    (made_of(friction=rubbing("lugre", lag=0.1)), "friction with a mobility .*; allowed: one whose poles the drive"),
    (made_of(dc_screw(GAIN, (LAG, 0.01)), friction=rubbing("lugre"), speed_limit=0.1), "speed limit = 0.1 m/s with "),
    (Screw(lead=0.0).check, "screw: lead = 0; allowed: above 0"),
    (Screw(time=-1.0).check, "screw: time = -1; allowed: above 0"),
    (Screw(amplitude=1e-3, lead=5e-3).check, "screw: pitch error of 0 m/m and 0.001 m over a lead of 0.005 m; allowed"),
)
def test_what_cannot_be_is_refused_in_one_line(make, message):
    assert_refused(make, message)
