# SPDX-License-Identifier: Apache-2.0
"""Re-simulation: a recorded run comes out again to the bit, and a changed controller does what it should."""

import json
import shutil

import numpy as np
import pytest
from bags import lathe, storage_of
from cells import every_scenario, scenario
from numpy.testing import assert_allclose
from sealed_bags import retold

from lathe_bagtools.resimulation.resim import resimulate
from lathe_rc import harness
from lathe_rc.bag import provenance, reader
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.stream import feed
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.running_form import RunningForm
from lathe_rc.errors import InputError
from lathe_rc.judge import part
from lathe_rc.signals.form_errors import form_errors

EVENTS = {"events": ["revolution 5.5: freeze", "second 0.3: learn"]}
DEVIATION = {"deviation_amplitude": [0.1], "deviation_frequency": [10.7]}


def made(**nodes):
    spindle = {"revolutions": 15.0, **DEVIATION}
    form = {"profile": "harmonics", "harmonic_order": [2], "harmonic_amplitude": [100e-6], "harmonic_phase": [0.0]}
    given = {"spindle_encoder": spindle, "tool": form, **nodes}
    return scenario(**given)


@pytest.fixture(scope="module")
def nodes(tmp_path_factory):
    """A run of nodes, with events on the way."""
    path = tmp_path_factory.mktemp("nodes") / "bag"
    return path, harness.run(made(learning_controller=EVENTS), mode="composed", bag=path)


def test_an_unchanged_run_of_nodes_comes_out_to_the_bit(nodes):
    path, result = nodes
    found = lathe("resim", path, "--json")
    assert found.exit_code == 0
    told = json.loads(found.stdout)
    assert (told["equal"], told["changed"], told["different"]) == (True, False, [])
    assert told["digest"] == result.digest
    assert np.array_equal(told["rms_um"], result.errors.rms * 1e6)


@pytest.mark.parametrize("path", every_scenario())
def test_every_scenario_comes_out_to_the_bit(path, tmp_path):
    """Every scenario is simulated again to the bit, whatever its stages announce, like a channel that joins."""
    loaded = scenarios.load(path, ["spindle_encoder.revolutions=25", "spindle_encoder.speed_factor=0"])
    harness.run(loaded, bag=tmp_path / "bag")
    found = resimulate(tmp_path / "bag")
    assert (found.changed, found.different, found.missing) == (False, [], [])


def test_what_it_writes_is_the_bag_again(nodes, tmp_path):
    path, result = nodes
    assert lathe("resim", path, "-o", tmp_path / "again").exit_code == 0
    assert reader.read_bag(tmp_path / "again").digests() == result.digest
    signals = {topic for topic, kind in result.recording.types.items()}
    with BagSource(path) as old, BagSource(tmp_path / "again") as new:
        assert list(old.messages(signals)) == list(new.messages())


def test_a_changed_lead_shows_the_change_of_a_run_with_that_lead(nodes):
    path, _ = nodes
    change = "learning_controller.lead_time=1.2e-3"
    found = resimulate(path, [change])
    expected = harness.run(made(learning_controller={"lead_time": 1.2e-3, **EVENTS}))
    assert found.changed
    assert set(found.different) == {
        "/coarse/command", "/coarse/learning", "/coarse/state", "/tool", "/tool/joint_states",
        "/electrodynamic_actuator/joint_states",
    }  # fmt: skip
    assert_allclose(found.rms, expected.errors.rms, rtol=1e-12)
    assert found.rms[-1] > 1.3 * found.recorded_rms[-1]
    shown = lathe("resim", path, "--set", change)
    assert shown.exit_code == 0
    assert "different from the recording: /coarse/command" in shown.stdout


def test_a_controller_from_a_file_takes_the_place_of_the_recorded_one(nodes, tmp_path):
    path, result = nodes
    file = tmp_path / "mine.yaml"
    text = "/learning_controller: {ros__parameters: {feedback_delay: 2048, learning_gain: 0.5}}"
    file.write_text(text)
    found = resimulate(path, controller=file)
    assert found.scenario.nodes["learning_controller"].learning_gain == 0.5
    assert found.rms[3] > result.errors.rms[3]
    file.write_text(text.replace("learning_controller", "another"))
    assert "no node 'another' in the bag's scenario" in lathe("resim", path, "--controller", file).stderr


