# SPDX-License-Identifier: Apache-2.0
"""``lathe export fmu``: stages as FMUs that FMPy runs with the bits of the engine."""

import graphlib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("fmpy")

import fmpy
from bags import lathe
from cells import NODES, scenario
from fmpy import build, simulation, validation
from fmpy.ssp import simulation as ssp
from fmpy.ssp import ssd

from lathe_export.c_library import sources
from lathe_export.c_library.fmu import export_fmu
from lathe_export.c_library.reference import Reference
from lathe_machine.fmi import imported
from lathe_rc import LatheError, harness
from lathe_rc.cell.parameters import SharedParameters
from lathe_rc.cell.scenario import TABLES, load
from lathe_rc.cell.wiring import Cell

STEP = 1.0 / 64_000


class Run:
    """An FMU in FMPy, with the signals of a run of the engine."""

    def __init__(self, path, folder=None):
        self.model = fmpy.read_model_description(path)
        self.folder, self.said = folder or fmpy.extract(path), []
        self.fmu = simulation.instantiate_fmu(
            self.folder, self.model, "CoSimulation", debug_logging=True, logger=lambda *told: self.said.append(told[-1])
        )
        self.is_3 = self.model.fmiVersion == "3.0"
        self.step = float(self.model.defaultExperiment.stepSize)
        self.references = {each.name: each.valueReference for each in self.model.modelVariables}
        if self.is_3:
            self.fmu.enterInitializationMode()
        else:
            self.fmu.setupExperiment()
            self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        kinds = ("Float64", "UInt8") if self.is_3 else ("Real", "Integer")
        self.get = {8: getattr(self.fmu, f"get{kinds[0]}"), 1: getattr(self.fmu, f"get{kinds[1]}")}
        self.put = {8: getattr(self.fmu, f"set{kinds[0]}"), 1: getattr(self.fmu, f"set{kinds[1]}")}

    def go(self, reference, library, first, last, held=0):
        """Compute some samples with the inputs of the engine, and return the outputs that differ from its own.

        ``held`` steps before them did not count.
        """
        inputs = [(each.bytes, self.references[each.name], reference.signal(each)) for each in library.inputs]
        outputs = {size: [each for each in library.outputs if each.bytes == size] for size in (8, 1)}
        places = {size: [self.references[each.name] for each in of] for size, of in outputs.items() if of}
        found = {size: [] for size in places}
        for sample in range(first, last):
            for size, place, given in inputs:
                self.put[size]([place], [given[sample]])
            self.fmu.doStep((sample + held) * self.step, self.step)
            for size, wanted in places.items():
                found[size].append(self.get[size](wanted))
        differ = []
        for size, rows in found.items():
            for each, column in zip(outputs[size], np.array(rows).T, strict=True):
                wanted = reference.signal(each)[first:last]
                differ += [each.name] if column.astype(wanted.dtype).tobytes() != wanted.tobytes() else []
        return differ


