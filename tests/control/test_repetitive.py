# SPDX-License-Identifier: Apache-2.0
"""The angle-domain P-integrator by itself: Q, interpolation, what it learns and when it refuses to go on."""

import numpy as np
import pytest
from cells import cuts, spans
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_machine.control.correction import Correction, CorrectionLaw
from lathe_machine.control.interpolation import cubic, cubic_response
from lathe_machine.control.lead import LeadLaw, Preview
from lathe_machine.control.q_filter import Exponential
from lathe_machine.control.repetitive import (
    LEARNING_DELAY,
    AngleLostError,
    RepetitiveController,
    largest_feedback_delay,
)
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


def turn(controller, angle, past, error, *, turning=SPEED, lengths=None):
    """The command for measured angles, the ones of ``DELAY`` samples earlier and their error; and the cycles."""
    command, cycles = np.empty(angle.size), []
    for start, stop in spans(lengths or [angle.size]):
        part = slice(start, stop)
        signals = {"angle": angle[part], "past_angle": past[part], "error": error[part], "command": command[part]}
        cycles += controller.block(start, speed=np.full(stop - start, turning), **signals)
    return command, cycles


def learn(error, revolutions, controller=None, *, turning=SPEED, lengths=None, delay=DELAY):
    """Turn at a steady speed past an error that is a function of the angle.

    Returns the angle, the command and the cycles.
    """
    angle = np.arange(int(revolutions * TURN / (turning * STEP))) * (turning * STEP)
    past, late = (np.concatenate((np.zeros(delay), signal))[: angle.size] for signal in (angle, error(angle)))
    return angle, *turn(controller or make(), angle, past, late, turning=turning, lengths=lengths)


