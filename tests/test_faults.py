# SPDX-License-Identifier: Apache-2.0
"""Faults by name: what each does to a signal, when, and that every host makes the same of it."""

import math

import numpy as np
import pytest
from cells import command, cuts, encoder, run, scenario, spans
from click.testing import CliRunner
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from lathe_rc import harness, messages
from lathe_rc.bag.resimulation.resim import resimulate
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cli import main
from lathe_rc.errors import InputError, LatheError
from lathe_rc.safety.faults import DISTURBANCES, KINDS, parse
from lathe_rc.safety.injection import Injection, Port

STEP = 1.0 / 64000
ALLOWED = {"allow_faults": True}
#: a fault of each kind that a port can have
FAULTS = {
    "off": "coarse/state.measured_position off",
    "stuck": "coarse/state.measured_position stuck",
    "garbage": "coarse/state.measured_position garbage amplitude=1e-4",
    "wrong": "coarse/state.measured_position wrong scale=0.5 offset=1e-5",
    "slow": "coarse/state.measured_position slow time=1e-3",
    "delayed": "coarse/state.measured_position delayed time=1e-3",
    "intermittent": "coarse/state.measured_position intermittent good=2e-3 off=1e-3",
    "noisy": "coarse/state.measured_position noisy rms=1e-6",
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


def test_off_is_zero():
    assert_array_equal(disturbed("x.f off", WAVE), np.zeros(640))


def test_stuck_keeps_the_first_sample():
    found = disturbed("x.f stuck", WAVE, start=100)
    assert_array_equal(found, np.append(WAVE[:100], np.full(540, WAVE[100])))


def test_wrong_scales_and_offsets():
    assert_allclose(disturbed("x.f wrong scale=1.5 offset=-0.25", WAVE), 1.5 * WAVE - 0.25, rtol=1e-15)


def test_delayed_is_late_by_whole_samples_and_stays_until_then():
    found = disturbed("x.f delayed time=1e-3", WAVE, start=100)
    assert_array_equal(found[100:164], np.full(64, WAVE[100]))
    assert_array_equal(found[164:], WAVE[100:-64])


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


def test_no_index_pulse():
    found = disturbed("e missed_index", TURNS, np.ones(640), PULSES)
    assert not found["index_pulse"].any()


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


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("coarse/state.measured_position broken", "KIND one of off, stuck"),
        ("coarse/state.measured_position noisy", "no rms; allowed: each once: rms= a number from 0 up to 1e+100"),
        ("coarse/state.measured_position noisy rms=-1", "rms=-1; allowed"),
        ("coarse/state.measured_position noisy rms=nan", "rms=nan; allowed"),
        ("coarse/state.measured_position garbage amplitude=1e308", "amplitude=1e308; allowed"),
        ("coarse/state.measured_position noisy rms=1 rms=2", "rms=2; allowed: each once"),
        ("coarse/state.measured_position stuck at=3", "at=3; allowed: no values"),
        (
            "coarse/state.nothing stuck",
            "no such target for it; allowed for stuck: coarse/command.position, coarse/",
        ),
        ("encoder reversed", "no such target for it; allowed for reversed: none of this node"),
        ("cut tool_broken length=1e-3", "no such target for it; allowed for tool_broken: none of this node"),
        ("coarse/state.measured_position noisy rms=\x1b[31m", "rms=\ufffd[31m; allowed: each once"),
        ("x" * 300, "300 characters; allowed: up to 200"),
    ],
)
def test_what_cannot_be_is_refused_before_the_run(text, said):
    with pytest.raises(InputError, match="electrodynamic_actuator") as caught:
        run(ALLOWED, electrodynamic_actuator={"faults": [f"second 0.01: {text}"]})
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("node", "text", "said"),
    [
        ("cutting_process", "cut off", "allowed for off: cut.allowance, cut.deflection"),
        ("cutting_process", "cut off", "; for cut: tool_broken, hard_spot"),
        (
            "cutting_process",
            "cut.force tool_broken length=1",
            "allowed for tool_broken: cut; for cut.force: off, ",
        ),
        ("spindle_encoder", "encoder.index_pulse noisy rms=1", "allowed for noisy: encoder.angle, encoder.speed; for"),
        ("spindle_encoder", "encoder stuck", "encoder.speed; for encoder: missed_index, lost_counts, reversed"),
    ],
)
def test_a_refusal_names_what_the_kind_is_for_and_what_the_target_can_have(node, text, said):
    changes = ["allow_faults=true", f"{node}.faults={[f'second 1: {text}']!r}"]
    with pytest.raises(InputError) as caught:
        harness.run(scenarios.load(scenarios_path("interrupted_cut"), changes))
    assert said in str(caught.value)


