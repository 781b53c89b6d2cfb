# SPDX-License-Identifier: Apache-2.0
"""Laws, drives, stages and studies from outside of lathe_rc: in every host, checked as ours, found by name."""

import importlib
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from bags import lathe
from machines import line_of

import own_spindle
from lathe_bagtools import hosts
from lathe_rc import extensions, harness
from lathe_rc.cell import scenario
from lathe_rc.cell.kinds import STAGES
from lathe_rc.cell.wiring import Cell
from lathe_rc.compiled.struct_view import explain_unfit
from lathe_rc.errors import InputError, LatheError

SHORT = "spindle_encoder.revolutions=4.0"


@pytest.fixture
def begin(tmp_path, monkeypatch):
    """Makes a package with ``lathe new`` and stands in its folder."""

    def make(kind, name, *options):
        monkeypatch.chdir(tmp_path)
        made = lathe("new", kind, name, *options)
        assert made.exit_code == 0, made.output
        monkeypatch.chdir(tmp_path / name)
        monkeypatch.syspath_prepend(tmp_path / name)
        return tmp_path / name / f"{name}.yaml"

    return make


def edit(package, old, new):
    """Change the source of a package that has not been imported yet."""
    path = Path(package) / "__init__.py"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


# --- in every host


#: law, drive and stage of others, each as in the cell that ``lathe new`` makes for it
TOGETHER = """
/spindle_encoder: {ros__parameters: {deviation_amplitude: [0.1], deviation_frequency: [10.7]}}
/my_law: {ros__parameters: {stage: "my_law:MyLaw", feedback_delay: 3200, stop_ratio: 2.0}}
/my_stage: {ros__parameters: {stage: "my_stage:MyStage"}}
/my_plant: {ros__parameters: {stage: "my_plant:MyPlant", remap: ["coarse/command:=coarse/smoothed"]}}
/tool: {ros__parameters: {profile: harmonics}}
"""


#: a spindle of others, before our controller, drive and tool
LED = """
/turning: {ros__parameters: {stage: "own_spindle:Spindle", revolutions: 2.0}}
/learning_controller: {ros__parameters: {feedback_delay: 3200}}
/electrodynamic_actuator: {ros__parameters: {}}
/tool: {ros__parameters: {profile: harmonics}}
"""


@pytest.mark.parametrize(
    "kinds", [pytest.param(["law", "plant", "stage"], marks=pytest.mark.system), ["plain law"]], ids=" ".join
)
def test_what_lathe_new_writes_has_the_same_bits_in_every_host(begin, tmp_path, kinds):
    """Law, drive and stage of others in one cell, and a law in plain Python in the cell that is made for it."""
    if kinds == ["plain law"]:
        file = begin("law", "my_law_plain", "--plain")
    else:
        for kind in kinds:
            begin(kind, f"my_{kind}")
        file = tmp_path / "together.yaml"
        file.write_text(TOGETHER, encoding="utf-8")
    found = hosts.digests_by_host(scenario.load(file, ["spindle_encoder.revolutions=2.0"]), tmp_path)
    assert set(found) == {"offline", "bag", "simulated again", "blocks of 23", "batch", "composed", "processes"}
    assert {host for host, topics in found.items() if topics != found["offline"]} == set()


def test_a_spindle_of_others_leads_a_cell_in_every_host(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(own_spindle.__file__).parent), prepend=os.pathsep)
    file = tmp_path / "own.yaml"
    file.write_text(LED)
    found = hosts.digests_by_host(scenario.load(file), tmp_path)
    assert set(found) == {"offline", "bag", "simulated again", "blocks of 23", "batch", "composed", "processes"}
    assert {host for host, topics in found.items() if topics != found["offline"]} == set()


LAZY = """
import own_spindle
def step(speed, first, start, inputs, flags, outputs):
    return own_spindle.step(speed, first, start, inputs, flags, [*outputs[:3], outputs[3].copy(), outputs[4]])
class Spindle(own_spindle.Spindle):
    step = staticmethod(step)
"""


@pytest.mark.parametrize("mode", ["offline", "composed", "processes"])
def test_a_field_that_a_step_does_not_fill_is_refused(mode, tmp_path, monkeypatch):
    """It was zero offline, and whatever was in the memory of a node."""
    folders = os.pathsep.join(map(str, (tmp_path, Path(own_spindle.__file__).parent)))
    monkeypatch.setenv("PYTHONPATH", folders, prepend=os.pathsep)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lazy_spindle.py").write_text(LAZY)
    file = tmp_path / "own.yaml"
    file.write_text(LED.replace("own_spindle:", "lazy_spindle:"))
    with pytest.raises(LatheError, match="turning sends angle_true = nan at sample 0; allowed: finite numbers"):
        harness.run(scenario.load(file), mode=mode)


