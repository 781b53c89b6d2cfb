# SPDX-License-Identifier: Apache-2.0
"""Files of a C library: headers, tables, steps, an example that checks it, CMake file and README."""

import ctypes
import hashlib
import inspect
import json
import re
import sys
import tempfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from numba.np.random._constants import fi_double, ki_double, wi_double

from lathe_export.c_library.library import Library, Parameter, Signal
from lathe_export.c_library.reference import Reference
from lathe_rc import __version__
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError

_GAP = 4  # zero words that are stored, so that there are fewer runs
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


def sources(library: Library, scenario: str) -> dict[str, str]:
    """Return the text files of a library by name.

    Args:
        library: the library.
        scenario: name of the scenario, for the comments.
    """
    runs = _runs(library.image.view(np.uint64))
    made: dict[str, Any] = {
        **{name: getattr(library, name) for name in _KEPT},
        "upper": library.name.upper(),
        "nodes": ", ".join(part.stage.name for part in library.parts),
        "scenario": scenario,
        "version": __version__,
        "steps": [f"{part.stage.name}_step.c" for part in library.parts],
        "runs": [(8 * begin, end - begin) for begin, end in runs],
        "tapes": [(tape.offset, tape.bytes, tape.length) for tape in library.tapes],
        "streams": [(stream.state, stream.values, stream.used) for stream in library.streams],
        "ziggurat": {
            "k": _listed(f"{word:#x}u" for word in ki_double.tolist()),
            "w": _listed(map(float.hex, wi_double.tolist())),
            "f": _listed(map(float.hex, fi_double.tolist())),
        },
        "reasons": [(part.stage.name, *reason) for part in library.parts for reason in part.stage.stops.items()],
        "formulas": list(_formulas(part.stage for part in library.parts)),
        "identity": "",
    }
    found = {KERNELS: (_TEMPLATE_FOLDER / "c_library" / KERNELS).read_text("utf-8")}
    for name in _FIXED:
        found[name] = _TEMPLATES.get_template(f"{name}.j2").render(made)
    found[f"{library.name}.h"] = _TEMPLATES.get_template("NAME.h.j2").render(made)
    tables = _TEMPLATES.get_template("NAME.c.j2")
    steps = {f"{part.stage.name}_step.c": part.code for part in library.parts}
    told = hashlib.sha256(f"{tables.render(made)}{''.join(steps.values())}".encode() + library.image.tobytes())
    made["identity"] = f"0x{told.hexdigest()[:16]}"
    found[f"{library.name}.c"] = tables.render(made)
    return found | steps | {f"{library.name}_state.c": _state(library)}


def _state(library: Library) -> str:
    """Return the words of the block before the first sample that are not 0, as C."""
    found = library.image.view(np.uint64)
    words = np.concatenate([found[begin:end] for begin, end in _runs(found)])
    name = f"const uint64_t {library.name}_words[]"
    listed = _listed(f"{word:#x}u" for word in words.tolist()) or "0"
    return (
        "/* SPDX-License-Identifier: Apache-2.0\n *\n * The block before sample 0, see lathe_init. */\n"
        f"#include <stdint.h>\n\nextern {name};\n{name} = {{\n    {listed}\n}};\n"
    )


_KEPT = (
    "name", "block", "step", "inputs", "outputs", "parameters", "parts", "relocations", "held", "room", "size",
    "left_out",
)  # fmt: skip


def identity(library: Library, texts: Mapping[str, str]) -> str:
    """Return the hash of a library's tables and state, from the files that `sources` returns."""
    return hashlib.sha256(texts[f"{library.name}.c"].encode() + library.image.tobytes()).hexdigest()


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
    scenario: Scenario, nodes: Sequence[str], name: str | None, block: int | None, tune: Collection[str]
) -> Library:
    """Return stages of a scenario as a library (arguments and errors as for `export_nodes`)."""
    cell = Cell(scenario.nodes)
    nodes = nodes or list(cell.stages)
    name = name or (nodes[0] if len(nodes) == 1 else scenario.name)
    _check_name(name)
    cell.check(cures=False)
    return Library(cell, nodes, name, cell.master.shared.block_size if block is None else block, tune)


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

    Raises:
        InputError: the folder exists, the name is no identifier, or as for `lathe_export.c_library.library.Library`.
        LatheError: a step cannot be printed as C, or the folder cannot be written.
    """
    library = library_of(scenario, nodes, name, block, tune)
    name = library.name
    place = place or Path(f"{name}-c")
    if place.exists() or not place.absolute().parent.is_dir():
        raise InputError(f"{place}: exists, or has no parent folder; allowed: a new folder in one that exists")
    texts = sources(library, scenario.name)
    reference = Reference(library, Cell(scenario.nodes), samples)
    try:
        with tempfile.TemporaryDirectory(dir=place.absolute().parent) as made_in:
            new = Path(made_in) / name
            new.mkdir()
            for file, text in texts.items():
                (new / file).write_text(text, encoding="utf-8")
            reference.write(new / "reference.bin")
            new.rename(place)
    except OSError as error:
        raise LatheError(f"{place}: cannot be written ({error.strerror})") from None
    return Exported(place, library, reference)


def _runs(words: np.ndarray) -> list[tuple[int, int]]:
    """Return the begin and end of the runs of words of which few are 0; all other words are 0."""
    filled = np.flatnonzero(words)
    breaks = np.flatnonzero(np.diff(filled) > _GAP)
    begins, ends = filled[np.r_[0, breaks + 1]], filled[np.r_[breaks, -1]] + 1
    return list(zip(begins.tolist(), ends.tolist(), strict=True))


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


def _listed(texts: Iterable[str]) -> str:
    """Return an initialiser with eight elements in a line."""
    all_of = list(texts)
    return ",\n    ".join(", ".join(all_of[k : k + 8]) for k in range(0, len(all_of), 8))


def _pairs(rows: Iterable[Iterable[int]]) -> str:
    return ", ".join("{" + ", ".join(map(str, row)) + "}" for row in rows)


def _number(value: float) -> str:
    if np.isinf(value):
        return "HUGE_VAL" if value > 0 else "-HUGE_VAL"
    return float(value).hex()


def _described(signal: Signal) -> str:
    kind = "double" if signal.bytes == 8 else "uint8_t"
    before = "the sample" if signal.delay == 1 else f"{signal.delay} samples"
    late = f", of {before} before" if signal.delay else ""
    unit = f" [{signal.unit}]" if signal.unit else ""
    return f"{kind}{unit} from {signal.low:g} to {signal.high:g}{late}"


def _ranged(parameter: Parameter) -> str:
    unit = f" {parameter.unit}" if parameter.unit not in ("", "1") else ""
    limits = f", {parameter.limits}{unit}" if parameter.limits else ""
    return f"{parameter.doc}; at the start {parameter.value:.10g}{unit}{limits}"


_TEMPLATES = Environment(
    loader=PackageLoader("lathe_export", "templates/c_library"),
    undefined=StrictUndefined,
    keep_trailing_newline=True,
    autoescape=False,  # noqa: S701 - C and Markdown, not HTML
)
_TEMPLATES.globals |= {
    "pairs": _pairs,
    "number": _number,
    "described": _described,
    "ranged": _ranged,
    "identifier": lambda name: re.sub(r"\W", "_", name).upper(),
    "text": json.dumps,
}
