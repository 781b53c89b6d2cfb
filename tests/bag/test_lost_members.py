# SPDX-License-Identifier: Apache-2.0
"""Readers of a bag state no figure that rests on held samples of lost members."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from bags import lathe
from cells import STEP, scenario

from lathe_live.panel_player import Player
from lathe_rc import harness, messages, read_bag
from lathe_rc.analysis.tolerance import FORCE
from lathe_rc.bag.loss import HELD, SOUND, loss_of
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.snapshot import SNAPSHOT
from lathe_rc.bag.writing.writer import BagWriter, offered_qos
from lathe_rc.blocks.ports import Sparse
from lathe_rc.blocks.wire import Decoder, Encoder
from lathe_rc.errors import InputError
from lathe_rc.judge import part
from lathe_rc.judge.loops import ServoLoop, watches
from lathe_rc.view.report_gather import gather
from lathe_rc.view.report_verdict import BAD, assess

PLANTED = 73.13131313e-6  #: every held sample, and all that may rest on it [SI units]
SEEN = re.compile(r"73\.13|7\.313|0\.07313")  #: as a page or a table tells it
IN_FULL = re.compile(r"7\.?3131313")  #: as a file of columns holds it, among millions of others
TURN = 3840  #: samples of a revolution
HELD_FROM, SOUND_TO = 3 * TURN + 300, 3 * TURN - 200
#: of every kind of member but the time master, without which no sample follows
LOST = ("/coarse/command", "/coarse/state", "/tool", "/reference", "/gauge/reading", "/safety", "/fine/state")
LOST += ("/cut", "/cross/command", "/cross/state")
FIRSTS = np.random.default_rng(1).integers(0, 4 * TURN - 100, len(LOST)).tolist()
WINDOW = 4096  #: [sample]


def with_loss(source: Path, target: Path, about: dict[str, str], sound: int, first: int = 0) -> Path:
    """Copy a bag from a sample on; from sample ``sound`` on plant a value in all numbers but those of the encoder."""
    with BagSource(source) as bag:
        writer = BagWriter(target, compression="zstd", chunk_size=2**20, about={**bag.about, **about})
        for topic, said in bag.topics.items():
            writer.add_topic(topic, said.type, offered_qos(10, "transient_local"))
        for topic, log_ns, data in bag.messages(start_ns=messages.START_NS + first * STEP):
            writer.write(topic, log_ns, planted(bag.topics[topic].type, data, sound))
        writer.close()
    return target


def planted(kind: str, data: bytes, sound: int) -> bytes:
    if kind not in messages.block_types() or kind == messages.ENCODER:
        return data
    block = Decoder(kind).decode(data)
    late = np.arange(block.first_index, block.first_index + block.samples) >= sound
    signals = {
        name: np.where(late, PLANTED, array) if array.dtype.kind == "f" else array
        for name, array in block.signals.items()
    }
    encoder = Encoder(kind, block.run_id, block.source, block.step_ns)
    return encoder.encode(block.first_index, signals, last=block.last, companions=block.companions)[1]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Bag of a run in which no member was lost."""
    path = tmp_path_factory.mktemp("lost") / "whole"
    harness.run(scenario(spindle_encoder={"revolutions": 4.0}, tool={"tolerance": 2e-4}), bag=path)
    return path


@pytest.fixture(scope="module")
def lost(whole):
    about = {HELD: json.dumps({"/tool": HELD_FROM}), SOUND: str(SOUND_TO)}
    return with_loss(whole, whole.with_name("lost"), about, SOUND_TO)


WHY = f"not read from sample {SOUND_TO} on: /tool is held from sample {HELD_FROM} on, its node was lost"


def files(folder: Path, *suffixes: str) -> str:
    return "".join(path.read_text("utf-8") for path in folder.rglob("*") if path.suffix in suffixes)


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("measure", "{bag}"), 3),
        (("measure", "{bag}", "--json"), 3),
        (("measure", "{bag}", "--revolutions", "4"), 2),
        (("bag", "info", "{bag}"), 3),
        (("bag", "info", "{bag}", "--json"), 3),
        (("bag", "check", "{bag}"), 3),
        (("bag", "tachogram", "{bag}", "-o", "{out}/t.csv"), 3),
        (("report", "{bag}", "-o", "{out}/r.html"), 3),
        (("compare", "{bag}", "{whole}", "-o", "{out}/c.html"), 3),
        (("export", "{bag}", "--csv", "-o", "{out}/csv"), 3),
        (("resim", "{bag}"), 2),
        (("fit", "drive", "{bag}", "-o", "{out}/d.yaml", "--figure", "{out}/d.png"), None),
        (("correct", "{bag}", "--scenario", "piston", "-o", "{out}/f.csv"), 2),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
