# SPDX-License-Identifier: Apache-2.0
"""``lathe export c``: stages as C libraries with the bits of the engine."""

import ctypes
import subprocess

import numpy as np
import pytest
from bags import lathe
from c_libraries import DONE, REFUSED, Loaded, built, watched
from cells import scenario

from lathe_rc import InputError
from lathe_rc.c_library.memory_image import MemoryImage
from lathe_rc.c_library.sources import export_nodes
from lathe_rc.cell.scenario import load
from lathe_rc.cell.stages.learning_controller import LearningController


def same_bits(exported, samples=0):
    """Build the example of a library and let it compare the library with the engine."""
    done = subprocess.run(
        [built(exported.place), exported.place / "reference.bin", str(samples)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    told = f"{exported.reference.samples} samples of {len(exported.library.outputs)} signals: the bits of the engine"
    return done.returncode == 0 and told in done.stdout, done.stdout + done.stderr


@pytest.fixture(scope="module")
def law(tmp_path_factory):
    """The law of the smallest cell, which stops learning in the middle of a block, and learns again."""
    place = tmp_path_factory.mktemp("law") / "law"
    events = ["sample 5001: freeze", "sample 8001: learn"]
    cell = scenario(learning_controller={"events": events, "publish_margin": True})
    return export_nodes(cell, ["learning_controller"], place, name="law")


@pytest.mark.system
def test_a_whole_cell_has_the_bits_of_the_engine(tmp_path):
    """Feedback, noise, a set point and a cut within the library."""
    cell = load("full_cell", ["electrodynamic_actuator.noise_rms=1e-8"])
    exported = export_nodes(cell, place=tmp_path / "cell", samples=5000)
    assert len(exported.library.parts) == 12
    same, told = same_bits(exported)
    assert same, told


def test_a_law_has_the_bits_of_the_engine_over_cycles_and_events(law):
    assert [event[0] for event in law.reference.events] == [5001, 8001]
    assert {answer[0] for answer in law.reference.answers} == {5887, 9727}
    assert law.reference.samples > 10_000
    same, told = same_bits(law, samples=100)
    assert same, told
    assert "time a sample: typically" in told


def test_the_state_goes_to_another_block_and_comes_back(law):
    """Save in mid-run, go on, restore elsewhere, and go on with the same bits."""
    library, reference = law.library, law.reference
    inputs = [reference.signal(signal) for signal in library.inputs]
    (wanted,) = [np.zeros(reference.samples)]
    one, other = (Loaded(law.place, library.size) for _ in range(2))
    for first in range(0, 5120, 64):
        assert one.step(inputs, [wanted], first, 64) == DONE
    saved = np.zeros(library.size, np.uint8)
    pointer = ctypes.c_void_p(saved.ctypes.data)
    one.c.lathe_save(one.block, pointer)
    assert other.c.lathe_restore(other.block, pointer) == DONE
    assert other.c.lathe_sample(other.block) == 5120
    found = wanted.copy()
    for first in range(5120, 10240, 64):
        assert one.step(inputs, [wanted], first, 64) == DONE
        for sample in range(first, first + 64):  # one sample a call
            assert other.step(inputs, [found], sample, 1) == DONE
    assert np.ptp(wanted[5120:10240]) > 0.0
    assert found.tobytes() == wanted.tobytes()
    saved[8] ^= 1
    assert other.c.lathe_restore(other.block, pointer) == REFUSED


def test_parameters_are_checked_against_their_limits(law):
    made = Loaded(law.place, law.library.size)
    names = {parameter.name.partition(".")[2] for parameter in law.library.parameters}
    assert {"learning", "learning_gain", "lead_time", "stability_margin"} <= names
    gain = "learning_controller.learning_gain"
    for value in (0.0, -1.0, 2.1, np.nan, np.inf):
        assert made.set(gain, value) == REFUSED
    assert made.set("learning_controller.learning", 0.5) == REFUSED
    assert made.set("learning_controller.nothing", 1.0) == REFUSED
    assert made.set(gain, 0.25) == DONE
    assert made.c.lathe_get(made.block, made.parameter(gain)) == 0.25


def test_a_changed_parameter_acts_as_in_the_engine(law, tmp_path):
    half = scenario(learning_controller={"learning_gain": 0.5})
    changed = export_nodes(half, ["learning_controller"], tmp_path / "half", name="law")
    inputs = [changed.reference.signal(signal) for signal in changed.library.inputs]
    (wanted,) = [changed.reference.signal(signal) for signal in changed.library.outputs]
    plain = export_nodes(scenario(), ["learning_controller"], tmp_path / "plain", name="law", samples=1)
    made, found = Loaded(plain.place, plain.library.size), np.zeros_like(wanted)
    assert made.set("learning_controller.learning_gain", 0.5) == DONE
    for first in range(0, wanted.size // 64 * 64, 64):
        assert made.step(inputs, [found], first, 64) == DONE
    assert found[: first + 64].tobytes() == wanted[: first + 64].tobytes()


def test_calls_that_do_not_fit_are_refused(law):
    made = Loaded(law.place, law.library.size)
    assert made.c.lathe_init(made.cell, ctypes.c_void_p(made.block.value + 8)) == REFUSED
    for samples in (0, -1, law.library.block + 1):
        assert made.step([], [], 0, samples) == REFUSED
    missing = (ctypes.c_void_p * len(law.library.inputs))()
    assert made.c.lathe_step(made.block, 1, missing, None) == REFUSED
    assert made.c.lathe_sample(made.block) == 0


def test_the_library_needs_libm_alone(law):
    symbols = subprocess.run(["nm", *(law.place / "objects").iterdir()], capture_output=True, text=True, check=True)
    wanted = {line.split()[-1] for line in symbols.stdout.splitlines() if " U " in line}
    assert wanted <= {"lathe_take", "lathe_release", "memcpy", "memset", "sin", "cos", "sincos", "exp", "floor"}
    assert not [word for word in ("Py", "numba", "NRT", "pickle") if word in symbols.stdout]


def test_a_step_allocates_no_memory(law):
    """An interposed malloc ends the program within a step; a deliberate allocation there shows that it would."""
    arguments = [law.place / "reference.bin", "0"]
    assert subprocess.run([watched(law.place), *arguments], check=False).returncode == 0
    allocates = watched(law.place, "void *volatile taken = malloc(1); free(taken);")
    told = subprocess.run([allocates, *arguments], check=False)
    assert told.returncode == 9


def test_equal_memories_have_equal_images():
    table = scenario(learning_controller={"learning_gain": 0.5}).nodes["learning_controller"]
    one, other = (MemoryImage(LearningController("one", table).memory) for _ in range(2))
    assert one.content.tobytes() == other.content.tobytes()
    assert one.relocations == other.relocations


@pytest.mark.parametrize(
    ("nodes", "arguments", "said"),
    [
        (["lerning_controller"], {}, "node lerning_controller; did you mean learning_controller"),
        (["learning_controller"], {"block": 4096}, "samples late; allowed: 1 up to"),
        (["learning_controller"], {"name": "A-b"}, "a C identifier"),
        (["learning_controller"], {"tune": ["learning_controller.q_time"]}, "does not store it as it is"),
        (["learning_controller"], {"tune": ["learning_controller.gain"]}, "allowed: NODE.PARAM of learning_controller"),
        (["learning_controller", "tool"], {}, "electrodynamic_actuator lies between learning_controller and tool"),
    ],
)
def test_what_cannot_be_exported_is_refused(tmp_path, nodes, arguments, said):
    with pytest.raises(InputError, match=said):
        export_nodes(scenario(), nodes, tmp_path / "new", **arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_filter_that_is_no_kernel_is_refused(tmp_path):
    cell = scenario(learning_controller={"q_filter": "gaussian"})
    with pytest.raises(InputError, match="q_filter = gaussian is computed in Python; allowed: exponential"):
        export_nodes(cell, ["learning_controller"], tmp_path / "new")


def test_the_command_names_the_events_that_are_left_to_the_program(tmp_path):
    asked = ["--scenario", "robust", "--samples", "100", "-o", tmp_path / "new"]
    done = lathe("export", "c", "disturbance_controller", *asked)
    assert done.exit_code == 0, done.output
    assert "the program has to cause it: disturbance_controller: second 3: freeze" in done.stderr
    assert "new: disturbance_controller; state of" in done.stdout
    assert "by way of tables: disturbance_controller.learning_gain; for" in done.stderr
    assert "## Formulas and their sources" in (tmp_path / "new" / "README.md").read_text(encoding="utf-8")
    again = lathe("export", "c", "disturbance_controller", *asked)
    assert (again.exit_code, "allowed: a new folder" in again.stderr) == (2, True)