def test_cycles_are_weighted_and_a_new_memory_has_none_before_it():
    """Errors that are constant over a cycle against the recursion; a frozen memory stays."""
    weights, errors = np.array([0.5, 0.3, 0.2]), np.array([1.0, -0.4, 0.7, 0.2, 0.9, -0.3])
    controller = make(weights=(5.0, 3.0, 2.0))
    angle = np.arange(int(6.2 * TURN / (SPEED * STEP))) * (SPEED * STEP)
    past = np.concatenate((np.zeros(DELAY), angle))[: angle.size]
    cycle = np.minimum(past // TURN, 5).astype(int)
    learned, wanted, inner = [], 0.0, slice(100, 900)

    def go(start, stop):
        part = slice(start, stop)
        given = {"angle": angle[part], "past_angle": past[part], "speed": np.full(stop - start, SPEED)}
        list(controller.block(start, **given, error=errors[cycle[part]], command=np.empty(stop - start)))

    start = 0
    for k in range(6):
        stop = int(np.searchsorted(past, (k + 0.95) * TURN))
        if k == 3:
            controller.clear()
            learned, wanted = [], 0.0
        controller.learning = k != 5
        go(start, stop)
        start = stop
        if k != 5:
            learned.insert(0, wanted + errors[k])
            known = weights[: len(learned[:3])]
            wanted = float(known @ learned[:3] / known.sum())
        assert_allclose(controller.memory()[inner], wanted, atol=1e-9, err_msg=str(k))


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


def test_q_smooths_what_is_kept_but_not_what_is_new():
    gain = exponential(0.05)(GRID).response(np.array([8 * TURN / GRID]))[0]
    controller = make(q=exponential(0.05), lead_time=0.0, gain=0.25)
    angle, command, _ = learn(lambda a: np.sin(8 * a), 3.9, controller)
    for cycle in (1, 2, 3):
        middle = (angle > (cycle + 0.4) * TURN) & (angle < (cycle + 0.6) * TURN)
        learned = 0.25 * sum(gain**k for k in range(cycle))
        assert_allclose(command[middle], learned * np.sin(8 * angle[middle]), atol=1e-5)


def test_cycle_may_be_several_revolutions():
    angle, command, cycles = learn(lambda a: np.sin(a / 2), 5.0, make(revolutions=2, lead_time=0.0))
    second = (angle > 2.1 * TURN) & (angle < 3.9 * TURN)
    assert_allclose(command[second], np.sin(angle[second] / 2), atol=1e-7)
    assert [cycle.number for cycle in cycles] == [1, 2]


@pytest.mark.parametrize("grid", [64, 1024, 65536])
def test_cycle_report_counts_every_grid_point_in_its_cycle(grid):
    """On the finest grid a sample passes sixteen points, and a cycle may end among them."""
    _, _, cycles = learn(lambda a: a, 3.5, make(grid=grid))
    points = np.arange(3 * grid).reshape(3, grid) * TURN / grid
    rms = np.sqrt((points**2).mean(axis=1))
    assert_allclose([cycle.rms for cycle in cycles], rms, rtol=1e-7)
    assert_allclose([cycle.contraction for cycle in cycles], [np.nan, *rms[1:] / rms[:-1]], rtol=1e-7)
    assert_allclose([cycle.largest for cycle in cycles], points[:, -1], rtol=1e-9)


def test_cycle_is_reported_at_the_sample_that_completes_it():
    _, _, cycles = learn(np.sin, 2.5)
    last_point = (GRID - 1) * TURN / GRID
    # The point lies between two samples; the later one must have two more after it.
    sample = int(np.ceil(last_point / (SPEED * STEP))) + DELAY + LEARNING_DELAY - 2
    assert cycles[0].sample_index == sample


@given(cuts, st.sampled_from(list(LeadLaw)), st.integers(1, 3), st.sampled_from([64, 100, 1024]), st.floats(0.0, 0.007))
def test_cuts_change_nothing(lengths, law, revolutions, grid, width):
    """Neither in the command nor in the memory, wherever its ring wraps."""
    lengths = [20 * n for n in lengths]
    total = (sum(lengths) + 0.5) * SPEED * STEP / TURN
    found = []
    for cut in (None, lengths):
        controller = make(lead_law=law, grid=grid, revolutions=revolutions, q=exponential(width))
        _, command, cycles = learn(np.sin, total, controller, lengths=cut)
        found.append((command.tobytes(), controller.memory().tobytes(), repr(cycles)))
    assert found[0] == found[1]
    assert controller.memory().size == grid * revolutions


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


@pytest.mark.parametrize(
    ("angle", "said"),
    [
        (np.array([0.0, 0.1, 0.2, 4.0, 4.1]), "sample 4: the spindle angle jumps to 4 rad"),
        # A spindle that turns back, before the memory is read where it is forgotten.
        (20.0 - np.abs(np.linspace(-20.0, 20.0, 24_000)), r"at 19\.\d+ rad the memory is no longer kept"),
    ],
)
def test_an_angle_that_cannot_be_is_named(angle, said):
    late = np.concatenate(([0.0], angle[:-1]))
    with pytest.raises(AngleLostError, match=said):
        turn(make(delay=1), angle, late, np.sin(late))


@given(
    at=st.integers(0, 24_000), by=st.sampled_from([0.01, 0.3, 5.0, 100.0]), delay=st.sampled_from([1, 100, 3000]),
    lengths=st.lists(st.integers(1, 9000), max_size=8),
)  # fmt: skip
def test_a_wrong_angle_is_lost_at_the_same_sample_whatever_the_blocks(at, by, delay, lengths):
    """Overwritten points of the memory are not read, so it does not matter how far learning has come in a block."""
    total = max(25_000, sum(lengths))
    angle = np.arange(total) * (SPEED * STEP)
    late = np.concatenate((np.zeros(delay), angle))[:total]
    wrong = angle + np.where(np.arange(total) >= at, by * np.sin(np.arange(total)), 0.0)

    def until_lost(lengths):
        controller, found = make(delay=delay), b""
        for start, stop in spans(lengths):
            part, command = slice(start, stop), np.empty(stop - start)
            signals = {"angle": wrong[part], "past_angle": late[part], "error": np.sin(late[part]), "command": command}
            try:
                list(controller.block(start, speed=np.full(stop - start, SPEED), **signals))
            except AngleLostError as lost:
                return found + command[: lost.reached].tobytes()
            found += command.tobytes()
        return found

    expected = until_lost([total])
    assert until_lost([*lengths, total - sum(lengths)]) == expected
    assert len(expected) < 8 * total or by < 1.0
