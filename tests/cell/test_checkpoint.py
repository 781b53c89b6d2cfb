# SPDX-License-Identifier: Apache-2.0
"""Checkpoints: a run that goes on from one gives the bits of the uninterrupted run."""

import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from bags import lathe, sized, some
from cells import in_two
from test_restart import OWN, Killer

import lathe_rc
from lathe_bagtools.resimulation.resim import resimulate
from lathe_explore.sweep import row
from lathe_rc import data_file, harness
from lathe_rc.bag import check
from lathe_rc.cell import checkpoint
from lathe_rc.cell.recording import Recording
from lathe_rc.errors import InputError
from lathe_rc.harness.result import Mode

LONG = ["spindle_encoder.revolutions=5"]
SCENARIOS = (
    *("piston", "full_cell", "supervised_two_channel", "periodic", "robust", "gauged", "loaded_cutting", "vibration"),
    *("supervised_turning", "series", "oval3000_hard"),
)


def rest(whole: Recording, first: int) -> dict[str, str]:
    """Return the digests of a recording from a sample on."""
    dense = {topic: {name: array[first:] for name, array in part.items()} for topic, part in whole.dense.items()}
    sparse = {}
    for topic, part in whole.sparse.items():
        count = sum(message.index < first for message in whole.messages(topic))
        sparse[topic] = type(part)(part.stamps[count:], {name: found[count:] for name, found in part.values.items()})
        # Without any message there are no fields either.
        sparse[topic] = sparse[topic] if sparse[topic].stamps else type(part)()
    return Recording(whole.types, dense, sparse, whole.step_ns).digests()


def gone_on(name: str, folder: Path, count: int, seed: int = 1, modes: Sequence[Mode] = ("offline",)) -> None:
    """Check that a scenario gives the same bits from each of some random samples on."""
    scenario = lathe_rc.load(name, LONG)
    samples = lathe_rc.run(scenario).samples
    places = sorted((np.random.default_rng([seed, *name.encode()]).permutation(samples - 1)[:count] + 1).tolist())
    whole = lathe_rc.run(scenario, checkpoints={f"sample:{place}": folder / f"{place}" for place in places})
    assert whole.digest == lathe_rc.run(scenario).digest, "checkpoints change nothing"
    for place, mode in product(places, modes):
        found = lathe_rc.run(scenario, mode=mode, groups=in_two(scenario), start_from=folder / f"{place}")
        assert (found.recording.first, found.samples) == (place, samples - place)
        assert found.digest == rest(whole.recording, place), f"{name} from sample {place}, {mode}"


@pytest.mark.parametrize("name", SCENARIOS[:5])
def test_a_run_goes_on_from_any_sample_with_the_same_bits(name: str, tmp_path: Path) -> None:
    """A run that goes on from a checkpoint at a random sample gives the bits of the uninterrupted run."""
    gone_on(name, tmp_path, 2)


def test_a_run_goes_on_after_faults_with_the_same_bits(tmp_path: Path) -> None:
    """One in force of each kind with a state of its own, and one repaired; those of a random sequence go on in it."""
    target, values = "coarse/state.measured_position", {"garbage": "amplitude=1e-7", "noisy": "rms=1e-8", "stuck": ""}
    values |= {"slow": "time=1e-3", "delayed": "time=1e-3", "intermittent": "good=1e-3 off=1e-4", "wrong": "scale=0.9"}
    ends = {"stuck": " to 1.2", "garbage": " to 2.5"}
    faults = [f"revolution 1.1{ends.get(kind, '')}: {target} {kind} {given}" for kind, given in values.items()]
    given = ["allow_faults=true", f"electrodynamic_actuator.faults={json.dumps(faults)}"]
    lost = "spindle_encoder.faults=['revolution 1.3: encoder lost_counts angle=1e-6']"
    scenario = lathe_rc.load("piston", [*LONG, *given, lost])
    whole = lathe_rc.run(scenario, checkpoints={"revolution:2": tmp_path / "broken"})
    found = lathe_rc.run(scenario, start_from=tmp_path / "broken")
    assert found.digest == rest(whole.recording, found.recording.first)


@pytest.mark.system
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_run_goes_on_from_twenty_samples_with_the_same_bits(name: str, tmp_path: Path) -> None:
    """The same from 20 random samples of each of ten scenarios."""
    gone_on(name, tmp_path, sized(20), seed=2)