def test_true_signals_cannot_be_wrong():
    with pytest.raises(InputError, match="no such target"):
        run(ALLOWED, spindle_encoder={"faults": ["second 0.01: encoder.angle_true stuck"]})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("second 2 to 1: coarse/state.measured_position off", "ends before it begins"),
        ("some day: coarse/state.measured_position off", "'revolution R to S: FAULT'"),
        ("second nan: coarse/state.measured_position off", "faults = "),
    ],
)
def test_times_that_cannot_be_are_refused(text, said):
    with pytest.raises(InputError) as caught:
        run(ALLOWED, electrodynamic_actuator={"faults": [text]})
    assert said in str(caught.value)


def test_what_is_repaired_is_one_of_the_targets():
    with pytest.raises(InputError, match=r"repair 'coarse/state.nothing': there is no such target; allowed: coarse"):
        run(ALLOWED, electrodynamic_actuator={"events": ["second 0.01: repair coarse/state.nothing"]})


def test_a_repair_of_one_fault_is_written_like_the_fault():
    with pytest.raises(InputError, match="repair 'encoder lost_counts': no angle; allowed: each once: angle="):
        run(ALLOWED, spindle_encoder={"events": ["second 0.01: repair encoder lost_counts"]})


def test_a_stage_that_cannot_go_on_is_named():
    with pytest.raises(LatheError, match=r"^learning_controller: sample \d+: at 0 rad the memory is no longer kept"):
        run({**ALLOWED, "block_size": 64}, spindle_encoder={"faults": ["second 0.15: encoder.angle off"]})


def test_faults_are_refused_unless_they_are_allowed():
    fault = "electrodynamic_actuator.faults=['second 1: coarse/state.position off']"
    found = CliRunner().invoke(main, ["run", "one_channel", "--set", fault])
    assert found.exit_code == 2
    assert found.stderr == (
        "lathe: electrodynamic_actuator.faults: 'fault coarse/state.position off' is refused; set allow_faults = true "
        "under /** to let things break\n"
    )


# ---- in the cell


def measured(result):
    return result.recording.of_type(messages.STATE)["measured_position"]


def test_a_fault_holds_from_its_first_sample_to_its_last_and_is_recorded():
    good = run(ALLOWED)
    bad = run(ALLOWED, electrodynamic_actuator={"faults": ["sample 5000 to 6000: coarse/state.measured_position off"]})
    assert_array_equal(measured(bad)[:5000], measured(good)[:5000])
    assert not measured(bad)[5000:6000].any()
    assert measured(bad)[6000:6400].all()
    assert_array_equal(bad.recording.of_type(messages.STATE)["position"][:6400],
                       good.recording.of_type(messages.STATE)["position"][:6400])  # fmt: skip
    told = bad.recording.sparse["/electrodynamic_actuator/events"].values
    assert told["sample_index"] == [5000, 6000]
    assert told["action"] == ["fault coarse/state.measured_position off", "repair coarse/state.measured_position off"]


def test_the_end_of_a_fault_is_not_the_end_of_another_of_the_same_target():
    field = "coarse/state.measured_position"
    good = measured(run(ALLOWED))
    both = [f"sample 1000 to 2000: {field} noisy rms=1e-6", f"sample 1500 to 4000: {field} off"]
    result = run(ALLOWED, electrodynamic_actuator={"faults": both})
    assert not measured(result)[1500:4000].any()
    assert_array_equal(measured(result)[4000:4600], good[4000:4600], "before the controller has read any of it")
    all_at_once = {"faults": [text.partition(" to")[0] + ":" + text.partition(":")[2] for text in both],
                   "events": [f"sample 3000: repair {field}"]}  # fmt: skip
    result = run(ALLOWED, electrodynamic_actuator=all_at_once)
    assert not measured(result)[1500:3000].any()
    assert_array_equal(measured(result)[3000:4600], good[3000:4600])


@pytest.mark.parametrize("mode", ["offline", "composed"])
def test_a_repair_of_what_is_not_broken_says_so_and_a_re_simulation_too(mode, tmp_path):
    field = "coarse/state.measured_position"
    events = [f"sample 1000: repair {field}", f"sample 3000: repair {field}", f"sample 3000: repair {field}"]
    nodes = {
        "electrodynamic_actuator": {"events": events, "faults": [f"sample 2000: {field} off"]},
        "spindle_encoder": {"events": ["sample 1500: repair encoder"]},
    }
    bag = tmp_path / "bag"
    result = harness.run(scenario(ALLOWED, **nodes), mode=mode, bag=bag)
    told = result.recording.sparse["/electrodynamic_actuator/events"].values
    nothing = f"nothing to repair: {field}"
    assert told["action"] == [events[0][13:], nothing, f"fault {field} off", events[1][13:], events[1][13:], nothing]
    assert resimulate(bag).different == []