@pytest.mark.usefixtures("no_pictures")
def test_no_command_states_a_figure_that_rests_on_held_samples(words, code, lost, whole, tmp_path):
    """Held samples appear in no output and in no file; each command names the loss, and none ends with exit code 0."""
    done = lathe(*(word.format(bag=lost, whole=whole, out=tmp_path) for word in words))
    assert not SEEN.search(done.output + files(tmp_path, ".html", ".yaml"))
    assert not IN_FULL.search(files(tmp_path, ".csv"))
    assert code is None or done.exit_code == code, done.output
    if code == 3:
        assert f"from sample {HELD_FROM} on" in done.output


def test_the_planted_value_is_found_where_a_bag_does_not_name_the_loss(whole, tmp_path):
    """The search of these tests finds held samples: without the entries they are measured as any others."""
    unsaid = with_loss(whole, tmp_path / "unsaid", {}, SOUND_TO)
    assert SEEN.search(lathe("measure", unsaid).output)
    lathe("export", unsaid, "--csv", "-o", tmp_path / "csv")
    assert IN_FULL.search(files(tmp_path, ".csv"))


@pytest.mark.parametrize(("topic", "first"), list(zip(LOST, FIRSTS, strict=True)), ids=LOST)
def test_the_recording_ends_before_the_first_sample_that_may_rest_on_held_ones(topic, first, whole, tmp_path):
    """A member of each kind is lost: earlier samples have all bits of the run, later ones are not read."""
    complete, sound = read_bag(whole), max(first - WINDOW, 0)
    bag = with_loss(whole, tmp_path / "lost", {HELD: json.dumps({topic: first}), SOUND: str(sound)}, sound)
    recording = read_bag(bag)
    for name, signals in recording.dense.items():
        for field, samples in signals.items():
            assert np.array_equal(samples, complete.dense[name][field][:sound])
    assert all(message.index < sound for name in recording.sparse for message in recording.messages(name))
    assert (
        recording.lost == f"not read from sample {sound} on: {topic} is held from sample {first} on, its node was lost"
    )
    assert recording.errors.rms.tolist() == complete.errors.rms[: recording.revolutions].tolist()
    verdict = part.verdict(scenario(tool={"tolerance": 1.0}), recording)
    assert not verdict.in_tolerance
    assert verdict.told() == f"not judged (±1e+06 µm): {recording.lost}"
    assert verdict.summary()["in_tolerance"] is None
    assert read_bag(bag, whole=True).samples == complete.samples, "the samples are there for those that ask"


def test_a_bag_of_an_earlier_version_ends_where_a_topic_is_held(whole, tmp_path):
    assert loss_of({HELD: '{"/tool": 900, "/cut": 700}'}).first == 700
    assert loss_of({}) is None
    for wrong in ("[]", '{"/tool": -1}', '{"/tool": "x"}', "{"):
        with pytest.raises(InputError, match=r"^lathe_rc.held = .* in the bag; allowed: what a recorder writes"):
            loss_of({HELD: wrong})
    with pytest.raises(InputError, match=r"^lathe_rc.sound = '-1' in the bag; allowed: what a recorder writes"):
        loss_of({SOUND: "-1"})


def test_a_copy_of_a_bag_names_the_loss_too(whole, lost, tmp_path):
    """A filtered copy, and one together with another bag, end where the members of the first were lost."""
    for name, words in (("part", ["--without", "/tool"]), ("both", [whole, "--topics", "/encoder"])):
        assert lathe("bag", "copy", lost, *words, "-o", tmp_path / name).exit_code == 0
        with BagSource(tmp_path / name) as copy:
            assert str(copy.loss) == WHY


def test_a_snapshot_around_the_loss_ends_with_it(lost, tmp_path):
    """A snapshot that begins in the middle of a run is read up to the loss, with the indices of the run."""
    first = TURN
    about = {SNAPSHOT: json.dumps({"first_sample": first, "samples": 0, "whole": False, "triggers": []})}
    recording = read_bag(with_loss(lost, tmp_path / "snapshot", about, SOUND_TO, first))
    assert (recording.first, recording.samples) == (first, SOUND_TO - first)
    assert recording.lost == WHY