@pytest.mark.system
@pytest.mark.parametrize("name", some(SCENARIOS, 3))
def test_nodes_go_on_from_twenty_samples_with_the_same_bits(name: str, tmp_path: Path) -> None:
    """The same composed and as processes."""
    gone_on(name, tmp_path, sized(20), seed=3, modes=("composed", "processes"))


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a checkpoint of the piston before revolution 3."""
    path = tmp_path_factory.mktemp("learned") / "piston.ckpt"
    lathe_rc.run(lathe_rc.load("piston", LONG), checkpoints={"revolution:3": path})
    return path


def test_the_first_revolution_after_a_checkpoint_at_a_revolution_is_complete(learned: Path) -> None:
    whole, found = (lathe_rc.run(lathe_rc.load("piston", LONG), start_from=path) for path in (None, learned))
    assert np.array_equal(found.errors.rms, whole.errors.rms[3:])


@pytest.mark.parametrize("changed", [{"learning_gain": 0.3}, {"lead_time": 1.3e-3}, {"q_time": 9e-5}])
def test_other_parameters_act_from_the_checkpoint_on(changed: dict[str, float], learned: Path) -> None:
    """A run with other parameters gives the bits of one in which an event sets them at the checkpoint."""
    ((key, value),) = changed.items()
    first = checkpoint.sample_of("revolution:3", lathe_rc.cell.wiring.Cell(lathe_rc.load("piston", LONG).nodes).master)
    other = lathe_rc.load("piston", [*LONG, f"learning_controller.{key}={value}"])
    event = f"learning_controller.events=['sample {first}: set {key} {value}']"
    told = lathe_rc.run(lathe_rc.load("piston", [*LONG, event])).recording
    found = lathe_rc.run(other, start_from=learned).recording
    for topic, signals in found.dense.items():
        for name, array in signals.items():
            assert np.array_equal(array, told.dense[topic][name][first:]), f"{topic}.{name}"


def test_a_batch_gives_the_bits_of_single_runs_from_each_checkpoint(learned: Path, tmp_path: Path) -> None:
    """Cells of a batch that start from two checkpoints, or from none, give the bits of single runs."""
    lathe_rc.run(lathe_rc.load("piston", LONG), checkpoints={"revolution:2": tmp_path / "early"})
    base = lathe_rc.load("piston", LONG).named()
    varied = [
        base.varied({"spindle_encoder.start_from": str(start), "learning_controller.learning_gain": gain})
        for gain in (0.5, 0.6, 0.7)
        for start in (learned, learned, tmp_path / "early", "")
    ]
    for outcome in lathe_rc.run_many(varied, threads=1):
        alone = lathe_rc.run(outcome.scenario)
        assert np.array_equal(outcome.kept.rms, alone.errors.rms), outcome.scenario
    (found,) = lathe_rc.run_many([varied[0]], ["tool"])
    assert found.kept.digests()["/tool"] == lathe_rc.run(varied[0]).digest["/tool"]


def test_rows_of_a_sweep_go_on_from_the_checkpoint(learned: Path) -> None:
    """The row of a cell has the digest, the revolutions and the verdict of the run from the checkpoint."""
    told = f"spindle_encoder.start_from={learned}"
    scenario = lathe_rc.load("piston", [*LONG, told, "tool.tolerance=5.0e-6"])
    found, alone = row.compute(scenario, {}, [], [row.measure("tool.error:max", scenario)]), lathe_rc.run(scenario)
    assert (found["digest"], found["samples"]) == (row.digest(alone.recording, []), alone.samples)
    assert found["tool.in_tolerance_from"] == alone.verdict.since
    assert found["tool.error:max"] == alone.errors.largest[-1]


def test_nodes_go_on_from_a_checkpoint_with_the_same_bits(tmp_path: Path) -> None:
    """A cell of nodes goes on from any sample, composed or as processes; its bag begins there and passes its check."""
    scenario = lathe_rc.load("full_cell", ["spindle_encoder.revolutions=2"])
    whole = lathe_rc.run(scenario, checkpoints={"sample:1903": tmp_path / "file"}).recording
    modes: tuple[Mode, ...] = ("composed", "processes")
    for mode in modes:
        found = lathe_rc.run(scenario, mode=mode, start_from=tmp_path / "file", bag=tmp_path / mode)
        checked = check.check(tmp_path / mode)
        assert (checked.lost, checked.wrong, checked.first) == ([], [], 1903)
        assert checked.digests == found.digest == rest(whole, 1903)


@pytest.mark.system
def test_a_controller_that_is_killed_after_a_checkpoint_goes_on_to_the_bit(tmp_path: Path) -> None:
    scenario = lathe_rc.load("piston", ["spindle_encoder.revolutions=20", f"{OWN}.restart_file={tmp_path}/state"])
    whole = lathe_rc.run(scenario, checkpoints={"sample:5003": tmp_path / "file"}).recording
    killer = Killer(OWN, [20_000])
    found = lathe_rc.run(scenario, mode="processes", start_from=tmp_path / "file", watch=killer)
    assert found.digest == rest(whole, 5003)
    assert killer.all("resumed")


def test_a_member_refuses_a_damaged_checkpoint_in_one_line(learned: Path, tmp_path: Path) -> None:
    """Nodes that nobody has checked before their start end with one line, which names the file."""
    file = tmp_path / "file"
    file.write_bytes(learned.read_bytes()[:-200])
    scenario = lathe_rc.load("piston", [*LONG, f"spindle_encoder.start_from={file}"])
    complete = harness.with_recorder(scenario, tmp_path / "bag", keep=False)
    with harness.Processes(complete, [list(complete.nodes)]) as cell, pytest.raises(InputError) as caught:
        cell.wait_for_end()
    assert str(caught.value) == f"{file}: damaged (it has no checksum); make it anew"


def test_nodes_write_no_checkpoint_and_keep_no_snapshots_after_one(learned: Path, tmp_path: Path) -> None:
    """Nodes refuse to write checkpoints, and snapshots of a run from one, before any process starts."""
    with pytest.raises(InputError, match="allowed: offline"):
        lathe_rc.run(lathe_rc.load("piston", LONG), mode="composed", checkpoints={"sample:9": tmp_path / "file"})
    scenario = lathe_rc.load("piston", [*LONG, "recorder.mode=both"])
    with pytest.raises(InputError, match="snapshots of a run from a checkpoint"):
        lathe_rc.run(scenario, mode="composed", start_from=learned, bag=tmp_path / "bag")


def test_events_behind_the_checkpoint_are_not_repeated_and_new_ones_act(tmp_path: Path) -> None:
    before = lathe_rc.load("piston", [*LONG, "learning_controller.events=['revolution 1: freeze']"])
    lathe_rc.run(before, checkpoints={"revolution:2": tmp_path / "file"})
    events = "learning_controller.events=['revolution 1: freeze', 'revolution 4: learn']"
    after = lathe_rc.load("piston", [*LONG, events])
    found = lathe_rc.run(after, start_from=tmp_path / "file")
    assert [event.text for event in found.event_log] == ["learn"]
    assert found.digest == rest(lathe_rc.run(after).recording, found.recording.first)


REFUSED = {
    "nominal_rpm=900.0": "goes on only with the parameters of the checkpoint; allowed: spindle_encoder.nominal_rpm",
    "electrodynamic_actuator.delay=1.0e-3": "the state of electrodynamic_actuator depends on what differs here",
    "spindle_encoder.revolutions=2.0": "the run ends at",
    "learning_controller.feedback_delay=20000": "allowed:",
    "seed=1": "goes on only with the parameters of the checkpoint; allowed: spindle_encoder.seed = 0",
}


@pytest.mark.parametrize(("override", "why"), REFUSED.items())
def test_parameters_on_which_the_state_depends_are_refused(override: str, why: str, learned: Path) -> None:
    with pytest.raises(InputError, match=why) as caught:
        lathe_rc.run(lathe_rc.load("piston", [*LONG, override]), start_from=learned)
    assert "\n" not in str(caught.value)


def changed(path: Path, **told: object) -> bytes:
    """Return the content of a checkpoint with some entries replaced."""
    return data_file.packed("checkpoint", {**data_file.read(path, "checkpoint", dict), **told})


def test_damaged_foreign_and_other_versions_files_are_refused_in_one_line(learned: Path, tmp_path: Path) -> None:
    """A damaged, foreign or mismatched file is refused in one line, and one that names code is not run."""
    good, file = learned.read_bytes(), tmp_path / "file"
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 1
    code = ["attributes", {"_model": ["object", "os:_wrap_close", {}]}]
    wrong = {
        "not a checkpoint": b"PK" + good,
        "damaged": bytes(flipped),
        "checksum": good[:-200],
        "made with lathe_rc": changed(learned, made_with={"lathe_rc": "0.0.1"}),
        "not the state of spindle_encoder": changed(learned, stages={"spindle_encoder": ["list", []]}),
        "not the state of learning_controller .*no class of data": changed(
            learned, stages=dict.fromkeys(lathe_rc.load("piston").nodes) | {"learning_controller": code}
        ),
        "holds no node spindle_encoder": changed(learned, nodes={}),
        "cannot be read": b"",
    }
    for why, content in wrong.items():
        file.write_bytes(content)
        place = tmp_path / "missing" if why == "cannot be read" else file
        with pytest.raises(InputError, match=why) as caught:
            lathe_rc.run(lathe_rc.load("piston", LONG), start_from=place)
        assert "\n" not in str(caught.value)


def test_the_bag_of_a_run_from_a_checkpoint_is_sound(learned: Path, tmp_path: Path) -> None:
    """The bag begins at the checkpoint, passes its check, and gives the digests of the run."""
    found = lathe_rc.run(lathe_rc.load("piston", LONG), start_from=learned, bag=tmp_path / "bag")
    checked = check.check(tmp_path / "bag")
    assert (checked.lost, checked.wrong, checked.first) == ([], [], found.recording.first)
    assert checked.digests == found.digest == lathe_rc.read_bag(tmp_path / "bag").digests()


EVENTS = "learning_controller.events=['revolution 1: freeze', 'revolution 2: learn', 'revolution 4: freeze']"
AROUND = ["pre=0.1", "post=0.02", "triggers=['*: freeze']", "mode=both"]


def test_a_bag_is_resimulated_from_a_checkpoint(tmp_path: Path) -> None:
    """A re-simulation goes on from a checkpoint in a bag or a snapshot with its bits, or with other parameters."""
    file, bag = tmp_path / "file", tmp_path / "bag"
    scenario = lathe_rc.load("piston", [*LONG, EVENTS, *(f"recorder.{told}" for told in AROUND)])
    whole = lathe_rc.run(scenario, checkpoints={"revolution:3": file}, bag=bag)
    first, end = lathe_rc.run(scenario, start_from=file).recording.first, whole.samples
    for path, last in ((bag, end), (whole.snapshots[-1], None)):
        found = resimulate(path, start_from=file)
        assert (found.changed, found.different, found.missing, found.first) == (False, [], [], first)
        assert last is None or found.first + found.samples == last
        assert len(found.recorded) == len(whole.digest)
    changed = resimulate(bag, ["learning_controller.learning_gain=0.3"], start_from=file)
    assert "/coarse/command" in changed.different
    assert (changed.turns_before, changed.recorded_rms.tolist()) == (3, whole.errors.rms[3:].tolist())


def test_a_bag_of_a_run_from_a_checkpoint_carries_it(learned: Path, tmp_path: Path) -> None:
    """The re-simulation of a bag that begins at a checkpoint needs no other file."""
    file = tmp_path / "file"
    file.write_bytes(learned.read_bytes())
    bag = lathe_rc.run(lathe_rc.load("piston", LONG), start_from=file, bag=tmp_path / "bag").bag
    file.unlink()
    assert bag is not None
    found = resimulate(bag)
    assert (found.changed, found.different, found.missing) == (False, [], [])
    assert found.recorded


def test_a_checkpoint_outside_of_a_bag_is_refused(learned: Path, tmp_path: Path) -> None:
    lathe_rc.run(lathe_rc.load("piston", ["spindle_encoder.revolutions=2"]), bag=tmp_path / "bag")
    with pytest.raises(InputError, match="the run ends at"):
        resimulate(tmp_path / "bag", start_from=learned)
    with pytest.raises(InputError, match="allowed: with the scenario of the bag"):
        resimulate(tmp_path / "bag", scenario=Path("piston"), start_from=learned)


def test_the_command_writes_checkpoints_and_goes_on_from_them(learned: Path, tmp_path: Path) -> None:
    file = tmp_path / "file"
    told = lathe("run", "piston", "--revolutions", "4", "--checkpoint", "revolution:3", str(file)).stdout
    assert f"checkpoint at revolution:3: {file}" in told.replace("\n", "")
    found = json.loads(lathe("run", "piston", "--revolutions", "5", "--from", str(file), "--json").stdout)
    whole = lathe_rc.run(lathe_rc.load("piston", LONG))
    assert found["digest"] == rest(whole.recording, found["first_sample"])