def test_the_recorded_spindle_counts_not_the_law(nodes, tmp_path):
    """A bag whose spindle really turned otherwise than its parameters say."""
    other = tmp_path / "other"
    slow = {"revolutions": 15.0, "deviation_amplitude": [0.05], "deviation_frequency": [7.0]}
    harness.run(made(spindle_encoder=slow), bag=other)
    said = provenance.SCENARIO
    retold(other, lambda about: about.update({said: about[said].replace("amplitude: [0.05]", "amplitude: [0.02]")}))
    with BagSource(other) as source:
        assert "deviation_amplitude: [0.02]" in source.about[provenance.SCENARIO]
    assert resimulate(other).different == []


def test_the_bag_holds_the_files_of_its_scenario(tmp_path):
    form, bag = tmp_path / "form.csv", tmp_path / "bag"
    form.write_text("angle_deg,radius_um\n0,0\n120,30\n240,-10\n")
    harness.run(scenario(tool={"profile": "csv", "profile_file": str(form)}), bag=bag)
    form.unlink()
    assert resimulate(bag).different == []


def test_versions_and_identity_are_in_the_bag(nodes):
    path, result = nodes
    with BagSource(path) as source:
        assert json.loads(source.about[provenance.VERSIONS])["numpy"] == np.__version__
        assert source.about[provenance.RUN_ID] == result.scenario.shared.run_id
        assert json.loads(source.about[provenance.HOST_TOPICS]) == ["/diagnostics", "/cell_state"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("spindle_encoder.nominal_rpm=900", "the spindle and what all nodes share come from the bag"),
        ("block_size=32", "the spindle and what all nodes share come from the bag"),
        ("tool.fed=1", "tool.fed: unknown parameter"),
        ("learning_controller.lead_time=0.02", "learning diverges"),
    ],
)
def test_changes_that_cannot_be_are_refused(nodes, change, said):
    found = lathe("resim", nodes[0], "--set", change)
    assert found.exit_code == 2
    assert said in found.stderr


def test_a_lone_file_has_the_scenario_and_a_bag_without_one_says_what_is_missing(nodes, tmp_path):
    bag = shutil.copytree(nodes[0], tmp_path / "bag")
    assert resimulate(storage_of(bag)).different == []
    retold(bag, dict.clear)
    with pytest.raises(InputError, match="the bag holds no scenario"):
        resimulate(bag)


@pytest.mark.parametrize("piece", [64, 1000, 65536])
@pytest.mark.parametrize("together", [2, 16])
def test_errors_by_revolution_and_the_first_and_last_are_those_of_the_whole(nodes, piece, together, monkeypatch):
    path, result = nodes
    monkeypatch.setattr(part, "_TOGETHER", together)
    ends, errors = part.FirstAndLast(result.recording.types), RunningForm.of(result.recording.types)
    feed(path, [ends, errors], piece=piece)
    told, whole = ends.numbers(), part.measured(result.recording)
    angle = result.recording.dense["/encoder"]["angle_true"]
    assert np.array_equal(errors.found().rms, form_errors(angle, result.recording.dense["/tool"]["error"]).rms)
    assert told["revolutions"] == whole.form.rms.size
    for name, revolution in (("first", 0), ("last", -1)):
        for key, value in part.numbers(whole, revolution).items():
            # Splines of a piece differ from those of the whole by what the far ends do.
            if key != "largest_upr":
                assert_allclose(told[name][key], value, rtol=1e-6, atol=1e-9, err_msg=f"{name} {key}")


def test_other_events_than_those_of_the_bag_are_refused(nodes, tmp_path):
    said = "events and faults come from the bag, as they took effect; leave"
    for asked in ("learning_controller.events=['revolution 5: freeze']", "electrodynamic_actuator.faults=[]"):
        with pytest.raises(InputError, match=rf"^--set .*: {said}"):
            resimulate(nodes[0], [asked])
    file = tmp_path / "controller.yaml"
    file.write_text("/learning_controller: {ros__parameters: {events: ['revolution 5: freeze']}}")
    with pytest.raises(InputError, match=rf"^learning_controller.events = \['revolution 5: freeze'\]: {said}"):
        resimulate(nodes[0], controller=file)
