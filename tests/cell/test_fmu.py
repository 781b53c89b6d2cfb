# SPDX-License-Identifier: Apache-2.0
"""FMUs of other tools as stages: response, units, hosts, state, and what is refused."""

import json
import os
import shutil
import zipfile

import numpy as np
import pytest
from machines import assert_refused, line_of

pytest.importorskip("fmpy")

import fmu_builder
from test_extending import lathe

from lathe_bagtools import hosts
from lathe_export.c_library.sources import export_nodes
from lathe_machine.fmi import imported
from lathe_rc import harness
from lathe_rc.cell import batch, scenario
from lathe_rc.cell.changes import Restoring, changes
from lathe_rc.cell.wiring import Cell, new_stage
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes import graph

SPINDLE = "/spindle_encoder: {ros__parameters: {revolutions: 3.0}}\n"
LAW = (
    "/learning_controller: {ros__parameters: {lead_time: 1.0e-3, q_time: 67.0e-6, feedback_delay: 3200, "
    "stop_ratio: 2.0, model_natural_frequency: 1038.0, model_damping: 0.804, model_delay: 0.0}}\n"
)
TOOL = "/tool: {ros__parameters: {profile: harmonics}}\n"
OURS = "/electrodynamic_actuator: {ros__parameters: {natural_frequency: 1038.0, damping: 0.804, delay: 0.0}}\n"
STATE = [
    "coarse/state.position = position",
    "coarse/state.velocity = velocity",
    "coarse/state.effort = 0",
    "coarse/state.measured_position = position",
]
DRIVE = {
    "fmu_inputs": ["command = coarse/command.position"],
    "fmu_outputs": STATE,
    "fmu_parameters": ["w = 1038", "zeta = 0.804"],
}
#: a filter at a slower rate, which nothing but the recorder reads
WATCH = {
    "fmu_inputs": ["u = tool.error delayed 640"],
    "fmu_outputs": [f"watch/state.{field} = y" for field in ("position", "velocity", "effort", "measured_position")],
    "fmu_step": 1e-3,
}


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    """Builds an FMU once."""
    built = {}

    def make(name, fmi=3, **how):
        key = name, fmi, *how.items()
        if key not in built:
            built[key] = fmu_builder.build(tmp_path_factory.mktemp("fmu"), name, fmi, **how)
        return built[key]

    return make


def node(name, file, values):
    return f"/{name}: {{ros__parameters: {json.dumps({'stage': 'fmu', 'fmu_file': str(file), **values})}}}\n"


def cell(folder, *nodes):
    file = folder / "cell.yaml"
    file.write_text("".join(nodes), encoding="utf-8")
    return scenario.load(file)


def stage(file, values):
    """The stage of an FMU alone."""
    table = scenario.TABLES["fmu"].read("box", {"stage": "fmu", "fmu_file": str(file), **values})
    return new_stage("box", table)


def refusal(file, values, *, check=False):
    def start():
        made = stage(file, values)
        if check:
            made.check_cell(Cell({}))

    return line_of(start)


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_imported_second_order_drive_moves_as_ours(fmus, tmp_path, fmi):
    """An FMU that integrates the same drive by Runge and Kutta, in micrometres, in the whole learning loop."""
    drives = node("drive", fmus("drive", fmi), DRIVE), OURS
    cells = [cell(tmp_path, SPINDLE, LAW, drive, TOOL) for drive in drives]
    found, wanted = (each.kept.dense["/coarse/state"] for each in batch.run_many(cells, ["coarse/state"]))
    for field in ("position", "velocity", "measured_position"):
        assert np.abs(found[field] - wanted[field]).max() < 1e-9 * np.abs(wanted[field]).max()