def test_the_panel_and_the_view_of_a_bag_end_at_the_loss(lost):
    player = Player(lost)
    player.advance(player.samples)
    assert player.samples == SOUND_TO
    assert len(player.view._rows) == 2
    player.view.publish(player.told(), at_once=True)
    page = str(player.view.latest)
    assert not SEEN.search(page)
    assert WHY in page


# ---- faults of signals

FAULTS = {
    "coarse/state.position stuck": "electrodynamic_actuator",
    "coarse/state.position noisy rms=1e-6": "tool",
    "tool.error off": "tool",
    "tool.displacement wrong scale=0.5": "tool",
}


@pytest.mark.parametrize(("fault", "node"), FAULTS.items())
def test_no_form_error_rests_on_a_faulty_signal(fault, node, tmp_path):
    """From the first fault of a signal of the form error on, no revolution is measured, in the run and from its bag."""
    nodes: dict = {"spindle_encoder": {"revolutions": 3.0}, "tool": {"tolerance": 1.0}, "electrodynamic_actuator": {}}
    nodes[node]["faults"] = [f"revolution 2: {fault}"]
    cell = scenario({"allow_faults": True}, **nodes)
    result = harness.run(cell, bag=tmp_path / "bag")
    (begun,) = result.event_log
    why = f"from sample {begun.sample} on: {node}: fault {fault}"
    assert result.errors.rms.size == 2
    assert result.verdict.told() == f"not judged (±1e+06 µm): not measured {why}"
    assert result.summary()["not_measured"] == f"not measured {why}"
    assert read_bag(tmp_path / "bag").digests() == result.digest, "the signals themselves are recorded as they were"
    measured = lathe("measure", tmp_path / "bag", "--json")
    assert (measured.exit_code, json.loads(measured.output)["not_measured"]) == (1, f"not measured {why}")
    assert json.loads(lathe("bag", "info", tmp_path / "bag", "--json").output)["error_um"]["revolutions"] == 2
    told = gather(tmp_path / "bag")
    assert why in told.forms[0].refused
    assert assess(told, [], None).verdict.mood == BAD


def test_a_fault_of_what_only_controllers_read_leaves_the_form_error(tmp_path):
    """The part is cut as the true signals say, and the fault's effect on it is what a run with faults shows."""
    fault = {"faults": ["revolution 1: coarse/state.measured_position stuck"]}
    cell = scenario({"allow_faults": True}, electrodynamic_actuator=fault)
    result = harness.run(cell, bag=tmp_path / "bag")
    assert result.errors.rms.size == 3
    fitted = lathe("fit", "drive", tmp_path / "bag", "-o", tmp_path / "d.yaml")
    assert fitted.exit_code == 2
    assert (
        "electrodynamic_actuator: fault coarse/state.measured_position stuck; allowed: signals without" in fitted.output
    )


@pytest.mark.parametrize(("fault", "turns"), [("cut.measured_force off", 2), ("cut hard_spot factor=2.0", 4)])
def test_a_loop_is_judged_up_to_a_fault_of_its_sensor(fault, turns):
    """A dead force sensor shows no error; a hard spot is of the material, and the loop's error with it is real."""
    samples = 4 * 1000
    types = {"/encoder": messages.ENCODER, "/cut": messages.CUT, "/longitudinal/command": messages.SERVO}
    (watch,) = watches([ServoLoop("force", "longitudinal/command", FORCE, 0, 1.0, 5.0, 1e-3)], types)
    still = np.zeros(samples)
    servo = {"set_point": still + 100.0, "error": still, "command": still}
    dense = {"/encoder": {"angle_true": np.linspace(0.0, 8.0 * np.pi, samples)}, "/longitudinal/command": servo}
    event = Sparse("/cutting_process/events", messages.EVENT, 2500, {"action": f"fault {fault}"})
    watch.chunk(0, samples, dense, {event.topic: [event]})
    result = watch.result()
    assert result.found.errors.rms.size == turns
    assert result.verdict.in_tolerance == (turns == 4)
    assert result.why == ("" if turns == 4 else f"not measured from sample 2500 on: cutting_process: fault {fault}")


def test_a_copy_of_what_follows_the_loss_has_nothing_to_read(lost, tmp_path):
    assert (
        lathe("bag", "copy", lost, "--start", (SOUND_TO + TURN) * STEP * 1e-9, "-o", tmp_path / "rest").exit_code == 0
    )
    recording = read_bag(tmp_path / "rest")
    assert (recording.samples, recording.lost) == (0, WHY)
    done = lathe("measure", tmp_path / "rest")
    assert done.exit_code == 2
    assert WHY in done.output
