# SPDX-License-Identifier: Apache-2.0
"""Limits of a command: kept by every sample, nothing changed within them, everything clipped counted and told."""

import numpy as np
import pytest
from cells import assert_resimulated, command, config, run, spans
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from lathe_machine.control.limits import CommandLimits, limit, limiter
from lathe_rc import harness, messages

STEP = 1.0 / 64000
LIMITS = CommandLimits(0.5e-3, 0.1, 200.0, 1e5)
TIME = np.arange(32_000) * STEP


def limited(wanted, limits=LIMITS, lengths=None):
    table, found = limiter(limits, STEP, 1 << wanted.size.bit_length()), np.empty_like(wanted)
    for first, stop in spans(lengths or [wanted.size]):
        limit(table, first, wanted[first:stop], found[first:stop])
    return found, table.clipped[: wanted.size].astype(bool)


def assert_within(found):
    """Position, velocity, acceleration and jerk keep within `LIMITS`; at rest at 0 before the first sample."""
    whole = np.concatenate((np.zeros(3), found))
    peaks = [np.abs(np.diff(whole, order)).max() / STEP**order for order in range(4)]
    assert peaks[0] <= LIMITS.stroke
    assert np.all(np.array(peaks[1:]) <= np.array(LIMITS[1:]) * (1 + 1e-3)), peaks


def test_what_keeps_within_the_limits_goes_through_to_the_bit():
    wave = 200e-6 * np.sin(2 * np.pi * 5 * TIME) * np.minimum(TIME * 5, 1.0) ** 3
    found, clipped = limited(wave)
    assert_array_equal(found, wave)
    assert not clipped.any()


@pytest.mark.parametrize(
    ("wave", "settles"),
    [
        (np.where(TIME > 0.1, -480e-6, 0.0), True),
        (np.where(TIME < 0.2, 400e-6 * np.sin(2 * np.pi * 150 * TIME), 100e-6 * np.sin(2 * np.pi * 16 * TIME)), True),
        (1e-3 * np.sin(2 * np.pi * 16 * TIME), False),
        (100e-6 * np.random.default_rng(0).standard_normal(TIME.size), False),
    ],
    ids=["step to the stroke", "fast, then slow", "beyond the stroke", "noise"],
)
def test_every_sample_keeps_within_the_limits(wave, settles):
    found, clipped = limited(wave)
    assert_within(found)
    assert clipped.any()
    if settles:
        assert_array_equal(found[-1000:], wave[-1000:])
        assert not clipped[-1000:].any()


@given(st.lists(st.floats(-1e-3, 1e-3), min_size=1, max_size=6))
def test_steps_of_any_height_keep_within_the_limits_and_are_reached(heights):
    found, _ = limited(np.repeat([*heights, 0.0], 6000))
    assert_within(found)
    assert_allclose(found[-1], 0.0, atol=1e-9)


def test_limits_that_are_not_set_limit_nothing():
    wave = np.random.default_rng(1).standard_normal(1000)
    found, clipped = limited(wave, CommandLimits())
    assert_array_equal(found, wave)
    assert not clipped.any()


# ---- in the cell

TIGHT = {"command_velocity": 0.05, "command_acceleration": 100.0, "command_jerk": 1e6}


def events(result):
    found = result.recording.sparse["/electrodynamic_actuator/events"].values
    return list(zip(found["action"], found["sample_index"], strict=True))


def test_clipped_samples_are_counted_and_told():
    result = run({"block_size": 50}, electrodynamic_actuator=TIGHT)
    told = events(result)
    assert [action.partition(":")[0] for action, _ in told[:2]] == ["limited", "free"]
    wanted = command(result)
    _, clipped = limited(wanted, CommandLimits(np.inf, *TIGHT.values()))
    assert told[0][1] == np.flatnonzero(clipped)[0]
    counts = [int(action.split()[1]) for action, _ in told if action.startswith("free")]
    ended = [index for action, index in told if action.startswith("free")]
    assert sum(counts) == clipped[: ended[-1] + 1].sum()
    rest = [(action, index) for action, index in told if action.startswith("limited:")]
    left = clipped[ended[-1] + 1 :].sum()
    assert rest == [(f"limited: {left} samples were clipped", clipped.size - 1)], "the run ends in the midst of it"
    for index in ended:
        assert not clipped[index - 639 : index + 1].any()
        assert clipped[index - 640]