@pytest.mark.system
def test_three_fmus_have_the_same_bits_in_every_host(fmus, tmp_path):
    """Filter, drive and a slower filter, of FMI 2.0 and 3.0, in one cell in every host, and four times in a batch."""
    smooth = {"fmu_inputs": ["u = coarse/command.position"], "fmu_outputs": ["smooth/command.position = y"]}
    drive = {**DRIVE, "fmu_inputs": ["command = smooth/command.position"]}
    made = cell(
        tmp_path,
        SPINDLE,
        LAW,
        node("filter", fmus("filter", 2), {**smooth, "fmu_parameters": ["rate = 5e4"]}),
        node("drive", fmus("drive"), drive),
        node("watch", fmus("filter", limited=1), WATCH),
        TOOL,
    )
    found = hosts.digests_by_host(made, tmp_path)
    assert "processes" in found
    assert {host for host, topics in found.items() if topics != found["offline"]} == set()
    for outcome in batch.run_many([made] * 4, ["watch/state"], threads=1):
        assert outcome.kept.digests() == {"/watch/state": found["offline"]["/watch/state"]}


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_saved_fmu_goes_on_with_the_same_bits(fmus, fmi):
    path, command = fmus("drive", fmi), 1e-6 * np.sin(np.arange(4000) / 50)

    def go(box, first, last):
        told = {field: np.zeros(last - first) for field in ("position", "velocity", "effort", "measured_position")}
        box.process(first, [{"position": command[first:last]}], [told])
        return told["position"]

    whole, half = go(stage(path, DRIVE), 0, 4000), stage(path, DRIVE)
    go(half, 0, 1777)
    other = stage(path, DRIVE)
    Restoring().restore(changes(half, stage(path, DRIVE)), other)
    assert (go(other, 1777, 4000) == whole[1777:]).all()
    forgetful = stage(fmus("drive", fmi, saves="false"), DRIVE)
    go(forgetful, 0, 100)
    with pytest.raises(LatheError, match="cannot save its state"):
        forgetful.__getstate__()


# --- what is refused


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"fmu_inputs": ["order = coarse/command.position"]}, "'order' of drive3.fmu is unknown; allowed: command"),
        ({"fmu_inputs": ["position = coarse/command.position"]}, "'position' of drive3.fmu has the causality output; "),
        ({"fmu_inputs": ["command = encoder.speed"]}, "'command' is in um and encoder.speed in rad/s; allowed: "),
        ({"fmu_inputs": ["command = encoder.index_pulse"]}, "'encoder.index_pulse'; allowed: encoder.angle, "),
        ({"fmu_inputs": ["command = motor.position"]}, "allowed: TOPIC.FIELD with a TOPIC that ends in encoder, "),
        ({"fmu_inputs": ["command"]}, "'command'; allowed: NAME = NAME"),
        ({"fmu_inputs": ["command = coarse/command.position delayed x"]}, "allowed: delayed N, N in samples"),
        ({"fmu_inputs": ["command = coarse/command.position"] * 2}, "box.fmu_inputs: 'command' twice"),
        ({"fmu_outputs": STATE[:3]}, "nothing for coarse/state.measured_position; allowed: "),
        ({"fmu_outputs": []}, "box.fmu_outputs: no output"),
        ({"fmu_outputs": [*STATE, "coarse/state.effort = 1"]}, "'coarse/state.effort' twice"),
        ({"fmu_outputs": [*STATE[:3], "coarse/state.measured_position = velocity"]}, "'velocity' is in m/s and "),
        ({"fmu_parameters": ["w = fast"]}, "'w = fast'; allowed: a number"),
        ({"fmu_parameters": ["position = 1.0", "speed = 1.0"]}, "nothing to set; allowed: command, position, "),
        ({"fmu_step": 2e-5}, "box.fmu_step: 2e-05 s; allowed: a multiple of the sample, 1.5625e-05 s"),
    ],
)  # fmt: skip
def test_a_rule_that_does_not_fit_is_refused(fmus, changed, told):
    assert told in refusal(fmus("drive"), {**DRIVE, **changed})


@pytest.mark.parametrize(
    ("name", "how", "told"),
    [
        ("drive", {"platform": "x86_64-windows"}, "binaries for x86_64-windows; allowed: an FMU with binaries/"),
        ("drive", {"kind": "ModelExchange"}, "not for co-simulation"),
        ("drive", {"told": 'fixedInternalStepSize="1e-3"'}, "computes in steps of 0.001 s; allowed: a multiple"),
        ("drive", {"told": 'canHandleVariableCommunicationStepSize="maybe"'}, "invalid modelDescription.xml: "),
    ],
)
def test_an_fmu_that_cannot_run_here_is_refused(fmus, name, how, told):
    assert told in refusal(fmus(name, **how), DRIVE)


def test_what_is_no_fmu_is_refused(tmp_path):
    (tmp_path / "a.fmu").write_text("no archive")
    assert "a.fmu: no FMU (File is not a zip file)" in refusal(tmp_path / "a.fmu", DRIVE)
    assert "No such file" in refusal(tmp_path / "b.fmu", DRIVE)
    assert "box.fmu_file is not given" in refusal("", DRIVE, check=True)


def test_an_fmu_whose_instances_differ_is_refused(fmus):
    differs = {"fmu_inputs": [], "fmu_outputs": ["smooth/command.position = y"]}
    assert "two instances differ in the first 16 steps" in refusal(fmus("random"), differs, check=True)


