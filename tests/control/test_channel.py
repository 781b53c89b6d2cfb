# SPDX-License-Identifier: Apache-2.0
"""A channel in the cell: events on its memory, soft start, joining, cycles as long as the part, the law over time."""

import numpy as np
import pytest
from cells import command, cuts, encoder, form_error, run, scenario
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from test_repetitive import SPEED, STEP, TURN, exponential, learn, make, turn

from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError

STATUS = "/coarse/learning"
EVENTS = "/learning_controller/events"
ROUND = {"harmonic_order": [2], "harmonic_amplitude": [50e-6]}


def learned(**controller):
    return run(spindle_encoder={"revolutions": 10.0}, learning_controller=controller, tool=ROUND)


# --- saving and loading


def test_loaded_memory_goes_on_where_it_was_saved(tmp_path):
    """A second run that loads what the first saved errs from its first revolution on as the first did at its end."""
    file = str(tmp_path / "memory")
    first = learned(memory_file=file, events=["revolution 9: save"])
    second = learned(memory_file=file, events=["sample 0: load"])
    assert second.errors.rms[0] < 0.1 * first.errors.rms[0]  # what is left is the drive that starts at rest
    assert second.errors.rms[-1] < 1.5 * first.errors.rms[-1]
    assert first.recording.sparse[EVENTS].values["action"] == ["save"]


@settings(max_examples=15)
@given(st.floats(1.2, 3.4), cuts)
def test_frozen_memory_survives_saving_and_loading_at_any_place(turns, lengths):
    """Every point of the newest cycle has its place, whatever the ring's length and wherever the spindle is."""
    before = int(turns * TURN / (SPEED * STEP))
    lengths = [before, *(20 * n for n in lengths)]
    revolutions = (sum(lengths) + 0.5) * SPEED * STEP / TURN
    kept, renewed = make(q=exponential(0.0067)), make(q=exponential(0.0067))

    class Freezing:
        def __init__(self, controller):
            self.controller = controller

        def block(self, first, **signals):
            if first >= before:
                self.controller.learning = False
                if self.controller is renewed:
                    renewed.remember(renewed.memory())
            return self.controller.block(first, **signals)

    expected, found = (learn(np.sin, revolutions, Freezing(each), lengths=lengths)[1] for each in (kept, renewed))
    assert np.array_equal(found, expected)


def test_load_after_a_save_of_the_same_run_is_not_refused(tmp_path):
    events = ["revolution 4: save", "revolution 5: clear", "revolution 6: load"]
    result = learned(memory_file=str(tmp_path / "memory"), events=events)
    assert result.recording.sparse[EVENTS].values["action"] == ["save", "clear", "load"]
    assert result.errors.rms[5] > 30e-6
    assert result.errors.rms[7] < 1e-6


def test_memory_that_cannot_be_saved_ends_the_run(tmp_path):
    with pytest.raises(LatheError, match="the memory cannot be saved"):
        learned(memory_file=str(tmp_path / "no" / "memory"), events=["revolution 2: save"])


def test_service_refuses_what_cannot_be_loaded(tmp_path):
    path = str(tmp_path / "none")
    stage = Cell(scenario(learning_controller={"memory_file": path}).nodes).stages["learning_controller"]
    with pytest.raises(InputError, match="cannot be read"):
        stage.schedule("load", 1000)


# --- soft start


def test_soft_start_leaves_no_step_between_cycles():
    def steepest(soft_start):
        _, given, _ = learn(np.cos, 3.5, make(soft_start=soft_start, lead_time=0.0))
        return np.abs(np.diff(given)).max()

    step = SPEED * STEP
    assert steepest(0.0) > 0.1
    assert steepest(1.0) < 5 * step


def test_soft_start_learns_the_same_in_the_end():
    soft, hard = learned(soft_start=1.0), learned()
    assert soft.errors.rms[-1] < 1.1 * hard.errors.rms[-1]
    assert soft.errors.rms[1] > 2 * hard.errors.rms[1]


# --- joining


