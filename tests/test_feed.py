# SPDX-License-Identifier: Apache-2.0
"""The feed drive: its models against their step responses, limits, backlash, sampling, sensor."""

import control
import numpy as np
import pytest
from cells import cuts, in_blocks
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from lathe_rc.control.limits import CommandLimits
from lathe_rc.errors import InputError
from lathe_rc.plants.feed import FeedDrive, follow
from lathe_rc.plants.feed_models import APPROXIMATE_LAGS, FULL_LAGS, dc_screw, fourth_order, sampled
from lathe_rc.transfer import LinearSystem, TransferFunction

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
    motion = np.full((5, command.size), np.nan)
    in_blocks(lengths or [command.size], machine.block, command, *motion)
    return motion


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


def test_speed_and_place_of_a_screw():
    """x = k·(t - T + T·e^{-t/T}), v = k·(1 - e^{-t/T})."""
    position, velocity, *_ = run(FeedDrive(MODELS["cross"], step=STEP), np.full(64_000, 0.5))
    time = np.arange(64_000) * STEP
    assert_allclose(velocity, -0.5 * 4.38e-3 * np.expm1(-time / 0.045), rtol=1e-9, atol=1e-18)
    assert_allclose(position, 0.5 * 4.38e-3 * (time + 0.045 * np.expm1(-time / 0.045)), rtol=1e-7, atol=1e-12)


def test_fourth_order_rests_at_its_gain_and_needs_falling_signs():
    position = run(FeedDrive(fourth_order(), step=COARSE), np.ones(60_000))[0]
    assert position[-1] == pytest.approx(19.0 / 21.5, rel=1e-6)
    # as printed, +a_i, it diverges
    printed = TransferFunction((19.0,), (1.0, -10.2, -46.9, -48.0, -21.5))
    assert np.abs(run(FeedDrive(printed, step=COARSE), np.ones(3000))[0]).max() > 1e6


@pytest.mark.parametrize(
    ("lags", "gain", "top", "bottom"),
    [
        (APPROXIMATE_LAGS, 11.79, [11.79], np.polymul([0.17, 1], [0.22, 1])),
        (
            FULL_LAGS,
            11.889,
            [11.889],
            np.polymul(np.polymul([0.11304, 1], [0.2679, 1]), np.polymul([0.01659, 1], [0.01659, 1])),
        ),
    ],
)
def test_zero_makes_room_for_the_lag_of_the_cut(lags, gain, top, bottom):
    """Speed of the longitudinal drive, through the cut's lag of 75 ms, is W1 of paper 004."""
    velocity = run(FeedDrive(dc_screw(gain, lags, 0.075), step=COARSE), np.ones(2000))[1]
    force = np.empty(2000)
    LinearSystem(TransferFunction((1.0,), (0.075, 1.0)), COARSE, "foh").block(velocity, force)
    expected = control.step_response(control.tf(top, bottom), np.arange(2000) * COARSE).outputs
    assert_allclose(force, expected, atol=1e-4 * gain)


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
    machine, clipped = FeedDrive(sampled(), step=COARSE, command_limit=1.5), FeedDrive(sampled(), step=COARSE)
    position, _, effort, *_ = run(machine, command)
    assert np.array_equal(effort, command.clip(-1.5, 1.5))
    assert np.array_equal(position, run(clipped, command.clip(-1.5, 1.5))[0])
    assert machine.saturated == np.count_nonzero(np.abs(command) > 1.5) > 0
    assert clipped.saturated == 0


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


def test_first_order_screw_leaves_its_limit_along_the_exponential():
    limit = 2e-3
    machine = FeedDrive(MODELS["cross"], step=STEP, speed_limit=limit)
    run(machine, np.full(30_000, 1.0))
    velocity = run(machine, np.zeros(6400))[1]
    # the command falls at the first sample; it acts from there on
    assert_allclose(velocity[1:] / velocity[1], np.exp(-np.arange(6399) * STEP / 0.045), rtol=1e-9)
    assert velocity[0] == limit


def test_limited_fourth_order_drive_comes_to_rest_where_the_free_one_does():
    limited, free = FeedDrive(fourth_order(), step=COARSE, speed_limit=0.1), FeedDrive(fourth_order(), step=COARSE)
    slow, quick = (run(machine, np.ones(60_000))[0] for machine in (limited, free))
    assert slow[-1] == pytest.approx(quick[-1], rel=1e-6)
    assert limited.limited > 1000
    assert free.limited == 0
    assert slow.max() <= quick.max()


# --- backlash, sensor


def behind(motor, half):
    """Places of a load behind a gap."""
    load, places = 0.0, []
    for place in motor:
        load = follow(load, half, place)
        places.append(load)
    return np.array(places)


MOVES = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=20)


def test_load_lags_by_half_the_gap_either_way():
    motor = np.concatenate((np.linspace(0.0, 1.0, 101), np.linspace(1.0, 0.0, 101)))
    load = behind(motor, 0.1)
    assert_allclose(load[:101], np.maximum(motor[:101] - 0.1, 0.0), atol=1e-15)
    assert_allclose(load[101:], np.minimum(motor[101:] + 0.1, 0.9), atol=1e-15)


@given(MOVES, st.floats(0.0, 0.5))
def test_load_stays_within_the_gap_and_stops_on_the_way_change_nothing(motor, half):
    assert np.all(np.abs(behind(motor, half) - motor) <= half * (1 + 1e-12) + 1e-15)
    fine = np.concatenate([np.linspace(a, b, 8)[1:] for a, b in zip([0.0, *motor[:-1]], motor, strict=True)])
    assert_allclose(behind(fine, half)[6::7], behind(motor, half), atol=1e-12)