@pytest.fixture(scope="module")
def law(tmp_path_factory):
    """The law of the smallest cell as an FMU of each version, and the engine's run."""
    cell, folder = scenario(), tmp_path_factory.mktemp("law")
    made = {fmi: export_fmu(cell, ["learning_controller"], folder / f"law{fmi}.fmu", fmi=fmi) for fmi in (2, 3)}
    reference = Reference(made[3][1], Cell(cell.nodes), 6000)
    return {fmi: path for fmi, (path, _) in made.items()}, made[3][1], reference


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("nodes", [["electrodynamic_actuator"], pytest.param([], marks=pytest.mark.system)], ids=len)
def test_a_drive_and_a_whole_cell_run_in_fmpy_to_the_engines_bits(tmp_path, nodes, fmi):
    """A drive with noise follows the engine's command; of a whole cell the signals of all stages come out."""
    cell = load("full_cell", ["electrodynamic_actuator.noise_rms=1e-8"])
    path, library = export_fmu(cell, nodes, tmp_path / "part.fmu", fmi=fmi, name="part")
    assert validation.validate_fmu(str(path)) == []
    assert len(library.inputs) == len(nodes)
    reference = Reference(library, Cell(cell.nodes), 5000)
    assert Run(path).go(reference, library, 0, reference.samples) == []


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_law_stopped_in_mid_run_goes_on_in_a_new_instance_with_the_same_bits(law, fmi):
    paths, library, reference = law
    whole, other = Run(paths[fmi]), Run(paths[fmi])
    assert whole.go(reference, library, 0, 4321) == []
    saved = whole.fmu.serializeFMUState(whole.fmu.getFMUState())
    assert whole.go(reference, library, 4321, 6000) == []
    other.fmu.setFMUState(other.fmu.deserializeFMUState(saved))
    assert other.go(reference, library, 4321, 6000) == []
    for place in (0, 8, len(saved) - library.size - 4, len(saved) - library.size + 30, len(saved) - 1, None):
        wrong = bytearray(saved if place is not None else len(saved))
        if place is not None:
            wrong[place] ^= 1
        with pytest.raises(fmpy.fmi1.FMICallException):
            other.fmu.setFMUState(other.fmu.deserializeFMUState(bytes(wrong)))
        assert b"no state of this FMU, or a damaged one" in other.said[-1]


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_bad_input_is_discarded_and_the_law_goes_on(law, fmi):
    """NaN, infinity and 1e300: the outputs are held, time goes on, and with a good input the law does."""
    paths, library, reference = law
    run = Run(paths[fmi])
    assert run.go(reference, library, 0, 4000) == []
    (command,) = (run.references[each.name] for each in library.outputs)
    before = run.get[8]([command])
    held = 0
    for each in library.inputs:
        for value in (np.nan, np.inf, -np.inf, 1e300, each.low * 1.001):
            with pytest.raises(fmpy.fmi1.FMICallException, match=r"[Dd]iscard"):
                run.put[8]([run.references[each.name]], [value])
            assert each.name.encode() in run.said[-1]
            assert b"the outputs are held" in run.said[-1]
            run.fmu.doStep((4000 + held) * STEP, STEP)  # a warning
            assert b"the outputs are held from" in run.said[-1]
            assert run.get[8]([command]) == before
            held += 1
        run.put[8]([run.references[each.name]], [reference.signal(each)[3999]])
    assert run.go(reference, library, 4000, 4600, held) == []


def test_an_fmu_that_has_stopped_holds_its_outputs(law):
    paths, library, reference = law
    run = Run(paths[3])
    assert run.go(reference, library, 0, 4000) == []
    (command,) = (run.references[each.name] for each in library.outputs)
    before = run.get[8]([command])
    run.put[8]([run.references["encoder.angle"]], [1e6])
    for _ in range(2):
        with pytest.raises(fmpy.fmi1.FMICallException):
            run.fmu.doStep(4000 * STEP, STEP)
        assert b"learning_controller has stopped at sample 4000: " in run.said[-1]
        assert run.get[8]([command]) == before


def test_a_cell_as_ssp_has_the_engines_bits_in_the_order_of_its_components(tmp_path):
    """The order is that of the declared dependencies; FMPy's own master, which has another, errs by under 1 µm."""
    cell, samples = load("piston"), 2000
    done = lathe("export", "ssp", "--scenario", "piston", "-o", tmp_path / "piston.ssp")
    assert done.exit_code == 0, done.output
    assert "9 connections; step in this order: spindle_encoder, learning_controller, electrodynamic" in done.stdout
    system = ssd.read_ssd(str(tmp_path / "piston.ssp")).system
    folder, parts = fmpy.extract(tmp_path / "piston.ssp"), ssd.find_components(system)
    models = {part.name: fmpy.read_model_description(Path(folder, part.source)) for part in parts}
    source = {each.name: name for name, model in models.items() for each in (out.variable for out in model.outputs)}
    needs = {name: {source[needed.name] for each in model.outputs for needed in each.dependencies}
             for name, model in reversed(models.items())}  # fmt: skip
    order = list(graphlib.TopologicalSorter(needs).static_order())
    assert order == [part.name for part in parts] == list(NODES)
    for part in parts:
        ssp.instantiate_fmu(part, folder, 0.0)
    for each in ssd.find_connectors(system):
        each.value = 0.0
    outputs = {each.name: each for part in parts for each in part.connectors if each.kind == "output"}
    rows = []
    for sample in range(samples):
        for part in parts:
            ssp.do_step(part, sample * STEP, STEP)
            for source, reader in ssd.get_connections(system):
                if source in part.connectors:
                    reader.value = source.value
        rows.append([each.value for each in outputs.values()])
    for part in parts:
        ssp.free_fmu(part)
    whole = sources.library_of(cell, [], None, 1, ())
    reference = Reference(whole, Cell(cell.nodes), samples)
    wanted = {each.name: reference.signal(each) for each in whole.outputs}
    for name, found in zip(outputs, np.array(rows).T, strict=True):
        assert np.array_equal(found, wanted[name]), name
    later = ssp.simulate_ssp(str(tmp_path / "piston.ssp"), stop_time=(samples - 0.5) * STEP, step_size=STEP)
    difference = later["tool.tool.error"] - wanted["tool.error"]
    assert 0.0 < np.abs(difference).max() < 1e-6


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_step_is_a_multiple_of_the_sample(law, fmi):
    """Several samples in a step keep the inputs; another step, and one from another time, are refused with a reason."""
    run = Run(law[0][fmi])
    run.fmu.doStep(0.0, 5 * STEP)
    for time, step, told in (
        (5 * STEP, 1e-5, b"a multiple of the sample, 1.5625e-05 s"),
        (0.0, STEP, b"a step from 0 s"),
    ):
        with pytest.raises(fmpy.fmi1.FMICallException):
            run.fmu.doStep(time, step)
        assert told in run.said[-1]
    run.fmu.doStep(5 * STEP, STEP)
    if fmi == 3:
        assert run.fmu.getFloat64([0]) == [6 * STEP]


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_description_tells_units_ranges_dependencies_and_tunable_parameters(law, fmi):
    model = fmpy.read_model_description(law[0][fmi])
    known = {each.name: each for each in model.modelVariables}
    assert (known["encoder.speed"].unit, known["encoder.speed"].causality) == ("rad/s", "input")
    assert (known["coarse/command.position"].unit, known["coarse/command.position"].causality) == ("m", "output")
    gain = known["learning_controller.learning_gain"]
    assert (gain.causality, gain.variability, float(gain.start)) == ("parameter", "tunable", 1.0)
    assert float(gain.min) > 0.0
    assert [{each.name for each in output.dependencies} for output in model.outputs] == [
        {"encoder.angle", "encoder.speed"}
    ]
    run = Run(law[0][fmi])
    run.put[8]([gain.valueReference], [0.5])
    assert run.get[8]([gain.valueReference]) == [0.5]
    with pytest.raises(fmpy.fmi1.FMICallException):
        run.put[8]([gain.valueReference], [-1.0])
    assert b"learning_controller.learning_gain = -1; allowed: from " in run.said[-1]