def test_a_step_that_the_fmu_refuses_is_named(fmus):
    wrong = {**WATCH, "fmu_step": 2e-3}
    told = refusal(fmus("filter", 2, limited=1), wrong, check=True)
    assert "filter2.fmu at 0.001984375 s: a step of 0.002 s failed: no reason given; allowed: another fmu_step" in told


def test_an_fmu_that_ends_the_simulation_ends_the_run(fmus, tmp_path):
    made = cell(tmp_path, SPINDLE, LAW, node("drive", fmus("drive", end="0.1"), DRIVE), TOOL)
    with pytest.raises(LatheError, match=r"drive: drive3.fmu at 0.1 s: the FMU asks for the end of the simulation"):
        harness.run(made, mode="offline")


def test_a_second_instance_is_refused_where_the_fmu_allows_one(fmus, tmp_path):
    single = fmus("filter", told='canBeInstantiatedOnlyOncePerProcess="true"')
    rules = {"fmu_inputs": ["u = tool.error delayed 640"]}
    twice = [node(f"box{k}", single, {**rules, "fmu_outputs": [f"box{k}/command.position = y"]}) for k in range(2)]
    harness.run(cell(tmp_path, SPINDLE, LAW, OURS, TOOL, twice[0]), mode="offline")
    with pytest.raises(LatheError, match=r"box\d: .*a process may have one instance of it, and has one"):
        harness.run(cell(tmp_path, SPINDLE, LAW, OURS, TOOL, *twice), mode="offline")


def test_a_bag_and_an_announcement_run_no_fmu(fmus, tmp_path):
    """An FMU is machine code: a bag does not hold it, and only the user names it."""
    path = fmus("drive")
    made = cell(tmp_path, SPINDLE, LAW, node("drive", path, DRIVE), TOOL)
    harness.run(made, mode="offline", bag=tmp_path / "bag")
    done = lathe("resim", str(tmp_path / "bag"))
    assert done.exit_code == 2
    assert "machine code; allowed: --set drive.fmu_file=FILE" in done.stderr
    assert lathe("resim", str(tmp_path / "bag"), "--set", f"drive.fmu_file={path}").exit_code == 0
    shutil.copy(path, tmp_path / "bag" / "drive.fmu")
    (tmp_path / "bag" / "cell.yaml").write_text(node("drive", "drive.fmu", DRIVE) + SPINDLE, encoding="utf-8")
    assert_refused(lambda: scenario.load(tmp_path / "bag" / "cell.yaml"), "machine code; allowed: --set")
    told = graph._refused(scenario.TABLES["fmu"], made.nodes["drive"].model_dump())
    assert told.endswith("a file that no parameter file of this process names")


def test_an_fmu_that_unpacks_to_hundreds_of_megabytes_is_refused(fmus, tmp_path, monkeypatch):
    """400 MB of zeros in an FMU of 400 kB stay out of the cache; sources and binaries of other platforms as well."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    path = shutil.copy(fmus("filter"), tmp_path / "large.fmu")
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        for name in ("sources/all.c", "binaries/x86_64-windows/filter.dll"):
            archive.writestr(name, bytes(1000))
    place = imported.Fmu(path).unpacked()
    assert {each.name for each in place.iterdir()} == {"modelDescription.xml", "binaries"}
    assert {each.name for each in (place / "binaries").iterdir()} == {"x86_64-linux"}
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("resources/zeros", "w") as file:
        for _ in range(400):
            file.write(bytes(1_000_000))
    with pytest.raises(InputError, match=r"large.fmu: its binary and resources unpack to 38\d MiB; allowed: 64 MiB"):
        imported.Fmu(path).unpacked()
    assert [*(tmp_path / "cache" / "fmu").iterdir()] == [place]


def test_unpacked_fmus_that_are_not_used_any_more_leave_the_cache(fmus, tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(imported, "_CACHE", 1)
    first, second = (imported.Fmu(fmus("filter", fmi)).unpacked() for fmi in (2, 3))
    assert {*first.parent.iterdir()} == {first, second}  # both may be in use
    os.utime(first, (0, 0))
    third = imported.Fmu(fmus("drive")).unpacked()
    assert {*first.parent.iterdir()} == {second, third}


def test_an_fmu_is_not_exported(fmus, tmp_path):
    """The memory of its step holds addresses in this process."""
    made = cell(tmp_path, SPINDLE, LAW, node("drive", fmus("drive"), DRIVE), TOOL)
    with pytest.raises(InputError, match="drive: an FMU is loaded by Python; allowed: export the other nodes"):
        export_nodes(made, ["drive"], tmp_path / "drive-c")
