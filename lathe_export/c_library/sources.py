# SPDX-License-Identifier: Apache-2.0
"""Files of a C library: headers, tables, steps, an example that checks it, CMake file and README."""

import ctypes
import hashlib
import inspect
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba.np.random._constants import fi_double, ki_double, wi_double

from lathe_export.c_library.library import Library, Parameter, Signal
from lathe_export.c_library.reference import Reference
from lathe_export.c_library.single_precision import single
from lathe_export.c_library.step_memory import listed
from lathe_export.c_library.templates import TEMPLATES
from lathe_rc import __version__
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError, shown

_OF_US = re.compile(r"`(lathe_rc\.[a-z_.]+)`")
_IDENTIFIER = re.compile(r"[a-z][a-z0-9_]*")
_WORD = re.compile(r"[a-z][a-z0-9_]*")
_TEMPLATE_FOLDER = Path(__file__).parents[1] / "templates"
_SEES_NAME = ("c_library/lathe.h.j2", "c_library/NAME.c.j2", "c_library/main.c.j2", "fmu/fmu.c.j2")
_NO_CODE = re.compile(r"/\*.*?\*/|\"(?:[^\"\\\n]|\\.)*\"|\{\{.*?\}\}|\{%.*?%\}", re.DOTALL)
# Words of C and C++, headers of the C library, targets of CMake, and files of an FMU.
_RESERVED = """
alignas alignof and and_eq asm auto bitand bitor bool break case catch char class compl concept const consteval
constexpr constinit const_cast continue decltype default delete do double dynamic_cast else enum explicit export
extern false float for friend goto if inline int long mutable namespace new noexcept not not_eq nullptr operator or
or_eq private protected public register reinterpret_cast requires restrict return short signed sizeof static
static_assert static_cast struct switch template this thread_local throw true try typedef typeid typename typeof
typeof_unqual union unsigned using virtual void volatile wchar_t while xor xor_eq linux unix assert complex ctype
errno features fenv inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic stdbool stddef stdint
stdio stdlib stdnoreturn string tgmath threads time uchar unistd wchar wctype all clean edit_cache help install
rebuild_cache fmu unsupported words
"""
_FIXED = ("lathe.h", "lathe.c", "main.c", "CMakeLists.txt", "README.md")
KERNELS = "kernels.h"
_COMPILERS = {"linux64": (("cc", "gcc"), "gcc"), "win64": (("x86_64-w64-mingw32-gcc",), "gcc-mingw-w64-x86-64")}


def context(library: Library, scenario: str) -> dict[str, Any]:
    """Return what the templates say of a library."""
    nodes = ", ".join(part.stage.name for part in library.parts)
    own = {"upper": library.name.upper(), "nodes": nodes, "scenario": scenario, "version": __version__}
    return vars(library) | own


def sources(library: Library, scenario: str) -> dict[str, str]:
    """Return the text files of a library by name.

    Args:
        library: the library.
        scenario: name of the scenario, for the comments.
    """
    made = context(library, scenario) | {
        "steps": [f"{part.stage.name}_step.c" for part in library.parts],
        "ziggurat": {
            "k": listed((f"{word:#x}u" for word in ki_double.tolist()), 8),
            "w": listed(map(float.hex, wi_double.tolist()), 8),
            "f": listed(map(float.hex, fi_double.tolist()), 8),
        },
        "reasons": [(part.stage.name, *reason) for part in library.parts for reason in part.stage.stops.items()],
        "formulas": list(_formulas(part.stage for part in library.parts)),
        "identity": "",
    }
    found = {KERNELS: (_TEMPLATE_FOLDER / "c_library" / KERNELS).read_text("utf-8")}
    for name in _FIXED:
        found[name] = TEMPLATES.get_template(f"c_library/{name}.j2").render(made)
    found[f"{library.name}.h"] = TEMPLATES.get_template("c_library/NAME.h.j2").render(made)
    tables = TEMPLATES.get_template("c_library/NAME.c.j2")
    steps = {f"{part.stage.name}_step.c": part.code for part in library.parts}
    told = hashlib.sha256(f"{tables.render(made)}{''.join(steps.values())}".encode())
    made["identity"] = f"0x{told.hexdigest()[:16]}"
    found[f"{library.name}.c"] = tables.render(made)
    if library.real == "float":
        steps |= {KERNELS: found[KERNELS]}
        steps = {name: single(text) for name, text in steps.items()}
    return found | steps


@dataclass(frozen=True)
class Exported:
    """Result of `export_nodes`.

    Attributes:
        place: the folder.
        library: the library.
        reference: run of the engine with which the example compares it.
    """

    place: Path
    library: Library
    reference: Reference


def library_of(
    scenario: Scenario,
    nodes: Sequence[str],
    name: str | None,
    block: int | None,
    tune: Collection[str],
    real: str = "double",
) -> Library:
    """Return stages of a scenario as a library (arguments and errors as for `export_nodes`)."""
    cell = Cell(scenario.nodes)
    nodes = nodes or list(cell.stages)
    name = name or (nodes[0] if len(nodes) == 1 else scenario.name)
    _check_name(name)
    cell.check(cures=False)
    return Library(cell, nodes, name, cell.master.shared.block_size if block is None else block, tune, real)


def _check_name(name: str) -> None:
    """Check that the name of a library is an identifier that C, its library and the files of a library leave free."""
    if not _IDENTIFIER.fullmatch(name):
        raise InputError(f"--name {name}; allowed: a C identifier of small letters, digits and underscores")
    code = "".join((_TEMPLATE_FOLDER / each).read_text(encoding="utf-8") for each in _SEES_NAME)
    words = {*_RESERVED.split(), *_WORD.findall(_NO_CODE.sub(" ", code))}
    taken = {name, name.rstrip("0123456789")} & words or hasattr(ctypes.CDLL(None), name)  # the code has read_0 as well
    if taken or name.startswith("lathe") or name.endswith("_step"):
        raise InputError(
            f"--name {name}: a word of C, CMake, the C library or the files of the export; allowed: another name, such "
            f"as my_{name}"
        )