@pytest.mark.parametrize("feedback", ["motor", "load"])
def test_load_follows_behind_the_gap(feedback):
    command = np.sin(np.arange(4000) / 300)
    machine = FeedDrive(sampled(), step=COARSE, backlash=0.2, feedback=feedback)
    position, velocity, _, motor, measured = run(machine, command)
    assert_allclose(motor, run(FeedDrive(sampled(), step=COARSE), command)[0])
    assert np.all(np.abs(position - motor) <= 0.1 + 1e-15)
    standing = np.diff(position) == 0.0
    assert 100 < standing.sum() < 3000
    assert not np.any(velocity[1:][standing])
    moving = ~standing[:-1]
    assert_allclose(velocity[1:-1][moving], np.gradient(motor, COARSE)[1:-1][moving], atol=1e-3)
    assert np.array_equal(measured, {"motor": motor, "load": position}[feedback])


def test_sensor_rounds_to_its_resolution():
    *_, motor, measured = run(FeedDrive(sampled(), step=COARSE, resolution=1e-3), np.ones(500))
    assert_allclose(measured / 1e-3, np.rint(measured / 1e-3), atol=1e-9)
    assert np.abs(measured - motor).max() <= 0.5e-3 * (1 + 1e-9)


# --- sampling


@given(cuts, st.integers(1, 50))
def test_command_is_taken_at_multiples_of_the_divisor(lengths, divisor):
    command = np.random.default_rng(1).normal(size=sum(lengths))
    slow = run(FeedDrive(sampled(), step=COARSE, divisor=divisor), command, lengths)
    held = command[np.arange(command.size) // divisor * divisor]
    assert np.array_equal(slow, run(FeedDrive(sampled(), step=COARSE), held))


@given(cuts, st.sampled_from(list(MODELS)), st.integers(1, 20))
def test_cuts_change_nothing(lengths, name, divisor):
    command = np.random.default_rng(2).normal(size=sum(lengths)).cumsum()
    options = {
        "divisor": divisor, "command_limit": 3.0, "speed_limit": 1e-3, "backlash": 1e-4, "resolution": 1e-6,
    }  # fmt: skip
    whole, cut = (FeedDrive(MODELS[name], step=STEP, **options) for _ in range(2))
    assert np.array_equal(run(cut, command, lengths), run(whole, command))
    assert (cut.saturated, cut.limited) == (whole.saturated, whole.limited)


# --- bad input


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dc_screw(1.0, (0.1, 0.0)), r"lags of the feed drive = \[0.1, 0.0\] s; allowed: above 0"),
        (lambda: FeedDrive(dc_screw(1.0, (0.1,), 0.05), step=STEP), "allowed: a numerator lower by two or more"),
        (lambda: FeedDrive(TransferFunction((1.0,), (1.0, 1.0)), step=STEP), "of degrees 0 over 1; allowed"),
        (lambda: FeedDrive(sampled(), step=STEP, divisor=0), "divisor = 0; allowed: above 0"),
        (lambda: FeedDrive(sampled(), step=STEP, command_limit=0.0), "command limit = 0; allowed: above 0"),
        (lambda: FeedDrive(sampled(), step=STEP, speed_limit=-1.0), "speed limit = -1; allowed: above 0"),
        (lambda: FeedDrive(sampled(), step=STEP, speed_limit=np.nan), "speed limit = nan; allowed: above 0"),
        (lambda: FeedDrive(sampled(), step=STEP, backlash=-1e-6), "backlash = -1e-06 m; allowed: 0 for none"),
        (lambda: FeedDrive(sampled(), step=STEP, resolution=np.inf), "resolution = inf m; allowed: 0 for none"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make, message):
    with pytest.raises(InputError, match=message) as refusal:
        make()
    assert len(str(refusal.value).splitlines()) == 1


# ---- limits of the motion that is commanded

LIMITS = CommandLimits(2e-3, 2e-3, 20e-3, 0.5)


def run_limited(model, command, limits, lengths=None, **options):
    """Position, velocity, effort, motor, measured; and which samples are clipped."""
    machine = FeedDrive(model, step=COARSE, limits=limits, **options)
    motion, clipped = np.full((5, command.size), np.nan), np.empty(command.size, np.uint8)

    def block(first, *parts):
        *parts, told = parts
        machine.block(first, *parts, clipped=told)

    in_blocks(lengths or [command.size], block, command, *motion, clipped)
    return motion, clipped


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
    time = np.arange(8000) * COARSE
    command = 0.02 * (1.0 - np.cos(time)) ** 2
    for free, found in zip(
        run(FeedDrive(MODELS[name], step=COARSE), command),
        run_limited(MODELS[name], command, CommandLimits(1.0, 1.0, 5.0, 50.0))[0],
        strict=True,
    ):
        assert_array_equal(free, found)


@given(lengths=cuts, divisor=st.sampled_from([1, 7]))
def test_the_cutting_of_a_limited_command_leaves_no_trace(lengths, divisor):
    command = np.where(np.arange(sum(lengths)) % 400 < 200, 0.8, -0.5)
    whole, parts = (run_limited(MODELS["cross"], command, LIMITS, cut, divisor=divisor) for cut in (None, lengths))
    assert_array_equal(whole[0], parts[0])
    assert_array_equal(whole[1], parts[1])


def test_a_command_for_an_acceleration_has_no_such_limits():
    twice = TransferFunction((1.0,), (1.0, 1.0, 0.0, 0.0))
    with pytest.raises(InputError, match="neither a position nor a speed"):
        FeedDrive(twice, step=COARSE, limits=LIMITS)
    FeedDrive(twice, step=COARSE)
