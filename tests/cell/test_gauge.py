# SPDX-License-Identifier: Apache-2.0
"""The gauge: its readings, the correction that it learns, and laws that learn from it."""

import numpy as np
import pytest
from cells import config, form_error, of_nodes
from machines import assert_refused, run
from numpy.testing import assert_allclose, assert_array_equal

from lathe_machine.stages.tool.gauge import Gauge, GaugeParameters
from lathe_rc import harness, messages
from lathe_rc.cell.wiring import Cell

TURN = 2 * np.pi
DELAY = 64
SAMPLES = 3840  # per revolution at 1000 rpm
STATE = tuple(messages.allocate(messages.STATE, 1))


def stage(**values):
    return Gauge("gauge", GaugeParameters.read("gauge", values))


def advance(made, error, lengths=None, measured=None):
    """Outputs of the gauge at a steady speed, for the form error ``error(angle)`` [m] and a drive's sensor."""
    angle = np.arange(6 * SAMPLES if lengths is None else sum(lengths)) * (TURN / SAMPLES)
    late = np.concatenate((np.zeros(DELAY), angle[:-DELAY])) if angle.size > DELAY else np.zeros(angle.size)
    cut = np.where(np.arange(angle.size) >= DELAY, error(late), 0.0)
    sensor = np.zeros(angle.size) if measured is None else measured

    def block(first, *parts):
        turns = {"angle": parts[0], "angle_true": parts[0]}
        state = dict.fromkeys(STATE, parts[3])
        inputs = [turns, {"angle_true": parts[1]}, {"error": parts[2]}, state]
        rows = parts[4:]
        made.advance(first, inputs, [dict(zip(STATE, rows[:4], strict=True)), dict(zip(STATE, rows[4:], strict=True))])

    found = run(block, 8, angle, late, cut, sensor, lengths=lengths)
    return angle, dict(zip(STATE, found[:4], strict=True)), dict(zip(STATE, found[4:], strict=True))


def lobes(angle):
    return 1e-6 * np.sin(3 * angle) + 10e-6 * np.floor(angle / TURN)


# --- readings


@pytest.mark.parametrize(("late", "offset"), [(1, 0.0), (3, 0.0), (1, 0.2), (2, -0.2)])
def test_a_reading_is_the_error_of_the_place_that_was_cut_so_many_revolutions_ago(late, offset):
    angle, _, reading = advance(stage(revolutions_late=late, angle_offset=offset, gain=1e-3), lobes)
    there = reading["effort"] == 1.0
    assert_array_equal(there, angle + offset >= late * TURN - 1e-9)
    inside = there & (np.abs(np.sin((angle + offset) / 2)) > 0.01)  # the step between revolutions is not interpolated
    assert_allclose(reading["position"][inside], lobes(angle + offset - late * TURN)[inside], atol=1e-11)
    assert_array_equal(reading["measured_position"], reading["position"])


def test_noise_resolution_dropouts_and_keyways_are_in_the_reading():
    """Noise has its RMS, drop-outs their rate and length; a keyway and a drop-out give no reading, which is 0."""
    made = stage(
        noise_rms=0.3e-6, resolution=10e-9, dropouts_per_revolution=2.0, dropout_angle=0.05, gap_start=[1.0],
        gap_width=[0.5], gain=1e-3,
    )  # fmt: skip
    angle, _, reading = advance(made, lobes, [SAMPLES] * 100)
    there, turned = reading["effort"] == 1.0, angle >= TURN
    value = reading["measured_position"]
    assert (value - reading["position"])[there].std() == pytest.approx(0.3e-6, rel=0.01)
    assert_allclose(value / 10e-9, np.rint(value / 10e-9), atol=1e-6)
    assert not value[~there].any()
    keyway = (angle % TURN >= 1.001) & (angle % TURN < 1.499)
    assert not there[keyway].any()
    assert 1.0 - there[turned & ~keyway].mean() == pytest.approx(2.0 * 0.05 / TURN, rel=0.3)


# --- the correction


def settle(late, gain=0.0, waves=3, revolutions=60):
    """RMS error by revolution of an ideal drive that follows the corrected sensor a revolution later [1]."""
    made = stage(revolutions_late=late)
    made._memory = made.memory._replace(gain=gain or made.memory.gain)  # also one that would be refused
    angle = np.arange(SAMPLES) * (TURN / SAMPLES)
    blind, known, history = np.sin(waves * angle), np.zeros(SAMPLES), []
    errors = [np.zeros(SAMPLES)]
    outputs = [messages.allocate(messages.STATE, SAMPLES) for _ in range(2)]
    for k in range(revolutions):
        error = blind - known
        history.append(float(np.sqrt(np.mean(error**2))))
        turned = k * TURN + angle
        past = np.concatenate((errors[-1], error))[SAMPLES - DELAY : -DELAY]
        errors.append(error)
        inputs = [{"angle": turned, "angle_true": turned}, {"angle_true": turned - DELAY * TURN / SAMPLES}]
        made.process(k * SAMPLES, [*inputs, {"error": past}, dict.fromkeys(STATE, np.zeros(SAMPLES))], outputs)
        # The drive goes on by what its sensor falls short, a revolution later.
        known = -outputs[0]["measured_position"].copy()
    return np.array(history)


