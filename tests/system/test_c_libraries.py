# SPDX-License-Identifier: Apache-2.0
"""Every law, drive and cell of the scenarios as a C library; with CMake, valgrind, sanitizers, cppcheck, on ARM."""

import re
import subprocess
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from bags import sized, some
from c_libraries import built, hostile
from cells import SCENARIOS

from lathe_export.c_library.sources import export_nodes
from lathe_rc.cell.scenario import load
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

pytestmark = pytest.mark.system

LEVELS = (("-std=c99", "-O0"), ("-std=c11", "-O1"), ("-std=c17", "-O2"), ("-std=c11", "-O3"))
SAMPLES = 200_000  # beyond the event of each scenario that has one
#: scenarios that Python changes beside the steps, with what they are refused for
REFUSED = {
    "adaptive_inverse": "correction_model = identified",
    "oval3000_hard": "gauge: the event 'sample 0: freeze'",
    **dict.fromkeys(["supervised", "supervised_full_cell", "supervised_two_channel"], "publish_margin = true"),
}
PROGRAM = """
#include "law.h"
alignas(LATHE_ALIGNED) static char block[LAW_BYTES];
int main()
{
    const double given[LAW_INPUTS] = {};
    const void *inputs[LAW_INPUTS];
    for (int k = 0; k < LAW_INPUTS; k++)
        inputs[k] = &given[k];
    return lathe_init(&law, block) || lathe_step(block, 1, inputs, nullptr) || lathe_sample(block) != 1;
}
"""
#: the same with what Python does left out, and stages with further kinds of inputs
HOSTILE = [
    ("piston", ["learning_controller"], []),
    ("adaptive_inverse", ["learning_controller"], ["correction_model=given", "events=[]"]),
    ("supervised_turning", ["longitudinal"], []),
    ("robust", ["disturbance_controller"], ["events=[]"]),
    ("exact_invariance", ["learning_controller"], ["events=[]"]),
    ("periodic", ["position_controller"], []),
    ("lead_lag", ["fine_controller"], []),
    ("full_cell", ["electrodynamic_actuator"], []),
    ("gauged", ["gauge"], []),
    ("force_turning", ["force_controller"], []),
    ("robust_cutting", ["loaded_drive"], []),
    ("force_turning", ["cutting_process"], []),
]


