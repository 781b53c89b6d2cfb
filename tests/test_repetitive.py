# SPDX-License-Identifier: Apache-2.0
"""The angle-domain P-integrator by itself: Q, interpolation, what it learns and when it refuses to go on."""

import numpy as np
import pytest
from cells import cuts, spans
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_rc.control.correction import Correction, CorrectionLaw
from lathe_rc.control.interpolation import cubic, cubic_response
from lathe_rc.control.lead import LeadLaw, Preview
from lathe_rc.control.q_filter import Exponential
from lathe_rc.control.repetitive import LEARNING_DELAY, AngleLostError, RepetitiveController, largest_feedback_delay
from lathe_rc.errors import LatheError
from lathe_rc.signals import speed

TURN = 2 * np.pi
GRID = 1024
STEP = 1 / 64000
SPEED = 100.0
LEAD = 1.425e-3
DELAY = 100


NO_CORRECTION = Correction(CorrectionLaw.NONE, 1038.0, 0.804)


def make(*, lead_law=LeadLaw.VARIABLE, lead_time=LEAD, speed_law=None, window=1, constant=0.0, q=None, **changes):
    """A controller; ``q`` is a filter, made for its cycle, or None for Q = 1."""
    settings = {
        "grid": GRID,
        "revolutions": 1,
        "gain": 1.0,
        "soft_start": 0.0,
        "preview": Preview(lead_law, lead_time, speed_law or speed.constant(SPEED), STEP, window, constant),
        "correction": NO_CORRECTION,
        "nominal": SPEED,
        "delay": DELAY,
        "join_below": np.inf,
        "step": STEP,
    } | changes
    cycle = settings["grid"] * settings["revolutions"]
    return RepetitiveController(**settings, q=q(cycle) if q else Exponential(0.0, cycle))


def exponential(width):
    """Maker of an exponential Q with an angle constant [rad] on the grid of the tests."""
    return lambda cycle: Exponential(width * GRID / TURN, cycle)


def learn(error, revolutions, controller=None, *, turning=SPEED, lengths=None, delay=DELAY):
    """Turn at a steady speed past an error that is a function of the angle.

    Returns the angle, the command and the cycles.
    """
    controller = controller or make()
    samples = int(revolutions * TURN / (turning * STEP))
    angle = np.arange(samples) * (turning * STEP)
    past = np.concatenate((np.zeros(delay), angle))[:samples]
    late = np.concatenate((np.zeros(delay), error(angle)))[:samples]
    command, cycles = np.empty(samples), []
    for start, stop in spans(lengths or [samples]):
        cycles += controller.block(
            start,
            angle=angle[start:stop],
            speed=np.full(stop - start, turning),
            past_angle=past[start:stop],
            error=late[start:stop],
            command=command[start:stop],
        )
    return angle, command, cycles


# --- the interpolators


@given(st.lists(st.floats(-10, 10), min_size=4, max_size=4), st.floats(0.0, 1.0))
def test_interpolation_is_exact_for_cubics(coefficients, u):
    points = np.polyval(coefficients, np.array([-1.0, 0.0, 1.0, 2.0]))
    assert cubic(*points, u) == pytest.approx(np.polyval(coefficients, u), abs=1e-10)


def test_response_of_the_interpolator_is_its_mean_over_the_place():
    radians, places = 0.7, np.linspace(0.0, 1.0, 1001)
    wave = np.exp(1j * radians * np.arange(-1, 3))
    gains = [cubic(*wave.real, u) * np.exp(-1j * radians * u) for u in places]
    gains += [1j * cubic(*wave.imag, u) * np.exp(-1j * radians * u) for u in places]
    mean = np.trapezoid(gains[:1001], places) + np.trapezoid(gains[1001:], places)
    assert_allclose(cubic_response(np.array([radians])), mean, atol=1e-6)


# --- learning


def within(read):
    """Where the memory is read away from its step between two cycles, which the interpolation smooths."""
    return np.abs(np.mod(read + np.pi, TURN) - np.pi) > 4 * TURN / GRID


