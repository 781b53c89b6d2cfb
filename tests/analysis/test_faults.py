# SPDX-License-Identifier: Apache-2.0
"""Faults by name: what each does to a signal, when, and that every host makes the same of it."""

import math

import numpy as np
import pytest
from cells import assert_resimulated, command, config, cuts, encoder, in_two, run, scenario, spans
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from lathe_bagtools.resimulation.resim import resimulate
from lathe_rc import harness, messages
from lathe_rc.errors import LatheError
from lathe_rc.safety.faults import DISTURBANCES, KINDS, parse
from lathe_rc.safety.injection import Injection, Port

STEP = 1.0 / 64000
ALLOWED = {"allow_faults": True}
MEASURED = "coarse/state.measured_position"
#: a fault of each kind that a port can have
FAULTS = {
    "off": f"{MEASURED} off",
    "stuck": f"{MEASURED} stuck",
    "garbage": f"{MEASURED} garbage amplitude=1e-4",
    "wrong": f"{MEASURED} wrong scale=0.5 offset=1e-5",
    "slow": f"{MEASURED} slow time=1e-3",
    "delayed": f"{MEASURED} delayed time=1e-3",
    "intermittent": f"{MEASURED} intermittent good=2e-3 off=1e-3",
    "noisy": f"{MEASURED} noisy rms=1e-6",
    "missed_index": "encoder missed_index",
    "lost_counts": "encoder lost_counts angle=1e-2",
    "reversed": "encoder reversed",
}


def disturbed(text, *signals, start=0, lengths=None, seed=0):
    """Signals with a fault from sample ``start`` on, in blocks."""
    fault = parse(text, "test")
    made = DISTURBANCES[fault.kind](fault, seed=seed, step=STEP, whose="test")
    names = ["angle", "speed", "index_pulse"] if KINDS[fault.kind].what == "encoder" else [fault.target.split(".")[-1]]
    whole = {name: signal.copy() for name, signal in zip(names, signals, strict=True)}
    for first, stop in spans(lengths or [signals[0].size]):
        if max(first, start) < stop:
            made.during({name: signal[max(first, start) : stop] for name, signal in whole.items()})
    return whole[names[0]] if len(names) == 1 else whole


def test_there_is_a_case_for_each_kind():
    assert set(FAULTS) == set(DISTURBANCES) == {name for name, kind in KINDS.items() if kind.what != "cut"}


# ---- what they do


WAVE = np.sin(np.arange(640) * 0.05) + 2.0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("off", np.zeros(540)),
        ("stuck", np.full(540, WAVE[100])),
        ("wrong scale=1.5 offset=-0.25", 1.5 * WAVE[100:] - 0.25),
        ("delayed time=1e-3", np.append(np.full(64, WAVE[100]), WAVE[100:-64])),
    ],
)
def test_a_fault_changes_samples_from_its_first_on(text, expected):
    found = disturbed(f"x.f {text}", WAVE, start=100)
    assert_array_equal(found[:100], WAVE[:100])
    assert_allclose(found[100:], expected, rtol=1e-15)


def test_slow_follows_a_step_with_its_time_constant():
    found = disturbed("x.f slow time=1e-3", np.append(0.0, np.ones(639)))
    assert_allclose(1.0 - found, np.exp(-np.arange(640) * STEP / 1e-3), atol=1e-14)


def test_noise_and_garbage_have_their_size():
    noise = disturbed("x.f noisy rms=0.5", np.zeros(200_000))
    assert_allclose(np.std(noise), 0.5, rtol=0.01)
    garbage = disturbed("x.f garbage amplitude=3", np.zeros(200_000))
    assert_allclose(np.std(garbage), 3.0 / math.sqrt(3.0), rtol=0.01)
    assert np.abs(garbage).max() <= 3.0


def test_a_loose_contact_is_off_for_its_part_of_the_time():
    found = disturbed("x.f intermittent good=2e-3 off=1e-3", np.ones(640_000))
    assert set(found) == {0.0, 1.0}
    assert_allclose(found.mean(), 2.0 / 3.0, rtol=0.05)
    assert found[0] == 1.0


def test_random_faults_differ_by_seed_and_target_and_come_again():
    first = disturbed("x.f noisy rms=1", np.zeros(64))
    assert_array_equal(first, disturbed("x.f noisy rms=1", np.zeros(64)))
    assert not np.array_equal(first, disturbed("x.f noisy rms=1", np.zeros(64), seed=1))
    assert not np.array_equal(first, disturbed("y.f noisy rms=1", np.zeros(64)))


TURNS = np.arange(640) * (4.0 * np.pi / 640)  # two revolutions
PULSES = (np.arange(640) % 320 == 0).astype(np.uint8)