def test_channel_joins_when_the_error_of_a_whole_cycle_is_within_the_limit():
    scale = {0: 3.0, 1: 1.2, 2: 0.9, 3: 0.8}
    controller = make(join_below=1.0, lead_time=0.0)
    amplitude = np.vectorize(lambda a: scale[min(int(a / TURN), 3)])
    angle, given, cycles = learn(lambda a: amplitude(a) * np.sin(a), 4.9, controller)
    assert [cycle.learning for cycle in cycles] == [False, False, False, True]
    within = (angle > 4.1 * TURN) & (angle < 4.85 * TURN)
    assert_allclose(given[within], 0.8 * np.sin(angle[within]), atol=1e-6)
    assert not given[angle < 3.9 * TURN].any()


def test_joining_is_an_event_and_stands_in_the_status():
    result = learned(join_below=100e-6)
    assert result.recording.sparse[EVENTS].values["action"] == ["joined"]
    assert result.recording.sparse[STATUS].values["joined"][0]
    late = learned(join_below=1e-6)
    assert EVENTS not in late.recording.sparse or not late.recording.sparse[EVENTS].stamps
    assert not any(late.recording.sparse[STATUS].values["joined"])
    assert not command(late).any()


# --- cycles, laws, angles


def test_cycle_of_the_whole_part_learns_what_a_revolution_cannot():
    """A form that changes along the part is periodic in the part only."""
    part = {"profile": "piston", "feed": 5e-3, "part_revolutions": 4}
    spindle = {"revolutions": 40.0}

    def last(cycle):
        controller = {"cycle_revolutions": cycle, "feedback_delay": 3200}
        return run(spindle_encoder=spindle, learning_controller=controller, tool=part).errors.rms[-4:]

    assert last(4).max() < 0.05 * last(1).max()


def test_height_starts_anew_with_each_part():
    result = run(spindle_encoder={"revolutions": 5.0}, tool={"profile": "piston", "feed": 5e-3, "part_revolutions": 2})
    tool = result.recording.dense["/tool"]
    turns = encoder(result)["angle_true"] / TURN
    assert_allclose(tool["height"], 5e-3 * np.mod(turns, 2.0), atol=1e-12)


def test_law_over_time_is_the_law_over_the_angle_at_constant_speed():
    # At 1000 rpm a revolution is 3840 samples, and the two clocks differ by rounding.
    assert_allclose(form_error(learned(law="time_periodic")), form_error(learned()), atol=1e-12)


def test_law_over_time_repeats_in_time():
    """With the memory frozen the set point has the period θ/Ω0 whatever the spindle does."""
    result = run(
        spindle_encoder={"revolutions": 12.0, "deviation_amplitude": [0.1], "deviation_frequency": [30.0]},
        learning_controller={"law": "time_periodic", "events": ["revolution 6: freeze"]},
        tool=ROUND,
    )
    given = command(result)[-2 * 3840 :]
    assert_allclose(given[:3840], given[3840:], atol=1e-15)


@settings(max_examples=20)
@given(st.integers(1, 6), cuts)
def test_angle_far_from_zero_is_as_good_as_near_it(power, lengths):
    """After 10⁶ revolutions the angle has a resolution of 1 nrad, and the ring of the memory has wrapped."""
    lengths = [200 * n for n in lengths]
    angle = np.arange(sum(lengths)) * (SPEED * STEP)
    late = np.concatenate((np.zeros(100), angle))[: angle.size]
    far, near = (
        turn(make(q=exponential(0.0067)), offset + angle, offset + late, np.sin(3 * late), lengths=lengths)[0]
        for offset in (10**power * TURN, 0.0)
    )
    assert_allclose(far, near, atol=1e-6)


# --- exact preview


def test_preview_of_the_same_speed_law_runs():
    law = {"deviation_amplitude": [0.1], "deviation_frequency": [10.0]}
    result = run(
        spindle_encoder={"revolutions": 20.0, **law},
        learning_controller={"lead_law": "exact_preview", "correction": "exact", "q_time": 130e-6, **law},
        tool=ROUND,
    )
    plain = run(spindle_encoder={"revolutions": 20.0, **law}, learning_controller={"q_time": 130e-6}, tool=ROUND)
    assert result.errors.rms[-1] < plain.errors.rms[-1]