@pytest.mark.parametrize("late", [1, 2, 5])
def test_the_gain_of_0_settles_without_overshoot_as_fast_as_the_formula_says(late):
    """The error falls as that of the double root D/(D+1) of λ^(D+1) - λ^D + g = 0."""
    found, lag = settle(late), late + 1
    gain = lag**lag / (lag + 1) ** (lag + 1)
    kept = np.exp(-np.log(2.0) * (3 / 50) ** 2)
    expected = np.ones(found.size)
    for k in range(1, found.size):
        expected[k] = expected[k - 1] - kept * gain * (expected[k - 1 - lag] if k > lag else 0.0)
    assert_allclose(found / found[0], expected, atol=0.02)
    assert np.all(np.diff(found) < 1e-5)


def test_the_gain_that_is_refused_is_the_first_that_diverges():
    """The limit is that of stability: 2·sin(π/(4D + 2))."""
    limit = 2 * np.sin(np.pi / 10)
    for part, grows in ((0.96, False), (1.04, True)):
        found = settle(1, part * limit, revolutions=120)
        assert (found[-20:].max() > found[20:40].max()) == grows
    assert_refused(
        lambda: Cell(config("gauged", f"gauge.gain={1.001 * limit}").nodes).check(),
        r"^gauge.gain = 0\.6186\d+: .* diverge; allowed: below 0.61803\d, or 0",
    )


def test_the_correction_learns_no_keyway_and_can_be_frozen_and_cleared():
    made = stage(gap_start=[1.0], gap_width=[0.5], gain=0.1, events=["sample 11520: freeze", "sample 19200: clear"])
    angle, state, _ = advance(made, lambda angle: np.where(abs(angle % TURN - 1.25) < 0.24, 1.0, 0.0))
    assert np.abs(state["measured_position"]).max() < 1e-6
    made = stage(gain=0.1, events=["sample 11520: freeze", "sample 19200: clear"])
    angle, state, _ = advance(made, lambda angle: np.ones(angle.size))
    turn = (angle / TURN + 1e-9).astype(int)
    assert_allclose(state["measured_position"][turn == 3], state["measured_position"][turn == 4], rtol=1e-9)
    assert -0.3 < state["measured_position"][turn == 4].min() < -0.05
    assert not state["measured_position"][turn == 5][:SAMPLES].any()


@pytest.mark.parametrize("points", [64, 512])
def test_the_correction_lies_at_the_angle_of_its_readings(points):
    """Mean reading and interpolation are even: only their amplitude depends on the number of points."""
    made = stage(gain=1.0, points_per_revolution=points, cutoff=8.0, events=["sample 15360: freeze"])
    angle, state, _ = advance(made, lambda angle: np.sin(3 * angle))
    rows = slice(-2 * SAMPLES // 3, -SAMPLES // 3)  # a wave far from the first and the last reading
    wave = np.mean(state["measured_position"][rows] * np.exp(-3j * angle[rows]))
    assert np.angle(wave / 0.5j) == pytest.approx(0.0, abs=3 * TURN / SAMPLES)


def test_the_other_fields_are_those_of_the_drive():
    measured = np.linspace(0.0, 1e-4, 6 * SAMPLES)
    _, state, _ = advance(stage(), lambda angle: np.zeros(angle.size), measured=measured)
    for name in STATE:
        assert_array_equal(state[name], measured)


# --- in a cell

BLIND = "controller.remap=[]"


@pytest.mark.parametrize(("cutoff", "offset"), [(50.0, 0.0059), (8.0, 0.03)])
def test_an_offset_below_the_one_that_is_refused_is_taken(cutoff, offset):
    Cell(config("gauged", f"gauge.cutoff={cutoff}", f"gauge.angle_offset={offset}").nodes).check()
    Cell(config("gauged", BLIND, "gauge.angle_offset=1.0").nodes).check()  # nobody learns from it


LEARNING = ("controller.stage=learning_controller", "controller.feedback_delay=3200", BLIND)
CAUSES = {
    "deflection": (),
    "run-out": ("loaded_drive.cut_run_out_order=[1, 5]", "loaded_drive.cut_run_out_amplitude=[60.0e-6, 20.0e-6]"),
    "wear": ("loaded_drive.cut_wear=0.2e-3",),
    "form told 1 % too small": (
        "controller.harmonic_order=[1, 2, 3, 4]",
        "controller.harmonic_amplitude=[19.8e-6, 222.75e-6, 14.85e-6, 19.8e-6]",
        "tool.deflects=false",
    ),
}


def largest(*changes):
    return harness.run(config("gauged", *changes)).errors.largest


@pytest.mark.parametrize("cause", CAUSES)
def test_the_disturbance_law_learns_from_the_gauge_what_the_drives_sensor_does_not_see(cause):
    blind, gauged = largest(*CAUSES[cause], BLIND), largest(*CAUSES[cause])
    assert blind[-10:].min() > 2e-6
    assert gauged[-10:].max() < 1e-6


def test_the_learning_controller_learns_from_the_gauge_by_the_tool():
    seen = largest(*LEARNING, "tool.remap=['coarse/state:=gauge/state']")
    assert largest(*LEARNING)[-1] > 50e-6
    assert seen[-10:].max() < 1.1e-6


def test_a_gauge_that_nobody_learns_from_changes_nothing():
    """The drive's own sensor gives the bits of the cell without a gauge."""
    with_gauge = config("gauged", BLIND, "spindle_encoder.revolutions=3.0")
    nodes = {name: table for name, table in with_gauge.nodes.items() if name != "gauge"}
    without = of_nodes("without", nodes)
    assert_array_equal(form_error(harness.run(with_gauge)), form_error(harness.run(without)))