def test_counts_are_lost_at_once_and_after_each_revolution():
    found = disturbed("e lost_counts angle=0.1", TURNS, np.ones(640), PULSES, start=10)["angle"]
    assert_array_equal(found[:10], TURNS[:10])
    assert_allclose(found[10:330], TURNS[10:330] - 0.1, rtol=1e-14)
    assert_allclose(found[331:], TURNS[331:] - 0.2, rtol=1e-14)


def test_a_reversed_encoder_runs_back_from_where_it_was():
    found = disturbed("e reversed", TURNS, np.ones(640), PULSES, start=100)
    assert_allclose(found["angle"][100:], 2 * TURNS[100] - TURNS[100:], rtol=1e-14)
    assert_array_equal(found["speed"][100:], -np.ones(540))
    assert_array_equal(found["index_pulse"], PULSES)


@pytest.mark.parametrize("text", FAULTS.values(), ids=FAULTS)
@given(lengths=cuts)
def test_cutting_into_blocks_leaves_no_trace(text, lengths):
    size = sum(lengths)
    signals = [0.3 + np.arange(size) * 0.02]
    if text.startswith("encoder"):
        signals += [np.ones(size), np.ones(size, np.uint8)]
    start = size // 3
    whole, parts = (disturbed(text, *signals, start=start, lengths=cut) for cut in (None, lengths))
    for a, b in zip(*(part.values() if isinstance(part, dict) else [part] for part in (whole, parts)), strict=True):
        assert_array_equal(a, b)


# ---- what is refused


def test_a_stage_that_cannot_go_on_is_named():
    with pytest.raises(LatheError, match=r"^learning_controller: sample \d+: at 0 rad the memory is no longer kept"):
        run({**ALLOWED, "block_size": 64}, spindle_encoder={"faults": ["second 0.15: encoder.angle off"]})


# ---- in the cell


def measured(result):
    return result.recording.of_type(messages.STATE)["measured_position"]


def test_a_fault_holds_from_its_first_sample_to_its_last_and_is_recorded():
    good = run(ALLOWED)
    bad = run(ALLOWED, electrodynamic_actuator={"faults": [f"sample 5000 to 6000: {MEASURED} off"]})
    assert_array_equal(measured(bad)[:5000], measured(good)[:5000])
    assert not measured(bad)[5000:6000].any()
    assert measured(bad)[6000:6400].all()
    assert_array_equal(bad.recording.of_type(messages.STATE)["position"][:6400],
                       good.recording.of_type(messages.STATE)["position"][:6400])  # fmt: skip
    told = bad.recording.sparse["/electrodynamic_actuator/events"].values
    assert told["sample_index"] == [5000, 6000]
    assert told["action"] == [f"fault {MEASURED} off", f"repair {MEASURED} off"]


def test_the_end_of_a_fault_is_not_the_end_of_another_of_the_same_target():
    good = measured(run(ALLOWED))
    both = [f"sample 1000 to 2000: {MEASURED} noisy rms=1e-6", f"sample 1500 to 4000: {MEASURED} off"]
    result = run(ALLOWED, electrodynamic_actuator={"faults": both})
    assert not measured(result)[1500:4000].any()
    assert_array_equal(measured(result)[4000:4600], good[4000:4600], "before the controller has read any of it")
    all_at_once = {"faults": [text.partition(" to")[0] + ":" + text.partition(":")[2] for text in both],
                   "events": [f"sample 3000: repair {MEASURED}"]}  # fmt: skip
    result = run(ALLOWED, electrodynamic_actuator=all_at_once)
    assert not measured(result)[1500:3000].any()
    assert_array_equal(measured(result)[3000:4600], good[3000:4600])


def test_a_repair_of_what_is_not_broken_says_so_and_a_re_simulation_too(tmp_path):
    """And what the run was too short for is reported, but not that a fault lasts."""
    repair, nothing = f"repair {MEASURED}", f"nothing to repair: {MEASURED}"
    drive = {
        "events": [f"sample 1000: {repair}", f"sample 3000: {repair}", f"sample 3000: {repair}"],
        "faults": [
            f"sample 2000: {MEASURED} off", f"sample 4000 to 900000: {MEASURED} noisy rms=0",
            f"second 100 to 200: {MEASURED} stuck",
        ],
    }  # fmt: skip
    cell = scenario(ALLOWED, electrodynamic_actuator=drive, spindle_encoder={"events": ["sample 1500: repair encoder"]})
    result = harness.run(cell, bag=tmp_path / "bag")
    told = result.recording.sparse["/electrodynamic_actuator/events"].values["action"]
    assert told[:6] == [repair, nothing, f"fault {MEASURED} off", repair, repair, nothing]
    assert result.not_reached == {"electrodynamic_actuator": [f"second 100: fault {MEASURED} stuck"]}
    assert resimulate(tmp_path / "bag").different == []