@pytest.mark.parametrize("turning", [60.0, 100.0, 140.0])
@pytest.mark.parametrize("law", list(LeadLaw))
def test_error_is_added_once_a_cycle_and_read_ahead_by_the_lead(law, turning):
    angle, command, _ = learn(lambda a: np.sin(3 * a + 0.4), 4.0, make(lead_law=law), turning=turning)
    # The known law of exact preview is the nominal speed.
    lead = LEAD * (turning if law in (LeadLaw.VARIABLE, LeadLaw.VARIABLE_SECOND_ORDER) else SPEED)
    read = angle + lead
    expected = np.floor(read / TURN) * np.sin(3 * read + 0.4)
    assert_allclose(command[within(read)], expected[within(read)], atol=3e-7)


def test_gain_scales_what_is_learned():
    angle, command, _ = learn(np.cos, 2.5, make(gain=0.25, lead_time=0.0))
    expected = np.floor(angle / TURN) * 0.25 * np.cos(angle)
    assert_allclose(command[within(angle)], expected[within(angle)], atol=1e-8)


def test_q_smooths_what_is_kept_but_not_what_is_new():
    gain = exponential(0.05)(GRID).response(np.array([8 * TURN / GRID]))[0]
    controller = make(q=exponential(0.05), lead_time=0.0)
    angle, command, _ = learn(lambda a: np.sin(8 * a), 3.9, controller)
    for cycle in (1, 2, 3):
        middle = (angle > (cycle + 0.4) * TURN) & (angle < (cycle + 0.6) * TURN)
        learned = sum(gain**k for k in range(cycle))
        assert_allclose(command[middle], learned * np.sin(8 * angle[middle]), atol=1e-5)


def test_cycle_may_be_several_revolutions():
    angle, command, cycles = learn(lambda a: np.sin(a / 2), 5.0, make(revolutions=2, lead_time=0.0))
    second = (angle > 2.1 * TURN) & (angle < 3.9 * TURN)
    assert_allclose(command[second], np.sin(angle[second] / 2), atol=1e-7)
    assert [cycle.number for cycle in cycles] == [1, 2]


def test_cycle_report_is_of_the_error_over_the_angle():
    _, _, cycles = learn(lambda a: np.where(a < TURN, 3.0, 1.5) * np.sin(5 * a), 3.5)
    rms = np.array([3.0, 1.5, 1.5]) / np.sqrt(2)
    assert_allclose([cycle.rms for cycle in cycles], rms, rtol=1e-5)
    assert_allclose([cycle.largest for cycle in cycles], [3.0, 1.5, 1.5], rtol=1e-4)
    assert_allclose([cycle.contraction for cycle in cycles], [np.nan, 0.5, 1.0], rtol=1e-5)


@pytest.mark.parametrize("grid", [64, 1024, 65536])
def test_cycle_report_counts_every_grid_point_in_its_cycle(grid):
    """On the finest grid a sample passes sixteen points, and a cycle may end among them."""
    _, _, cycles = learn(lambda a: a, 3.5, make(grid=grid))
    points = np.arange(3 * grid).reshape(3, grid) * TURN / grid
    assert_allclose([cycle.rms for cycle in cycles], np.sqrt((points**2).mean(axis=1)), rtol=1e-7)
    assert_allclose([cycle.largest for cycle in cycles], points[:, -1], rtol=1e-9)


def test_cycle_is_reported_at_the_sample_that_completes_it():
    _, _, cycles = learn(np.sin, 2.5)
    last_point = (GRID - 1) * TURN / GRID
    # The point lies between two samples; the later one must have two more after it.
    sample = int(np.ceil(last_point / (SPEED * STEP))) + DELAY + LEARNING_DELAY - 2
    assert cycles[0].sample_index == sample


@given(cuts, st.sampled_from(list(LeadLaw)))
def test_cuts_change_nothing(lengths, law):
    lengths = [20 * n for n in lengths]
    revolutions = (sum(lengths) + 0.5) * SPEED * STEP / TURN
    q = exponential(0.0067)
    _, whole, cycles = learn(np.sin, revolutions, make(lead_law=law, q=q))
    _, parts, cycles_of_parts = learn(np.sin, revolutions, make(lead_law=law, q=q), lengths=lengths)
    assert np.array_equal(whole, parts)
    assert [cycle.sample_index for cycle in cycles] == [cycle.sample_index for cycle in cycles_of_parts]