@pytest.mark.parametrize("kind", ["law", "plant", "stage"])
def test_plain_python_has_the_bits_of_the_compiled_step(begin, kind):
    digests = []
    for name, options in ((f"my_{kind}", []), (f"my_{kind}_plain", ["--plain"])):
        result = harness.run(scenario.load(begin(kind, name, *options), [SHORT]))
        digests.append({topic: result.digest[topic] for topic in ("/tool", "/coarse/command", "/coarse/state")})
    assert digests[0] == digests[1]


def test_a_law_and_a_drive_learn_and_are_checked(begin):
    """The piston's error falls to a hundredth, and nothing is unchecked."""
    for kind in ("law", "plant"):
        result = harness.run(scenario.load(begin(kind, f"my_{kind}")))
        assert result.unchecked == []
        assert result.errors.rms[-1] < 0.01 * result.errors.rms[0]


def test_a_study_runs_from_its_folder(begin):
    begin("study", "my_study")
    study = importlib.import_module("my_study").STUDY
    rms = study.run(study.parameters(gains=[0.5, 1.0], revolutions=6.0)).rms
    assert rms[1][-1] < rms[0][-1] < rms[0][0]


# --- the check before the start


def refused(file, *changes):
    return line_of(lambda: harness.run(scenario.load(file, [SHORT, *changes])))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("lead_time=2.2e-3", "my_law: learning diverges with electrodynamic_actuator: sup|factor"),
        ("feedback_delay=3900", "my_law.feedback_delay = 3900 samples: at 115.2 rad/s the cycle leaves 3"),
    ],
)
def test_a_law_that_converges_with_no_drive_or_lacks_the_time_is_refused(begin, change, said):
    assert refused(begin("law", "my_law"), f"my_law.{change}").startswith(said)


def test_a_law_that_tells_nothing_is_unchecked_and_stopped_when_it_diverges(begin):
    file = begin("law", "silent_law", "--plain")
    edit("silent_law", "    def contraction(self", "    def not_told(self")
    edit("silent_law", "    def largest_delay(self", "    def not_told_either(self")
    told = []
    result = harness.run(scenario.load(file, [SHORT]), watch=told.append)
    assert [each.partition(": ")[2] for each in result.unchecked] == [
        "SilentLaw tells no longest feedback_delay",
        "SilentLaw tells no factor of a cycle: nobody knows if it converges",
    ]
    assert [event["message"] for event in told if event["event"] == "unchecked"] == result.unchecked
    late = ["silent_law.lead_time=8e-3"]
    with pytest.raises(LatheError, match=r"silent_law: sample \d+: the error grows: .* stop_ratio = 2") as stopped:
        harness.run(scenario.load(file, late))
    assert stopped.value.exit_code == 1
    harness.run(scenario.load(file, [*late, "silent_law.stop_ratio=0.0", "silent_law.allow_unstable=true"]))


def test_a_drive_that_tells_no_response_needs_a_controller_that_stops(begin):
    file = begin("plant", "silent_plant", "--plain")
    edit("silent_plant", "    def response(self", "    def not_told(self")
    assert refused(file).startswith("learning_controller: no drive tells its response to coarse/command")
    stops = ["learning_controller.stop_ratio=2.0"]
    assert len(harness.run(scenario.load(file, [SHORT, *stops])).unchecked) == 1
    with pytest.raises(LatheError, match=r"learning_controller: sample \d+: the error grows"):
        harness.run(scenario.load(file, [*stops, "silent_plant.delay=6e-3", "spindle_encoder.revolutions=60.0"]))


# --- events and the supervisor


def test_a_law_is_frozen_and_cleared_by_events(begin):
    file = begin("law", "my_law")
    events = 'my_law.events=["revolution 6: freeze", "revolution 8: learn", "revolution 10: clear"]'
    rms = harness.run(scenario.load(file, [events, "spindle_encoder.revolutions=14.0"])).errors.rms
    assert rms[11] > 10 * rms[9], "it has forgotten"
    assert rms[13] < 0.1 * rms[11], "and learns again"


# --- finding classes


@pytest.mark.parametrize(
    ("text", "stage", "said"),
    [
        ("", "nowhere_law:Law", "cannot be imported: ModuleNotFoundError: No module named 'nowhere_law'"),
        ("", "found_0:Law", "found_0 has no 'Law'"),
        ("Law = 3", "found_1:Law", "is 3; allowed: a class that derives from lathe_rc.cell.stage.Stage"),
        ("raise RuntimeError('no\\nlicence')", "found_2:Law", "cannot be imported: RuntimeError: no"),
    ],
)
def test_a_class_that_cannot_be_had_is_refused_in_one_line(tmp_path, monkeypatch, text, stage, said):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path(f"{stage.partition(':')[0]}.py").write_text(text) if "nowhere" not in stage else None
    Path("cell.yaml").write_text(f'/law:\n  ros__parameters:\n    stage: "{stage}"\n')
    refused = line_of(lambda: scenario.load(Path("cell.yaml")))
    assert said in refused


def offer(folder, distribution, value, version="1.0"):
    """Pretend that a distribution is installed which offers the stage ``shared_name``."""
    info = folder / f"{distribution}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
    (info / "entry_points.txt").write_text(f"[lathe_rc.stages]\nshared_name = {value}\n")