def export_nodes(
    scenario: Scenario,
    nodes: Sequence[str] = (),
    place: Path | None = None,
    *,
    name: str | None = None,
    block: int | None = None,
    tune: Collection[str] = (),
    samples: int = 65536,
    real: str = "double",
    further: Callable[[Library, str], dict[str, str]] = lambda _library, _scenario: {},
) -> Exported:
    """Write stages of a scenario as a C library into a new folder.

    Args:
        scenario: the scenario.
        nodes: names of the stages; none: all of them.
        place: folder to make; None: the name with ``-c``, in the current folder.
        name: name of the library; None: that of the only node or of the scenario.
        block: largest number of samples in a call; None: the block size of the scenario.
        tune: see `lathe_export.c_library.library.Library`.
        samples: length of the reference [sample].
        real: ``double``, or ``float``, of which the README states the loss over the reference.
        further: returns the text files beside those of the library by name, of the library and the scenario's name.

    Raises:
        InputError: the folder exists, the name is no identifier, or as for `lathe_export.c_library.library.Library`.
        LatheError: a step cannot be printed as C, the library stops or cannot be compiled in float, or the folder
            cannot be written.
    """
    library = library_of(scenario, nodes, name, block, tune, real)
    name = library.name
    place = place or Path(f"{name}-c")
    check_new(place, "folder")
    texts = sources(library, scenario.name) | further(library, scenario.name)
    reference = Reference(library, Cell(scenario.nodes), samples)
    try:
        with tempfile.TemporaryDirectory(dir=place.absolute().parent) as made_in:
            new = Path(made_in) / name
            new.mkdir()
            for file, text in texts.items():
                (new / file).write_text(text, encoding="utf-8")
            reference.write(new / "reference.bin")
            if real == "float":
                (new / "README.md").write_text(texts["README.md"] + _loss(new), encoding="utf-8")
            new.rename(place)
    except OSError as error:
        raise LatheError(f"{place}: cannot be written ({error.strerror})") from None
    return Exported(place, library, reference)


def check_new(place: Path, what: str) -> None:
    """Check that a file or folder can be made at a place.

    Raises:
        InputError: it exists, or its parent folder does not.
    """
    if place.exists() or not place.absolute().parent.is_dir():
        raise InputError(f"{place}: exists, or has no parent folder; allowed: a new {what} in a folder that exists")


def compiler(needed_for: str, platform: str = "linux64") -> str:
    """Return the C compiler of the machine for a platform.

    Raises:
        LatheError: there is none.
    """
    names, package = _COMPILERS[platform]
    if found := next(filter(None, map(shutil.which, names)), None):
        return found
    raise LatheError(f"no C compiler ({' or '.join(names)}) {needed_for}; allowed: apt install {package}")


def _loss(place: Path) -> str:
    """Return what a library in float loses over the reference, as a section of its README."""
    with tempfile.TemporaryDirectory() as folder:
        program = f"{folder}/program"
        build = [compiler("measures the loss of --real float"), "-O2", "-ffp-contract=off", "-o", program]
        build += [*map(str, place.glob("*.c")), "-lm"]
        for command in (build, [program, str(place / "reference.bin"), "0"]):
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise LatheError(f"--real float: {shown(done.stderr or done.stdout)}; allowed: --real double")
    *signals, run = done.stdout.splitlines()
    said = "".join(f"- {line}\n" for line in signals)
    return f"\n## Loss of float\n\n{run}, against the engine, which computes in double, from its inputs:\n\n{said}"


def _formulas(stages: Iterable[Stage]) -> Iterator[tuple[str, str]]:
    """Yield the titles and texts of the modules of some stages, and of the modules that their classes refer to."""
    told: set[str] = set()
    for stage in stages:
        named = _OF_US.findall(inspect.getdoc(type(stage)) or "")
        for name in (type(stage).__module__, *named):
            module = sys.modules.get(name)
            if module is None or name in told or not module.__doc__:
                continue
            told.add(name)
            yield name, "\n".join(f"    {line}".rstrip() for line in inspect.cleandoc(module.__doc__).splitlines())


def _pairs(rows: Iterable[Iterable[int]]) -> str:
    return ", ".join("{" + ", ".join(map(str, row)) + "}" for row in rows)


def _number(value: float) -> str:
    if np.isinf(value):
        return "HUGE_VAL" if value > 0 else "-HUGE_VAL"
    return float(value).hex()


def described(signal: Signal) -> str:
    """Return type, unit, range and delay of a signal in words."""
    kind = {8: "double", 4: "float", 1: "uint8_t"}[signal.bytes]
    before = "the sample" if signal.delay == 1 else f"{signal.delay} samples"
    late = f", of {before} before" if signal.delay else ""
    unit = f" [{signal.unit}]" if signal.unit else ""
    return f"{kind}{unit} from {signal.low:g} to {signal.high:g}{late}"


def ranged(parameter: Parameter) -> str:
    """Return description, first value and limits of a parameter."""
    unit = f" {parameter.unit}" if parameter.unit not in ("", "1") else ""
    limits = f", {parameter.limits}{unit}" if parameter.limits else ""
    return f"{parameter.doc}; at the start {parameter.value:.10g}{unit}{limits}"


TEMPLATES.globals |= {
    "pairs": _pairs,
    "number": _number,
    "described": described,
    "ranged": ranged,
    "identifier": lambda name: re.sub(r"\W", "_", name).upper(),
    "text": json.dumps,
}