def told(exported, *command, samples=0):
    """Output of the example, which must agree with the engine."""
    place = exported.place
    done = subprocess.run(
        [*command, place / "reference.bin", str(samples)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the bits of the engine" in done.stdout
    return done.stdout + done.stderr


@pytest.mark.parametrize("path", some(SCENARIOS, 4), ids=lambda path: path.stem)
def test_each_cell_has_the_bits_of_the_engine(path, tmp_path):
    """Or is refused by the name of what Python does in it."""
    if path.stem in REFUSED:
        with pytest.raises(InputError, match=REFUSED[path.stem]):
            export_nodes(load(path), place=tmp_path / "cell")
        return
    exported = export_nodes(load(path), place=tmp_path / "cell", samples=SAMPLES)
    assert exported.reference.samples > 40_000
    told(exported, built(exported.place))


@pytest.mark.timeout(1500)
def test_each_stage_alone_has_the_bits_of_the_engine(tmp_path):
    """One of each different compiled step that the scenarios have; by GCC and Clang, as C99 to C17, at all levels.

    By default each is built twice, and all of them together in all ways.
    """
    steps, ways = {}, [*product(("gcc", "clang"), LEVELS)]
    for path in SCENARIOS:
        for name, stage in Cell(load(path).nodes).stages.items() if path.stem not in REFUSED else ():
            steps.setdefault(stage.native().name, (path, name))
    assert len(steps) >= 25
    for number, (path, name) in enumerate(some([*steps.values()], 4)):
        exported = export_nodes(load(path), [name], tmp_path / str(number), name="alone", samples=20_000)
        for compiler, flags in some(ways[number % 4 :] + ways[: number % 4], 4):
            told(exported, built(exported.place, *flags, compiler=compiler))


@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_a_program_in_cpp_runs_a_library(compiler, tmp_path):
    """The headers are C++17 without a warning."""
    place = export_nodes(load("piston"), ["learning_controller"], tmp_path / "law", name="law", samples=100).place
    (place / "program.cpp").write_text(PROGRAM)
    strict = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run(["cc", "-c", *(path for path in place.glob("*.c") if path.stem != "main")], cwd=place, check=True)
    objects = [*place.glob("*.o")]
    subprocess.run([compiler, *strict, "-o", "program", "program.cpp", *objects, "-lm"], cwd=place, check=True)
    subprocess.run([place / "program"], check=True)


def test_cmake_builds_both_libraries_and_the_example(tmp_path):
    """The commands that ``lathe export c`` prints; no symbol of Python in either library."""
    exported = export_nodes(load("two_channel"), place=tmp_path / "cell", samples=10_000)
    for command in (["-B", "build"], ["--build", "build"]):
        subprocess.run(["cmake", *command], cwd=exported.place, check=True)
    build = exported.place / "build"
    told(exported, build / "two_channel_main")
    libraries = [build / "libtwo_channel.a", build / "libtwo_channel.so"]
    symbols = subprocess.run(["nm", *libraries], capture_output=True, text=True, check=True).stdout
    assert not [word for word in ("Py", "numba", "NRT") if word in symbols]


def test_valgrind_finds_nothing(tmp_path):
    exported = export_nodes(load("piston"), ["learning_controller"], tmp_path / "law", samples=20_000)
    assert "ERROR SUMMARY: 0 errors" in told(
        exported, "valgrind", "--error-exitcode=7", built(exported.place), samples=100_000
    )


def test_the_address_sanitizer_finds_nothing(tmp_path):
    exported = export_nodes(load("full_cell"), place=tmp_path / "cell", samples=20_000)
    flags = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover"]
    told(exported, built(exported.place, *flags), samples=100_000)


@pytest.mark.parametrize(("processor", "compiler"), [("aarch64", "aarch64-linux-gnu"), ("arm", "arm-linux-gnueabihf")])
@pytest.mark.parametrize(
    ("name", "nodes"),
    [("piston", ["learning_controller"]), ("robust", ["disturbance_controller"]), ("two_channel", [])],
)
def test_arm_has_the_bits_of_the_engine(processor, compiler, name, nodes, tmp_path):
    """64-bit and 32-bit, with the libm of Debian's cross compilers, under qemu-user; in float those of x86-64."""
    exported = export_nodes(load(name), nodes, tmp_path / "arm", name="arm", samples=5_000)
    told(exported, f"qemu-{processor}", built(exported.place, "-static", compiler=f"{compiler}-gcc"))
    small = export_nodes(load(name), nodes, tmp_path / "small", name="arm", samples=5_000, real="float").place
    command = [f"qemu-{processor}", built(small, "-static", compiler=f"{compiler}-gcc"), small / "reference.bin", "0"]
    loss = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert all(line in (small / "README.md").read_text(encoding="utf-8") for line in loss.splitlines())


@pytest.mark.parametrize(
    ("name", "node", "values"),
    [
        ("piston", "learning_controller", ["identify=false", "feedback_delay=200"]),
        ("robust", "disturbance_controller", []),
    ],
)
def test_a_law_in_float_runs_in_64_kb_on_a_cortex_m4(name, node, values, tmp_path):
    """On a bare processor with newlib, under QEMU, with the bits of the same program on x86-64; in 1 KB of stack."""
    cell = load(name, [f"{node}.{value}" for value in values])
    exported = export_nodes(cell, [node], tmp_path / "law", name="law", real="float", block=1, samples=20_000)
    place, signals = exported.place, exported.library.inputs
    rows = np.stack([exported.reference.signal(each) for each in signals], axis=1).astype(np.float32).tolist()
    listed = ",\n".join(f"{{{', '.join(f'{value.hex()}f' for value in row)}}}" for row in rows)
    given = f"static const float given[{len(rows)}][LAW_INPUTS] = {{\n{listed}}};\n"
    (place / "given.h").write_text(given, encoding="utf-8")
    folder = Path(__file__).parents[1] / "support"
    how = {"main": folder / "cortex_m4.c"}
    chip = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-nostartfiles"]
    script = ["-T", f"{folder}/cortex_m4.ld", f"-I{place}"]
    emulator = ["qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting", "-kernel"]
    bare = [*emulator, built(place, *chip, *script, compiler="arm-none-eabi-gcc", **how)]
    found = subprocess.run(bare, capture_output=True, text=True, check=True).stderr.split()  # the console
    here = [built(place, f"-I{place}", **how)]
    wanted = subprocess.run(here, capture_output=True, text=True, check=True).stdout.split()
    assert found[:1] == wanted != ["00000000"]
    assert int(found[1], 16) < 1024


@pytest.mark.timeout(1500)
@pytest.mark.parametrize(("name", "nodes", "values"), some(HOSTILE, 4), ids=lambda value: "-".join(value)[:40])
def test_no_input_and_no_state_brings_a_library_out_of_its_range(name, nodes, values, tmp_path):
    """NaN, infinity, 1e300, wild values at each input, and flipped bits of its state; under two sanitizers as well."""
    cell = load(name, [f"{nodes[0]}.{value}" for value in values])
    exported = export_nodes(cell, nodes, tmp_path / "law", name="law", samples=20_000)
    assert "refused" in hostile(exported.place, sized(10_000), sized(1000))
    hostile(exported.place, sized(2000), 100, "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover")


def test_each_name_compiles_or_is_refused(tmp_path):
    """Words of C, and of the code around the library; the compiler has the last word about all others."""
    compiled = []
    names = ["int", "lathe", "cell", "block", "given", "read_0", "time", "j1", "index", "stop", "stage_0", "law", "y"]
    for name in names:
        try:
            exported = export_nodes(load("piston"), ["tool"], tmp_path / name, name=name, samples=1000)
        except InputError:
            continue
        told(exported, built(exported.place))
        compiled.append(name)
    assert compiled == ["stage_0", "law", "y"]


# Of MISRA C:2012, which has mandatory, required and advisory rules.
ADVISORY = """2.3 2.4 2.5 2.6 2.7 4.2 5.9 8.7 8.9 8.11 8.13 10.5 11.4 11.5 12.1 12.3 12.4 13.3 13.4 15.1 15.4 15.5 17.5
17.8 18.4 18.5 19.2 20.1 20.5 20.10 21.12"""


def test_the_page_lists_the_rules_of_misra_that_laws_break(tmp_path):
    """The mandatory and required rules that cppcheck finds broken in two laws are those with a reason on the page."""
    broken = set()
    for name, node in (("piston", "learning_controller"), ("robust", "disturbance_controller")):
        place = export_nodes(load(name), [node], tmp_path / name, block=1, samples=100).place
        code = ["lathe.c", f"{node}.c", f"{node}_step.c"]
        check = ["cppcheck", "--addon=misra", "--enable=style", "--std=c99", "--quiet", "--template={id}", *code]
        told = subprocess.run(check, cwd=place, capture_output=True, text=True, check=True).stderr
        broken |= set(re.findall(r"misra-c2012-([\d.]+)", told))
    page = (Path(__file__).parents[2] / "docs" / "export.md").read_text(encoding="utf-8")
    section = re.search(r"## MISRA C\n(.*?)\n## ", page, re.DOTALL)[1]
    listed = [rule for row in re.findall(r"^\| ([\d., ]+) \|", section, re.MULTILINE) for rule in row.split(", ")]
    assert set(listed) == broken - {*ADVISORY.split()}
    assert len(listed) == len(set(listed))