@pytest.mark.parametrize(
    ("node", "field"), [("spindle_encoder", "encoder.speed"), ("electrodynamic_actuator", MEASURED)]
)
def test_a_fault_begins_and_ends_at_an_angle_also_where_the_stage_does_not_read_it(node, field):
    result = run(ALLOWED, **{node: {"faults": [f"revolution 1.5 to 2: {field} off"]}})
    begin, end = result.recording.sparse[f"/{node}/events"].values["sample_index"]
    angle = encoder(result)["angle_true"]
    assert angle[begin - 1] < 3.0 * np.pi <= angle[begin]
    assert angle[end - 1] < 4.0 * np.pi <= angle[end]
    broken = encoder(result)["speed"] if node == "spindle_encoder" else measured(result)
    assert not broken[begin:end].any()
    assert broken[[begin - 1, end]].all()


def test_a_bad_line_is_bad_for_one_reader_alone():
    good = run(ALLOWED)
    bad = run(ALLOWED, learning_controller={"faults": ["second 0.05: tool.measured_error wrong scale=0"]})
    for name, samples in bad.recording.of_type(messages.TOOL).items():
        assert_array_equal(samples[:6000], good.recording.of_type(messages.TOOL)[name][:6000])
    assert command(bad)[-1] != command(good)[-1]


def test_what_reads_late_meets_the_fault_late():
    """A sample that was bad when it was published is bad when it is read, not before."""
    delay = 2048
    first = run(ALLOWED, learning_controller={"feedback_delay": delay})
    bad = run(ALLOWED, learning_controller={"feedback_delay": delay, "events": [],
              "faults": ["sample 3000: tool.measured_error off"]})  # fmt: skip
    differ = np.flatnonzero(command(first) != command(bad))
    assert differ[0] >= 3000 + delay


def cut(*faults):
    """Form error and force of an interrupted cut with faults, and the revolution of each sample."""
    changes = ["allow_faults=true", "spindle_encoder.revolutions=16", f"cutting_process.faults={list(faults)!r}"]
    recording = harness.run(config("interrupted_cut", *(changes if faults else changes[1:2]))).recording
    cut = recording.of_type(messages.CUT)
    return recording.of_type(messages.ENCODER)["angle_true"] / (2 * np.pi), cut["depth_of_cut"], cut["force"]


def test_a_broken_tool_cuts_nothing_until_it_is_repaired_and_a_hard_spot_makes_force():
    broken, spot = "revolution 10: cut tool_broken length=1.0", "revolution 11 to 14: cut hard_spot factor=2 start=1"
    turn, depth, force = cut()
    last = turn > 13.0
    assert depth[last].max() > 0.0
    assert not cut(broken, spot.replace("14", "12"))[1][last].any(), "the end of the spot repairs no tool"
    assert cut(broken.replace("10:", "10 to 13:"))[1][last].any()
    _, hard_depth, hard_force = cut(spot)
    before = turn < 11.0
    assert_array_equal((hard_depth[before], hard_force[before]), (depth[before], force[before]))
    assert hard_force[~before].max() > 1.05 * force[~before].max()


def with_every_fault():
    """A cell in which each kind of fault comes and goes, at a device or on a line."""
    device, line, spindle = [], [], []
    for k, text in enumerate(FAULTS.values()):
        when = f"sample {4000 + 500 * k} to {4400 + 500 * k}"
        if text.startswith("encoder"):
            spindle.append(f"{when}: {text}")
        else:
            device.append(f"{when}: {text}")
            line.append(f"{when}: {text.replace(MEASURED, 'tool.measured_error')}")
    return scenario(
        ALLOWED,
        spindle_encoder={"faults": spindle, "revolutions": 4.0},
        electrodynamic_actuator={"faults": device},
        learning_controller={"faults": line},
    )


def test_all_faults_are_the_same_in_every_host_and_in_a_re_simulation(tmp_path):
    cell = with_every_fault()
    offline = harness.run(cell, bag=tmp_path / "bag")
    assert len(offline.recording.sparse["/spindle_encoder/events"].stamps) == 6
    assert harness.run(cell, mode="processes", groups=in_two(cell)).digest == offline.digest
    assert_resimulated(tmp_path / "bag")


@pytest.mark.parametrize("spans", [[(21, 22), (20, 21)], [(20, 23), (21, 22)]])
def test_equal_faults_that_touch_or_overlap_end_one_by_one(spans):
    injection = Injection("n", [], [Port("coarse/state", messages.STATE, ("position",), 0, out=True)], seed=1, step=1.0)
    fault = parse("coarse/state.position off", "n")
    moments = sorted((at, end) for span in spans for at, end in zip(span, (False, True), strict=True))
    out, reached = np.ones(30), 0
    for at, end in moments:
        injection.outputs(reached, [{"position": out[reached:at]}])
        reached = at
        if end:
            injection.end("coarse/state.position", at, fault)
        else:
            injection.begin(fault, at)
    injection.outputs(reached, [{"position": out[reached:]}])
    off = sorted({sample for begin, end in spans for sample in range(begin, end)})
    assert np.flatnonzero(out == 0.0).tolist() == off
