# SPDX-License-Identifier: Apache-2.0
"""``lathe export c``: stages as C libraries with the bits of the engine."""

import ctypes
import re
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest
from bags import lathe
from c_libraries import DONE, INPUT, REFUSED, STOPPED, Loaded, built, hostile, watched
from cells import scenario

from lathe_export.c_library.single_precision import single
from lathe_export.c_library.sources import export_nodes, library_of, sources
from lathe_machine.stages.learning.learning_controller import LearningController
from lathe_machine.stages.tool.tool import Tool
from lathe_rc import InputError
from lathe_rc.cell.scenario import load
from lathe_rc.errors import LatheError

WORDS = ("int", "lathe", "lathe_cell", "class", "main", "memcpy", "tapes", "math", "all", "write")


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
    cell = scenario(learning_controller={"events": events})
    return export_nodes(cell, ["learning_controller"], place, name="law")


@pytest.mark.system
def test_a_whole_cell_has_the_bits_of_the_engine(tmp_path):
    """Feedback, noise, jitter, a set point, a cut, a drift and an error motion within the library."""
    drive = {"noise_rms": 1e-8, "sampling_jitter": 1e-6, "gain_drift": 0.1, "mode_drift": 0.3, "drift_time": 0.05}
    drive |= {"mode_frequency": [5655.0], "mode_damping": [0.02], "mode_participation": [1e-4]}
    motion = ["tool.error_motion_order=[3]", "tool.error_motion_amplitude=[1e-6]"]
    cell = load("full_cell", [*(f"electrodynamic_actuator.{name}={value}" for name, value in drive.items()), *motion])
    exported = export_nodes(cell, place=tmp_path / "cell", samples=5000)
    assert len(exported.library.parts) == 12
    same, told = same_bits(exported)
    assert same, told


def test_a_law_has_the_bits_of_the_engine_over_cycles_and_events(law):
    assert [event[0] for event in law.reference.events] == [5001, 8001]
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
    saved = np.zeros(library.saved, np.uint8)
    pointer = ctypes.c_void_p(saved.ctypes.data)
    one.c.lathe_save(one.block, pointer)
    assert other.c.lathe_restore(other.block, pointer, saved.size) == DONE
    assert other.c.lathe_sample(other.block) == 5120
    found = wanted.copy()
    for first in range(5120, 10240, 64):
        assert one.step(inputs, [wanted], first, 64) == DONE
        for sample in range(first, first + 64):  # one sample a call
            assert other.step(inputs, [found], sample, 1) == DONE
    assert np.ptp(wanted[5120:10240]) > 0.0
    assert found.tobytes() == wanted.tobytes()
    assert zlib.crc32(bytes(saved[:24]) + bytes(8) + bytes(saved[32:])) == saved[24:32].view(np.int64)[0]


def test_parameters_are_checked_against_their_limits(law):
    made = Loaded(law.place, law.library.size)
    names = {parameter.name.partition(".")[2] for parameter in law.library.parameters}
    assert {"learning", "learning_gain", "lead_time"} <= names
    gain = "learning_controller.learning_gain"
    for value in (0.0, -1.0, 2.1, np.nan, np.inf):
        assert made.set(gain, value) == REFUSED
    assert made.set("learning_controller.learning", 0.5) == REFUSED
    assert made.set("learning_controller.nothing", 1.0) == REFUSED
    # The table allows a lead of 1 s, the check of the cell does not: it would be read before it is learned.
    lead = next(each for each in law.library.parameters if each.name == "learning_controller.lead_time")
    assert 0.0 < lead.low < lead.value < lead.high < 0.01
    assert [made.set(lead.name, value) for value in (1.0, lead.high * 1.01, lead.high)] == [REFUSED, REFUSED, DONE]
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


