# SPDX-License-Identifier: Apache-2.0
"""The offline engine: blocks leave no trace, events take effect at their sample, the run ends at its last."""

import numpy as np
import pytest
from cells import command, encoder, form_error, run, same
from hypothesis import example, given, settings
from hypothesis import strategies as st

# Every source of state that could feel a cut: random speed, coarse encoder, noise, an end stop, all events.
BUSY = {
    "spindle_encoder": {
        "revolutions": 4.0,
        "deviation_amplitude": [0.05],
        "deviation_frequency": [10.7],
        "random_rms": 0.01,
        "counts_per_revolution": 3600,
        "tachogram_time": [0.05, 0.1],
        "tachogram_deviation": [0.0, 0.02],
    },
    "learning_controller": {
        "events": ["revolution 1.7: freeze", "second 0.1301: learn", "sample 10007: clear"],
        "feedback_delay": 1500,
        "learning_gain": 1.5,
    },
    "electrodynamic_actuator": {"noise_rms": 1e-7, "resolution": 1e-8, "stroke": 281e-6},
    "tool": {"profile": "piston", "feed": 1e-3},
}
EVENTS = "/learning_controller/events"


@pytest.fixture(scope="module")
def busy():
    return run({"block_size": 64}, **BUSY)


@settings(max_examples=15)
@example(1)
@example(63)
@given(st.integers(1, 1500))
def test_block_size_changes_no_digest(busy, block_size):
    assert run({"block_size": block_size}, **BUSY).digest == busy.digest


def test_busy_cell_is_busy(busy):
    """The test above means something only if all of this happens."""
    signals = {topic.split("/")[-1]: part for topic, part in busy.recording.dense.items()}
    assert np.ptp(np.diff(signals["encoder"]["angle"])) > 1e-3
    assert not np.array_equal(signals["state"]["position"], signals["state"]["measured_position"])
    assert np.abs(signals["state"]["position"]).max() == 281e-6
    assert busy.recording.sparse[EVENTS].values["action"] == ["freeze", "learn", "clear"]


def test_run_ends_at_the_last_sample_before_the_angle():
    for revolutions in (1.0, 2.5, 1e-3, 1e-9):
        angle = encoder(run(spindle_encoder={"revolutions": revolutions}))["angle_true"]
        step = 1000 / 60 / 64000
        assert angle[-1] / (2 * np.pi) < revolutions <= angle[-1] / (2 * np.pi) + step * (1 + 1e-9)


def test_longer_run_begins_with_the_shorter_one():
    short, long = (run(spindle_encoder={"revolutions": revolutions}).recording.dense for revolutions in (2.3, 3.0))
    for topic, signals in short.items():
        beginning = {name: array[: signals[name].size] for name, array in long[topic].items()}
        assert same(signals, beginning)


def test_seed_makes_what_is_random():
    first, again, other = (run({"seed": seed}, **BUSY).digest for seed in (1, 1, 2))
    assert first == again
    assert first["/encoder"] != other["/encoder"]


def test_joint_states_are_the_signals_at_fixed_samples():
    result = run({"joint_state_period": 1000, "block_size": 64})
    joints = result.recording.sparse["/spindle_encoder/joint_states"]
    angle = encoder(result)["angle"]
    assert joints.stamps == [1_000_000_000 + n * 15_625 for n in range(0, angle.size, 1000)]
    assert np.array_equal(np.concatenate(joints.values["position"]), angle[::1000])
    assert joints.values["name"][0] == ["spindle_encoder"]


# --- events


def learning(*events, **more):
    """A run with events of the learning controller."""
    return run(spindle_encoder={"revolutions": 6.0, **more}, learning_controller={"events": list(events)})


def first_change(changed, plain):
    return int(np.flatnonzero(command(changed) != command(plain))[0])


@pytest.fixture(scope="module")
def plain():
    return learning()


@pytest.mark.parametrize(
    ("when", "index"),
    [
        ("sample 12344.5", 12345),
        ("second 0.2", 12800),
        ("second 0.20001", 12801),
        ("revolution 2.0001", 7681),
        ("revolution 2.4999", 9600),
        ("revolution 0", 0),
    ],
)
def test_event_takes_effect_at_its_sample(plain, when, index):
    result = learning(f"{when}: clear")
    events = result.recording.sparse[EVENTS]
    assert events.stamps == [1_000_000_000 + index * 15_625]
    assert (events.values["sample_index"], events.values["action"]) == ([index], ["clear"])
    if index > 3840:
        assert first_change(result, plain) == index
        assert command(result)[index] == 0.0


def test_event_after_the_end_never_happens(plain):
    assert learning("sample 23050: clear", "revolution 6.1: clear").digest == plain.digest


def test_events_at_one_sample_happen_in_their_order():
    actions = ["freeze", "clear", "learn", "freeze"]
    result = learning(*(f"sample 9000: {action}" for action in actions))
    assert result.recording.sparse[EVENTS].values["action"] == actions


@pytest.mark.parametrize("law", ["variable", "constant_angle"])
def test_frozen_memory_repeats_the_command_whatever_the_error(law):
    """After the event freeze the command repeats, whatever the error.

    The feed along the piston changes the error in each revolution.
    """
    result = run(
        spindle_encoder={"revolutions": 8.0},
        learning_controller={"events": ["revolution 4: freeze"], "lead_law": law},
        tool={"profile": "piston", "feed": 5e-3},
    )
    turns = command(result)[4 * 3840 : 8 * 3840].reshape(4, 3840)
    assert np.ptp(form_error(result)[5 * 3840 : 8 * 3840].reshape(3, 3840)[:, 100]) > 1e-6
    # The angle at 1000 rpm repeats after 3840 samples but for its rounding.
    np.testing.assert_allclose(turns[2:], turns[1:2].repeat(2, axis=0), rtol=0, atol=1e-15)


def test_learning_goes_on_where_it_is_allowed_to(plain):
    frozen = learning("revolution 2: freeze")
    resumed = learning("revolution 2: freeze", "revolution 4: learn")
    assert frozen.errors.rms[5] == pytest.approx(frozen.errors.rms[3], rel=1e-2)
    assert resumed.errors.rms[5] < 0.5 * frozen.errors.rms[5]
    assert resumed.recording.sparse["/coarse/learning"].values["learning"] == [True, False, False, True, True]


def test_cleared_memory_learns_anew(plain):
    cleared = learning("revolution 3: clear")
    assert cleared.errors.rms[3] > 0.9 * plain.errors.rms[0]
    assert cleared.errors.rms[5] < 0.1 * cleared.errors.rms[3]