@pytest.mark.system
@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_built_again_from_its_sources_has_the_same_bits(law, tmp_path, fmi):
    """FMPy compiles the sources in the FMU with CMake."""
    paths, library, reference = law
    folder = fmpy.extract(paths[fmi], tmp_path / "fmu")
    (binary,) = (folder / "binaries").rglob("*.so")
    before = binary.read_bytes()
    binary.unlink()
    build.build_platform_binary(folder)
    assert binary.read_bytes() != before
    assert Run(paths[fmi], folder).go(reference, library, 0, 1000) == []


def test_an_exported_drive_in_place_of_ours_gives_the_digests_of_the_cell(tmp_path):
    """``lathe export fmu``, then ``stage: fmu`` with the file: the loop closes to the bit."""
    done = lathe("export", "fmu", "electrodynamic_actuator", "--scenario", "piston", "-o", str(tmp_path / "drive.fmu"))
    assert done.exit_code == 0, done.stderr
    assert "1 inputs, 4 outputs, 0 parameters, a step of 1.5625e-05 s" in done.stdout
    length = "spindle_encoder.revolutions=3.0"
    ours = load("piston", [length, "learning_controller.stop_ratio=2.0"])
    table = {
        **{name: getattr(ours.shared, name) for name in SharedParameters.rows()},
        "stage": "fmu",
        "fmu_file": str(tmp_path / "drive.fmu"),
        "fmu_inputs": ["coarse/command.position = coarse/command.position"],
        "fmu_outputs": [
            f"coarse/state.{field} = coarse/state.{field}"
            for field in ("position", "velocity", "effort", "measured_position")
        ],
    }
    assert imported.read(table["fmu_file"]).usual_step == STEP
    of_fmu = TABLES["fmu"].read("electrodynamic_actuator", table)
    theirs = ours.with_models_given().with_node("electrodynamic_actuator", of_fmu)
    wanted, found = (harness.run(each, mode="offline").digest for each in (ours, theirs))
    assert [found[topic] for topic in ("/coarse/state", "/tool")] == [wanted["/coarse/state"], wanted["/tool"]]


def test_what_cannot_be_exported_is_refused(tmp_path, monkeypatch):
    (tmp_path / "there.fmu").touch()
    done = lathe("export", "fmu", "tool", "--scenario", "piston", "-o", str(tmp_path / "there.fmu"))
    assert done.exit_code == 2
    assert "there.fmu: exists" in done.stderr
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(LatheError, match="no C compiler"):
        export_fmu(scenario(), ["tool"], tmp_path / "tool.fmu")