# --- refusals


@given(st.floats(20.0, 300.0), st.sampled_from([64, 1024, 4096]), st.integers(1, 2))
def test_largest_delay_runs_and_a_longer_one_does_not(turning, grid, revolutions):
    memory = {"grid": grid, "revolutions": revolutions}

    def turn(delay):
        learn(np.sin, 2.5 * revolutions, make(**memory, delay=delay), turning=turning, delay=delay)

    delay = largest_feedback_delay(**memory, lead=LEAD * turning, speed=turning, late=0.0, looks_ahead=2, step=STEP)
    turn(delay)
    with pytest.raises(LatheError, match="rad before it is learned"):
        turn(delay + LEARNING_DELAY + int(np.ceil(2 * TURN / grid / (turning * STEP))))


def test_jump_of_the_angle_is_named():
    controller = make(delay=1)
    angle = np.array([0.0, 0.1, 0.2, 4.0, 4.1])
    late = np.concatenate(([0.0], angle[:-1]))
    with pytest.raises(LatheError, match="sample 4: the spindle angle jumps to 4 rad"):
        list(
            controller.block(0, angle=angle, speed=np.ones(5), past_angle=late, error=np.zeros(5), command=np.empty(5))
        )


def wrong(at, by, lengths, delay):
    """The command until the angle is lost, and the sample; from sample ``at`` on the angle is wrong by up to ``by``."""
    controller, samples = make(delay=delay), sum(lengths)
    angle = np.arange(samples) * (SPEED * STEP)
    late = np.concatenate((np.zeros(delay), angle))[:samples]
    measured = angle + np.where(np.arange(samples) >= at, by * np.sin(np.arange(samples)), 0.0)
    command, speeds, error = np.empty(samples), np.full(samples, SPEED), np.sin(late)
    for start, stop in spans(lengths):
        part = slice(start, stop)
        try:
            list(
                controller.block(
                    start, angle=measured[part], speed=speeds[part], past_angle=late[part], error=error[part],
                    command=command[part],
                )
            )  # fmt: skip
        except AngleLostError as lost:
            return command[: start + lost.reached].tobytes(), start + lost.reached
    return command.tobytes(), samples


@given(
    at=st.integers(0, 24_000), by=st.sampled_from([0.01, 0.3, 5.0, 100.0]), delay=st.sampled_from([1, 100, 3000]),
    lengths=st.lists(st.integers(1, 9000), max_size=8),
)  # fmt: skip
def test_a_wrong_angle_is_lost_at_the_same_sample_whatever_the_blocks(at, by, delay, lengths):
    """Overwritten points of the memory are not read, so it does not matter how far learning has come in a block."""
    total = max(25_000, sum(lengths))
    expected = wrong(at, by, [total], delay)
    assert wrong(at, by, [*lengths, total - sum(lengths)], delay) == expected
    assert expected[1] < total or by < 1.0


def test_a_spindle_that_turns_back_is_named_before_the_memory_is_read_where_it_is_forgotten():
    controller, angle = make(delay=1), np.concatenate((np.linspace(0.0, 20.0, 12_000), np.linspace(20.0, 0.0, 12_000)))
    late = np.concatenate(([0.0], angle[:-1]))
    with pytest.raises(AngleLostError, match=r"at 19\.\d+ rad the memory is no longer kept"):
        list(
            controller.block(
                0, angle=angle, speed=np.full(angle.size, SPEED), past_angle=late, error=np.sin(late),
                command=np.empty(angle.size),
            )
        )  # fmt: skip


@pytest.mark.parametrize("delay", [1, 60, 700])
def test_a_block_longer_than_the_delay_is_taken_in_pieces_of_it(delay):
    """Else the memory would be written over before it is read."""
    _, whole, _ = learn(np.sin, 6.0, make(delay=delay), delay=delay)
    lengths = [delay] * (whole.size // delay) + [whole.size % delay]
    _, pieces, _ = learn(np.sin, 6.0, make(delay=delay), delay=delay, lengths=lengths)
    assert whole.tobytes() == pieces.tobytes()