def test_two_packages_that_offer_one_name_are_refused(tmp_path, monkeypatch):
    offer(tmp_path, "first_maker", "first:Law")
    offer(tmp_path, "other_maker", "other:Law")
    monkeypatch.syspath_prepend(tmp_path)
    extensions._offered_along.cache_clear()
    with pytest.raises(InputError, match=r"first_maker 1.0 and other_maker 1.0 offer 'shared_name'"):
        "shared_name" in STAGES  # noqa: B015 - it raises
    monkeypatch.undo()
    extensions._offered_along.cache_clear()


def test_where_a_class_comes_from_is_known(begin):
    begin("law", "my_law")
    assert STAGES.origin("tool") is None
    assert STAGES.origin("my_law:MyLaw") == {"class": "my_law:MyLaw", "source": extensions.source_hash("my_law")}


# --- lathe new


def test_a_folder_that_exists_is_left_alone(begin):
    begin("law", "twice")
    os.chdir("..")
    before = sorted(Path("twice").rglob("*"))
    assert lathe("new", "law", "twice").exit_code == 2
    assert sorted(Path("twice").rglob("*")) == before


def test_the_contraction_that_a_law_tells_is_that_of_its_run(begin):
    """Per revolution the error of the oval falls by the factor that the law tells for two waves."""
    file = begin("law", "my_law")
    steady = ["spindle_encoder.deviation_amplitude=[0.0]", "spindle_encoder.revolutions=8.0"]
    loaded = scenario.load(file, [*steady, "my_law.learning_gain=0.3"])
    cell = Cell(loaded.nodes)
    law, drive = cell.stages["my_law"], cell.stages["electrodynamic_actuator"]
    speed = loaded.shared.nominal_speed
    factor = abs(law.contraction(drive.responses()["coarse/command"], np.array([2.0]), speed)[0])
    rms = harness.run(loaded).errors.rms
    assert rms[5] / rms[4] == pytest.approx(factor, rel=0.02)


# --- the page


def test_the_law_on_the_page_runs(begin):
    page = (Path(__file__).parents[2] / "docs" / "extending.md").read_text(encoding="utf-8")
    file = begin("law", "paged", "--plain")
    Path("integral.py").write_text(page.partition("```python\n")[2].partition("```")[0])
    result = harness.run(scenario.load(file, [SHORT, "paged.stage=integral:Integral", "paged.rate=1.0"]))
    assert result.digest["/coarse/command"] != ""
    assert np.ptp(result.recording.dense["/coarse/command"]["position"]) > 1e-6


def test_the_reference_of_a_stage_of_others_is_printed(begin):
    begin("law", "my_law")
    told = lathe("reference", "my_law:MyLaw", "--allow-code", "my_law")
    assert told.exit_code == 0
    assert told.stdout.startswith("## my_law:MyLaw")
    assert "| `lead_time` | double | `0.001425` |" in told.stdout


# --- mistakes


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("return q - ", "return np.nan * waves + q - ", "with electrodynamic_actuator is not a number at 0"),
        ("return q - table.learning_gain * drive(waves * speed) * read", "return q[:1]", "contraction gives the "),
        ("        q = 1.0 -", "        q = 1 // 0 -", "contraction: ZeroDivisionError in __init__.py, line"),
        ("return self.parameters.points / 2", "return np.nan", "highest_waves gives nan"),
        ("np.zeros(3))", "[0.0, 0.0, 0.0])", "memory of a compiled step: law.newest is a list; allowed: arrays"),
        ("now.error_angle, now.error,", "now.error_angel, now.error,", "cannot be compiled at __init__.py, line"),
        ("parameter(1.0, ", "parameter(3.0, ", ".learning_gain = 3.0; allowed: a finite number"),
        ("Annotated[float, Gt(0), Le(2)]", "dict", "learning_gain is a <class 'dict'>; allowed: bool, int"),
        ('parameter(1.0, "γ: part of the error that a revolution learns")', "1.0", "is no parameter; allowed:"),
        ("    def tune(", "    def turn(", "without a method tune(self, parameters)"),
        ("    sample = staticmethod(sample)\n", "", " has no formula; allowed: sample = staticmethod"),
    ],
)
def test_a_mistake_in_a_law_is_told_in_one_line(begin, request, old, new, said):
    name = f"law_{request.node.callspec.indices['old']}"  # a module is imported once
    file = begin("law", name)
    edit(name, old, new)
    assert said in refused(file)


class Held(NamedTuple):
    """A memory."""

    gain: object


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (np.zeros(3, np.float32), "gain is an array of float32; allowed: float64,"),
        (np.zeros(6)[::2], "gain is an array with gaps"),
        (np.float32(1), "gain is a float32; allowed: arrays, int"),
    ],
)
def test_a_memory_that_no_step_can_have_is_told_by_member(value, said):
    assert explain_unfit(Held(Held(value))).startswith(f"gain.{said}")