def test_what_the_run_was_too_short_for_is_told_but_not_that_a_fault_lasts():
    field = "coarse/state.measured_position"
    faults = [f"second 0.01 to 100: {field} off", f"second 100 to 200: {field} stuck"]
    result = run(ALLOWED, electrodynamic_actuator={"faults": faults})
    assert result.not_reached == {"electrodynamic_actuator": [f"second 100: fault {field} stuck"]}
    composed = harness.run(scenario(ALLOWED, electrodynamic_actuator={"faults": faults}), mode="composed")
    assert composed.not_reached == result.not_reached


def test_what_is_repaired_at_the_cut_is_what_was_broken():
    def force(*faults):
        changes = ["allow_faults=true", "spindle_encoder.revolutions=16", f"cutting_process.faults={list(faults)!r}"]
        recording = harness.run(scenarios.load(scenarios_path("interrupted_cut"), changes)).recording
        turned = recording.of_type(messages.ENCODER)["angle_true"] / (2 * np.pi)
        return recording.of_type(messages.CUT)["depth_of_cut"][turned > 14.0]

    broken, spot = "revolution 10: cut tool_broken length=1.0", "revolution 11 to 12: cut hard_spot factor=2"
    assert not force(broken, spot).any()
    assert force(broken.replace("10:", "10 to 13:"), spot.replace(" to 12", "")).any()


def test_a_fault_may_begin_at_an_angle_also_where_the_stage_does_not_read_it():
    result = run(ALLOWED, electrodynamic_actuator={"faults": ["revolution 1.5: coarse/state.measured_position off"]})
    (index,) = result.recording.sparse["/electrodynamic_actuator/events"].values["sample_index"]
    angle = encoder(result)["angle"]
    assert angle[index - 1] < 3.0 * np.pi <= angle[index]


def test_the_spindle_knows_its_angle_before_it_has_turned():
    result = run(ALLOWED, spindle_encoder={"faults": ["revolution 1.5 to 2: encoder.speed off"]})
    begin, end = result.recording.sparse["/spindle_encoder/events"].values["sample_index"]
    angle, speed = encoder(result)["angle_true"], encoder(result)["speed"]
    assert angle[begin - 1] < 3.0 * np.pi <= angle[begin]
    assert angle[end - 1] < 4.0 * np.pi <= angle[end]
    assert_array_equal(np.flatnonzero(speed == 0.0), np.arange(begin, end))


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


def test_a_broken_tool_and_a_hard_spot_change_the_force():
    changes = ["allow_faults=true", "spindle_encoder.revolutions=30"]

    def force(*faults):
        text = [f"cutting_process.faults={list(faults)!r}"] if faults else []
        loaded = scenarios.load(scenarios_path("interrupted_cut"), changes + text)
        return harness.run(loaded).recording

    whole, broken = force(), force("revolution 20: cut tool_broken length=1.0")
    hard = force("revolution 20 to 25: cut hard_spot factor=2 start=1 width=0.5")
    angle = whole.of_type(messages.ENCODER)["angle_true"]
    after = angle > 21 * 2 * np.pi
    good, none, more = (found.of_type(messages.CUT)["depth_of_cut"] for found in (whole, broken, hard))
    assert good[after].max() > 0.0
    assert not none[after].any()
    before = angle < 20 * 2 * np.pi
    forces = [found.of_type(messages.CUT)["force"] for found in (whole, hard)]
    assert_array_equal(forces[0][before], forces[1][before])
    assert forces[1][after].max() > 1.05 * forces[0][after].max()
    assert_array_equal(more[before], good[before])


def scenarios_path(name):
    from cells import SCENARIOS

    return next(path for path in SCENARIOS if path.stem == name)


def with_every_fault():
    """A cell in which each kind of fault comes and goes, at a device or on a line."""
    device, line, spindle = [], [], []
    for k, text in enumerate(FAULTS.values()):
        when = f"sample {4000 + 500 * k} to {4400 + 500 * k}"
        if text.startswith("encoder"):
            spindle.append(f"{when}: {text}")
        else:
            device.append(f"{when}: {text}")
            line.append(f"{when}: {text.replace('coarse/state.measured_position', 'tool.measured_error')}")
    return scenario(
        ALLOWED,
        spindle_encoder={"faults": spindle, "revolutions": 4.0},
        electrodynamic_actuator={"faults": device},
        learning_controller={"faults": line},
    )


@pytest.mark.parametrize("mode", ["composed", "processes"])
def test_all_faults_are_the_same_in_every_host(mode):
    loaded = with_every_fault()
    offline = harness.run(loaded)
    assert len(offline.recording.sparse["/spindle_encoder/events"].stamps) == 6
    assert harness.run(loaded, mode=mode).digest == offline.digest


def test_a_re_simulation_breaks_again_in_the_same_way(tmp_path):
    harness.run(with_every_fault(), bag=tmp_path / "bag")
    found = resimulate(tmp_path / "bag")
    assert (found.changed, found.different, found.missing) == (False, [], [])


def test_a_delay_is_as_long_as_memory_allows():
    with pytest.raises(InputError, match=r"time=1e9"):
        parse("coarse/state.measured_position delayed time=1e9", "node")


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
