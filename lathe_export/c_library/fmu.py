# SPDX-License-Identifier: Apache-2.0
"""Stages of a scenario as a Functional Mock-up Unit (FMI 2.0 or 3.0, co-simulation), from the same printed steps.

The FMU is a C library of one sample a call, with the functions of the FMI standard around it; any C compiler rebuilds
it from its sources.
"""

import hashlib
import re
import subprocess
import tempfile
import zipfile
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

import numpy as np

from lathe_export.c_library import sources
from lathe_export.c_library.library import Library
from lathe_export.c_library.templates import TEMPLATES
from lathe_machine.fmi.units import BASE, powers
from lathe_rc import __version__, extras
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import LatheError, shown

with extras.named():
    import fmpy
    from fmpy import validation

# Of each platform, the folders of the binary by version of FMI, the end of its name, and flags of the compiler.
_PLATFORMS: dict[str, tuple[dict[int, str], str, Sequence[str]]] = {
    "linux64": ({2: "linux64", 3: "x86_64-linux"}, "so", ("-fPIC", "-fvisibility=hidden", "-Wl,-Bsymbolic")),
    "win64": ({2: "win64", 3: "x86_64-windows"}, "dll", ("-static-libgcc", "-D__USE_MINGW_ANSI_STDIO=1")),
}
_HEADERS = {
    2: ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    3: ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
# Functions for integers: name, C type, and whether they are for octets and for whole parameters.
_INTEGERS = {2: [("Integer", "fmi2Integer", 1, 1)], 3: [("UInt8", "fmi3UInt8", 1, 0), ("Int32", "fmi3Int32", 0, 1)]}
_FLAGS = ("-shared", "-O2", "-ffp-contract=off")
_DECLARED = re.compile(r"FMI[23]_Export\s+\w+TYPE\s+(\w+);")
_EXPORTED = """#ifdef _WIN32
#define EXPORTED __declspec(dllexport)
#else
#define EXPORTED __attribute__((visibility("default")))
#endif"""
_BESIDE = ("main.c", "CMakeLists.txt", "README.md")  # files of a library that an FMU does not need


class Variable(NamedTuple):
    """Variable of an FMU; its value reference is its place in the list.

    Attributes:
        name: name in the FMU.
        type: ``Float64``, ``UInt8`` or ``Int32``, as in FMI 3.0.
        causality: as in the FMI standard.
        unit: unit, without a factor; empty if there is none.
        doc: description.
        start: value at the start; None for an output.
        low, high: smallest and largest permitted value.
    """

    name: str
    type: str
    causality: str
    unit: str = ""
    doc: str = ""
    start: float | None = None
    low: float = -np.inf
    high: float = np.inf


def variables(library: Library) -> list[Variable]:
    """Return the variables of an FMU: the time, inputs, outputs and parameters."""
    found = [Variable("time", "Float64", "independent")]
    for signals, causality in ((library.inputs, "input"), (library.outputs, "output")):
        for signal in signals:
            late = f"value of {signal.delay} sample before" if signal.delay else ""
            kind, start = "Float64" if signal.bytes == 8 else "UInt8", 0.0 if causality == "input" else None
            found.append(Variable(signal.name, kind, causality, signal.unit, late, start, signal.low, signal.high))
    for each in library.parameters:
        kind = "Int32" if each.whole else "Float64"
        limits = each.low, each.high
        found.append(Variable(each.name, kind, "parameter", each.unit, each.doc, each.value, *limits))
    return found


def export_fmu(
    scenario: Scenario,
    nodes: Sequence[str] = (),
    place: Path | None = None,
    *,
    fmi: int = 3,
    name: str | None = None,
    tune: Sequence[str] = (),
    platform: Sequence[str] = ("linux64",),
) -> tuple[Path, Library]:
    """Write stages of a scenario as an FMU.

    Args:
        scenario: the scenario.
        nodes: names of the stages; none: all of them.
        place: file to make; None: the name with ``.fmu``, in the current folder.
        fmi: version of FMI, 2 or 3.
        name: name of the model; None: that of the only node or of the scenario.
        tune: see `lathe_export.c_library.library.Library`.
        platform: platforms of the binaries, ``linux64`` or ``win64``.

    Returns:
        The file, and the stages as a library.

    Raises:
        InputError: the file exists, or as for `lathe_export.c_library.sources.export_nodes`.
        LatheError: there is no C compiler, or the file cannot be written.
    """
    library = sources.library_of(scenario, nodes, name, block=1, tune=tune)
    place = place or Path(f"{library.name}.fmu")
    sources.check_new(place, "file")
    compilers = {each: sources.compiler("builds the FMU", each) for each in platform}
    made = _files(library, scenario.name, fmi)
    try:
        with tempfile.TemporaryDirectory(dir=place.absolute().parent) as folder:
            new = Path(folder) / "content"
            for file, text in made.items():
                (new / file).parent.mkdir(parents=True, exist_ok=True)
                (new / file).write_text(text, encoding="utf-8")
            for each, compiler in compilers.items():
                _build(compiler, new, each, fmi, library.name)
            archive = Path(folder) / "archive"
            with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file_of:
                for path in sorted(new.rglob("*.*")):
                    if path.is_file():
                        file_of.write(path, path.relative_to(new))
            if problems := validation.validate_fmu(str(archive)):
                raise LatheError(f"FMPy finds a fault in the FMU: {shown(problems[0])}")
            archive.rename(place)
    except OSError as error:
        raise LatheError(f"{place}: cannot be written ({error.strerror})") from None
    return place, library


def _build(compiler: str, content: Path, platform: str, fmi: int, name: str) -> None:
    """Compile the sources of an FMU into its binary for a platform."""
    folders, end, flags = _PLATFORMS[platform]
    binary = content / "binaries" / folders[fmi] / f"{name}.{end}"
    binary.parent.mkdir(parents=True)
    parts = sorted((content / "sources").glob("*.c"))
    command = [compiler, *_FLAGS, *flags, "-o", str(binary), *map(str, parts), "-lm"]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode:
        raise LatheError(f"{compiler} cannot build the FMU: {shown(built.stderr)}")


def _files(library: Library, scenario: str, fmi: int) -> dict[str, str]:
    """Return the text files of an FMU by path."""
    texts = sources.sources(library, scenario)
    token = hashlib.sha256(texts[f"{library.name}.c"].encode()).hexdigest()
    headers = {each: (Path(fmpy.__file__).parent / "c-code" / each).read_text("utf-8") for each in _HEADERS[fmi]}
    made = sources.context(library, scenario) | {"fmi": fmi, "token": token, "integers": _INTEGERS[fmi]}
    code = {"fmu.c": TEMPLATES.overlay(trim_blocks=True).get_template("fmu/fmu.c.j2").render(made)}
    written = set(re.findall(rf"\bfmi{fmi}\w+", code["fmu.c"])) | _composed(code["fmu.c"], fmi)
    missing = sorted(set(_DECLARED.findall(headers[_HEADERS[fmi][0]])) - written)
    code["unsupported.c"] = _unsupported(missing)
    code |= {name: text for name, text in texts.items() if name not in _BESIDE}
    compiled = [each for each in code if each.endswith(".c")]
    found = {f"sources/{each}": text for each, text in (code | headers).items()}
    if fmi == 3:
        found["sources/buildDescription.xml"] = xml_text(_build_description(library.name, compiled))
    return found | {"modelDescription.xml": xml_text(_model(library, scenario, fmi, token, compiled))}


def _composed(code: str, fmi: int) -> set[str]:
    """Return the functions whose names a macro composes."""
    state = "FMUState" if fmi == 3 else "FMUstate"
    read = "fmi3DeserializeFMUState" if fmi == 3 else "fmi2DeSerializeFMUstate"
    states = {f"fmi{fmi}{a}{state}{b}" for a, b in re.findall(r"\bSTATE\((\w+), (\w*)\)\(", code)}
    return states | {read} | {f"fmi{fmi}{each}" for each in re.findall(r"\bF\((\w+)\)\(", code)}


def _unsupported(names: Sequence[str]) -> str:
    """Return the functions of the standard that an FMU must have and does not support; declared without a header."""
    lines = ["/* Functions of the standard that this FMU does not support: an error, or no instance. */", _EXPORTED]
    for name in names:
        kind, value = ("void *", "0") if "Instantiate" in name else ("int ", "3")
        lines.append(f"EXPORTED {kind}{name}(void);\n{kind}{name}(void) {{ return {value}; }}")
    return "\n".join(lines) + "\n"


# ---- descriptions --------------------------------------------------------------------------------------------------


def _model(library: Library, scenario: str, fmi: int, token: str, compiled: Sequence[str]) -> ET.Element:
    step, state = repr(library.step), "FMUState" if fmi == 3 else "FMUstate"
    nodes = ", ".join(part.stage.name for part in library.parts)
    root = ET.Element("fmiModelDescription")
    root.attrib |= {
        "fmiVersion": f"{fmi}.0",
        "modelName": library.name,
        "instantiationToken" if fmi == 3 else "guid": token,
        "description": f"{nodes} of {scenario}",
        "generationTool": f"lathe_rc {__version__}",
        "variableNamingConvention": "flat",
    }
    kind = ET.SubElement(root, "CoSimulation", modelIdentifier=library.name)
    kind.attrib |= {f"canGetAndSet{state}": "true", f"canSerialize{state}": "true"}
    kind.set("canHandleVariableCommunicationStepSize", "true")
    if fmi == 3:
        kind.set("fixedInternalStepSize", step)
    else:
        kind.set("canNotUseMemoryManagementFunctions", "true")
        files = ET.SubElement(kind, "SourceFiles")
        for file in compiled:
            ET.SubElement(files, "File", name=file)
    known = variables(library) if fmi == 3 else variables(library)[1:]
    if named := sorted({each.unit for each in known if powers(each.unit) is not None}):
        units = ET.SubElement(root, "UnitDefinitions")
        for unit in named:
            base = {name: str(power) for name in BASE if (power := (powers(unit) or {}).get(name))}
            ET.SubElement(ET.SubElement(units, "Unit", name=unit), "BaseUnit", base)
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", name="logStatusError", description="why a call has failed")
    ET.SubElement(root, "DefaultExperiment", startTime="0", stepSize=step)
    listed = ET.SubElement(root, "ModelVariables")
    first = 0 if fmi == 3 else 1
    listed.extend(_variable(each, reference, fmi) for reference, each in enumerate(known, first))
    places = {each.name: place for place, each in enumerate(known, first)}
    structure = ET.SubElement(root, "ModelStructure")
    needed = library.dependencies()
    for tag in ("Output", "InitialUnknown"):
        group = structure if fmi == 3 else ET.SubElement(structure, f"{tag}s")
        for output, inputs in needed.items():
            unknown = ET.SubElement(group, tag if fmi == 3 else "Unknown")
            unknown.set("valueReference" if fmi == 3 else "index", str(places[output]))
            # Before the first step outputs are 0.
            needs = sorted(places[name] for name in inputs) if tag == "Output" else ()
            unknown.set("dependencies", " ".join(map(str, needs)))
    return root


def _variable(each: Variable, reference: int, fmi: int) -> ET.Element:
    about = {"name": each.name, "valueReference": str(reference), "causality": each.causality}
    about["variability"] = {"independent": "continuous", "parameter": "tunable"}.get(each.causality, "discrete")
    if initial := {"output": "calculated", "parameter": "exact"}.get(each.causality):
        about["initial"] = initial
    if each.doc:
        about["description"] = each.doc
    whole = each.type != "Float64"
    number: dict[str, str] = {} if whole or powers(each.unit) is None or not each.unit else {"unit": each.unit}
    for name, value in (("min", each.low), ("max", each.high), ("start", each.start)):
        if value is not None and isfinite(value):
            number[name] = str(int(value)) if whole else repr(float(value))
    if fmi == 3:
        return ET.Element(each.type, about | number)
    variable = ET.Element("ScalarVariable", about)
    ET.SubElement(variable, "Integer" if whole else "Real", number)
    return variable


def _build_description(name: str, compiled: Sequence[str]) -> ET.Element:
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    files = ET.SubElement(
        ET.SubElement(root, "BuildConfiguration", modelIdentifier=name), "SourceFileSet", language="C11"
    )
    for each in compiled:
        ET.SubElement(files, "SourceFile", name=each)
    return root


def xml_text(root: ET.Element) -> str:
    """Return an XML file."""
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'