def test_all_parameters_of_a_node_that_its_step_reads_can_be_tuned(tmp_path):
    """A drive takes another resolution as the engine does; the README tells by which members the others act."""
    node = "electrodynamic_actuator"
    changed = export_nodes(scenario(**{node: {"resolution": 1e-7}}), [node], tmp_path / "changed", name="drive")
    (command,) = [changed.reference.signal(each) for each in changed.library.inputs]
    plain = export_nodes(scenario(), [node], tmp_path / "plain", name="drive", tune=[node], samples=1)
    made, found = Loaded(plain.place, plain.library.size), np.zeros((4, command.size))
    assert made.set(f"{node}.resolution", 1e-7) == DONE
    for first in range(0, command.size // 64 * 64, 64):
        assert made.step([command], [*found], first, 64) == DONE
    for signal, values in zip(changed.library.outputs, found, strict=True):
        assert values[: first + 64].tobytes() == changed.reference.signal(signal)[: first + 64].tobytes()
    readme = (plain.place / "README.md").read_text(encoding="utf-8")
    assert f"- `{node}.damping`: plant.drive.transition, plant.drive.weights, plant.drive.damper\n" in readme


def test_calls_that_do_not_fit_are_refused(law):
    made = Loaded(law.place, law.library.size)
    assert made.c.lathe_init(made.cell, ctypes.c_void_p(made.block.value + 8)) == REFUSED
    for samples in (0, -1, law.library.block + 1):
        assert made.step([], [], 0, samples) == REFUSED
    missing = (ctypes.c_void_p * len(law.library.inputs))()
    assert made.c.lathe_step(made.block, 1, missing, None) == REFUSED
    assert made.c.lathe_sample(made.block) == 0


def test_bad_inputs_and_damaged_states_are_refused(law):
    """NaN, infinity and 1e300 hold the command and change no later bit; no flipped bit of a state is restored."""
    told = hostile(law.place, 1000, 300)
    refused, stopped, taken, flips = (int(word) for word in told.split() if word.isdecimal())
    assert refused > 900
    assert stopped > 0
    assert refused + stopped + taken == 1000
    assert flips == 300


def test_a_stop_has_a_name_and_holds_the_command(law):
    """An angle that jumps ends the law, as it ends a run; the command stays at the newest one."""
    made, inputs = (
        Loaded(law.place, law.library.size),
        [law.reference.signal(each)[:4096] for each in law.library.inputs],
    )
    found = np.full(4096, np.nan)
    for first in range(0, 4032, 64):
        assert made.step(inputs, [found], first, 64) == DONE
    inputs[0] = inputs[0] + 1e4
    for _ in range(2):
        assert made.step(inputs, [found], 4032, 64) == STOPPED
        assert set(found[4032:]) == {found[4031]} != {0.0}
        number = made.c.lathe_reason(made.block, None, None)
        text = made.c.lathe_reason_text(made.block).decode()
        assert made.c.lathe_reason_name(made.block) == b"learning_controller"
        assert (number, text) in LearningController.stops.items()
    header = (law.place / "law.h").read_text(encoding="utf-8")
    assert f"LAW_STOP_LEARNING_CONTROLLER_{text.partition(':')[0].upper()} = {number}, /* {text} */" in header
    assert f"| learning_controller | {number} | {text} |" in (law.place / "README.md").read_text(encoding="utf-8")


def test_an_input_that_is_refused_is_named(law):
    made, inputs = Loaded(law.place, law.library.size), [np.zeros(64) for _ in law.library.inputs]
    which, sample = ctypes.c_int32(), ctypes.c_int64()
    for value, text in ((np.nan, "the input is not finite"), (-2.0, "the input is outside of its range")):
        inputs[2][7] = value
        assert made.step(inputs, [np.zeros(64)], 0, 64) == INPUT
        made.c.lathe_reason(made.block, ctypes.byref(which), ctypes.byref(sample))
        assert (which.value, sample.value, made.c.lathe_reason_text(made.block).decode()) == (2, 7, text)
        assert made.c.lathe_reason_name(made.block) == b"tool.measured_error"


def test_the_steps_read_as_the_kernels_do_and_need_libm_alone(law):
    """Names, formulas and comments of the kernels; no symbol of Python."""
    text = (law.place / "learning_controller_step.c").read_text()
    assert "real.data[SQUARES] = squares;" in text
    assert "/* Points to be read must already be learned, and not yet be overwritten by the next cycle. */" in text
    assert "lathe_machine.control.angle_memory.find: Assign the grid points" in text
    page = (Path(__file__).parents[2] / "docs" / "export.md").read_text()
    section = re.search(r"## A step as C\n(.*?)\n## ", page, re.DOTALL)[1]
    shown = re.findall(r"```c\n(.*?)```", section, re.DOTALL)
    assert len(shown) == 2
    for part in shown:
        assert part in text
    assert max(map(len, text.splitlines())) <= 120
    built(law.place)
    subprocess.run(["cc", "-std=c99", "-c", "learning_controller_step.c"], cwd=law.place, check=True)
    symbols = subprocess.run(
        ["nm", law.place / "learning_controller_step.o"], capture_output=True, text=True, check=True
    )
    wanted = {line.split()[-1] for line in symbols.stdout.splitlines() if " U " in line}
    assert wanted <= {"memmove", "memcpy", "sin", "cos", "exp", "floor", "ceil", "fmod", "copysign", "rint"}


def test_a_law_in_float_has_no_double_and_states_its_loss(law, tmp_path):
    """Half the state; the README says what a run with the example gives."""
    small = export_nodes(scenario(), ["learning_controller"], tmp_path / "law", name="law", real="float")
    assert 0.5 < small.library.saved / law.library.saved < 0.6
    steps = ["learning_controller_step.c", "lathe.c"]
    subprocess.run(["cc", "-Wdouble-promotion", "-Werror", "-c", *steps], cwd=small.place, check=True)
    program = built(small.place)
    told = subprocess.run([program, small.place / "reference.bin", "0"], capture_output=True, text=True, check=True)
    readme = (small.place / "README.md").read_text(encoding="utf-8")
    assert all(line in readme for line in told.stdout.splitlines())
    largest, rms, signal = map(float, re.findall(r"(?:difference|rms) ([^ ,]+)", told.stdout))
    assert 0.0 < rms < largest < 1e-3 * signal


def test_a_number_beyond_those_of_a_float_is_refused():
    assert (
        single("x = 1e-300 + sin(0.5); /* 0.5 of double */")
        == "x = 1.1754943508222875e-38f + sinf(0.5f); /* 0.5 of double */"
    )
    with pytest.raises(LatheError, match=r"1e\+300 is no number of a float"):
        single("1e+300")


def test_a_step_allocates_no_memory(law):
    """An interposed malloc ends the program within a step; a deliberate allocation there shows that it would."""
    arguments = [law.place / "reference.bin", "0"]
    assert subprocess.run([watched(law.place), *arguments], check=False).returncode == 0
    allocates = watched(law.place, "void *volatile taken = malloc(1); free(taken);")
    told = subprocess.run([allocates, *arguments], check=False)
    assert told.returncode == 9


def test_equal_stages_give_equal_files():
    one, other = (library_of(scenario(), ["learning_controller"], None, 1, ()) for _ in range(2))
    assert sources(one, "small") == sources(other, "small")


@pytest.mark.parametrize(
    ("nodes", "arguments", "said"),
    [
        (["lerning_controller"], {}, "node lerning_controller; did you mean learning_controller"),
        (["learning_controller"], {"block": 4096}, "samples late; allowed: 1 up to"),
        (["learning_controller"], {"name": "A-b"}, "a C identifier"),
        *((["tool"], {"name": name}, f"--name {name}: a word of C") for name in WORDS),
        (["tool"], {"block": 0}, "--block 0; allowed: 1 up to 8192"),
        (["learning_controller"], {"tune": ["learning_controller.q_time"]}, "does not store it as it is"),
        (["learning_controller"], {"tune": ["learning_controller.gain"]}, "allowed: NODE.PARAM of learning_controller"),
        (["learning_controller", "tool"], {}, "electrodynamic_actuator lies between learning_controller and tool"),
    ],
)
def test_what_cannot_be_exported_is_refused(tmp_path, nodes, arguments, said):
    with pytest.raises(InputError, match=said):
        export_nodes(scenario(), nodes, tmp_path / "new", **arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"q_filter": "gaussian"}, "q_filter = gaussian is computed in Python; allowed: exponential"),
        ({"publish_margin": True}, "publish_margin = true: the margin is computed in Python; allowed: false"),
        ({"stop_ratio": 2.0}, "stop_ratio = 2 is watched in Python; allowed: 0"),
        ({"events": ["second 1: clear"]}, "the event 'second 1: clear' changes no parameter of the exported step"),
    ],
)
def test_what_python_does_beside_the_step_is_refused(tmp_path, values, said):
    with pytest.raises(InputError, match=said):
        export_nodes(scenario(learning_controller=values), ["learning_controller"], tmp_path / "new")


def test_a_law_that_identifies_its_inverse_is_refused():
    """The library would keep the correction of the start, and learn worse than the engine."""
    done = lathe("export", "c", "learning_controller", "--scenario", "adaptive_inverse")
    assert (done.exit_code, "correction_model = identified is computed in Python; allowed: given" in done.stderr) == (
        2,
        True,
    )


def test_a_stage_with_python_around_its_step_is_refused():
    """A stage is decided by what it declares and overrides, not by a list in the exporter."""

    class Prepares(Tool):
        def prepare(self, first, samples):
            self.drawn = first + samples

    table = scenario().nodes["tool"]
    assert Tool("tool", table).needs_python == ""
    assert Prepares("tool", table).needs_python == "tool computes prepare in Python; allowed: a step alone"


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