def test_a_feed_drive_tells_of_what_its_command_limit_alone_cuts_off():
    short = ["feed_drive.command_limit=0.2", "spindle_encoder.revolutions=1.5"]
    recording = harness.run(config("periodic", *short)).recording
    wanted, held = recording.of_type(messages.SERVO)["command"], recording.of_type(messages.STATE)["effort"]
    assert np.abs(wanted).max() > 0.2 == np.abs(held).max()
    actions = recording.sparse["/feed_drive/events"].values["action"]
    assert actions[0] == "limited"
    assert all(action == "limited" or action.startswith(("limited: ", "free: ")) for action in actions)


def test_a_command_that_is_clipped_to_the_end_of_the_run_is_counted_all_the_time():
    result = run({"block_size": 50}, electrodynamic_actuator={"command_stroke": 0.05e-3})
    assert np.abs(result.recording.of_type(messages.STATE)["position"]).max() < 80e-6
    _, clipped = limited(command(result), CommandLimits(0.05e-3))
    told = [(int(action.split()[1]), index) for action, index in events(result) if "were clipped" in action]
    assert clipped.sum() > 1000
    assert sum(count for count, _ in told) == clipped.sum()
    assert np.diff([index for _, index in told]).max() <= 6400, "said every 0.1 s"


@pytest.mark.parametrize(
    ("name", "limits", "told"),
    [
        (
            "two_channel",
            "electrodynamic_actuator.command_velocity=0.035 piezo_actuator.command_stroke=1e-6",
            {"electrodynamic_actuator": {"limited"}, "piezo_actuator": {"limited"}},
        ),
        (
            "series",
            "series_drive.coarse_command_velocity=0.035 series_drive.fine_command_stroke=1e-7",
            {"series_drive": {"limited: coarse", "limited: fine"}},
        ),
        ("force_turning", "longitudinal.command_acceleration=0.5", {"longitudinal": {"limited"}}),
    ],
)
def test_limits_are_the_same_in_every_block_and_re_simulation(name, limits, told, tmp_path):
    changes = ["spindle_encoder.revolutions=5", *limits.split()]
    result = harness.run(config(name, *changes), bag=tmp_path / "bag")
    for node, actions in told.items():
        assert actions <= set(result.recording.sparse[f"/{node}/events"].values["action"])
    assert harness.run(config(name, *changes, "block_size=17")).digest == result.digest
    assert_resimulated(tmp_path / "bag")


def test_the_feed_is_limited_and_says_so():
    def turned(*limits):
        recording = harness.run(config("force_turning", "spindle_encoder.revolutions=40", *limits)).recording
        state = recording.dense["/longitudinal/state"]
        return (
            state["position"],
            12.4e-3 * state["effort"],
            recording.sparse["/longitudinal/events"].values.get("action"),
        )

    _, speed, told = turned("longitudinal.command_acceleration=0.5", "longitudinal.command_jerk=500.0")
    assert told[0] == "limited"
    assert told[1].startswith("free: ")
    assert np.abs(np.diff(speed)).max() / STEP <= 0.5 * 1.001
    assert np.abs(np.diff(speed, 2)).max() / STEP**2 <= 500.0 * 1.001
    _, speed, told = turned()
    assert told is None
    assert np.abs(np.diff(speed)).max() / STEP > 0.5
    position, _, told = turned("longitudinal.command_stroke=2e-3")
    assert 1.9e-3 < position.max() <= 2e-3 + 1e-12
    assert "limited" in told
