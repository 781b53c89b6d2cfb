# SPDX-License-Identifier: Apache-2.0
"""FMUs of the models in tests/support/fmus/, built with gcc and the headers that come with FMPy."""

import inspect
import subprocess
import zipfile
from pathlib import Path
from typing import NamedTuple

import fmpy
from fmpy import fmi2, fmi3

HERE = Path(__file__).with_name("fmus")
HEADERS = Path(fmpy.__file__).parent / "c-code"


class Variable(NamedTuple):
    name: str
    causality: str
    unit: str = ""
    start: float = 0.0


#: variables of each model, with value references from 1
MODELS = {
    "drive": [
        Variable("command", "input", "um"),
        Variable("position", "output", "um"),
        Variable("velocity", "output", "m/s"),
        Variable("w", "parameter", "", 1000.0),
        Variable("zeta", "parameter", "", 0.7),
    ],
    "filter": [Variable("u", "input"), Variable("y", "output"), Variable("rate", "parameter", "", 2000.0)],
    "random": [Variable("u", "input"), Variable("y", "output")],
}
UNITS = '<Unit name="um"><BaseUnit m="1" factor="1e-6"/></Unit><Unit name="m/s"><BaseUnit m="1" s="-1"/></Unit>'


def build(folder, name, fmi=3, *, told="", saves="true", platform="", kind="CoSimulation", limited=0, end="1e9"):
    """Build an FMU in a folder and return its path; ``told`` are further attributes of the interface."""
    unused = folder / "unused.c"
    # FMPy looks for all functions of the standard.
    standard = [each for each, _ in inspect.getmembers(fmi3.FMU3Slave if fmi == 3 else fmi2.FMU2Slave)]
    lines = [
        f"__attribute__((weak)) int {each}(void) {{ return 0; }}" for each in standard if each.startswith(f"fmi{fmi}")
    ]
    unused.write_text("\n".join(lines), encoding="utf-8")
    library = folder / f"{name}{fmi}.so"
    defined = [f'-DMODEL="{name}.h"', f"-DFMI={fmi}", f"-DLIMITED={limited}", f"-DEND={end}"]
    options = ["-shared", "-fPIC", "-O1", "-w", "-ffp-contract=off", f"-I{HEADERS}"]
    subprocess.run(["gcc", *options, *defined, HERE / "fmu.c", unused, "-o", library, "-lm"], check=True)
    path = folder / f"{name}{fmi}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _description(name, fmi, kind, told, saves))
        archive.write(library, f"binaries/{platform or ('x86_64-linux' if fmi == 3 else 'linux64')}/{name}.so")
    return path


def _description(name, fmi, kind, told, saves):
    key, state = ("instantiationToken", "FMUState") if fmi == 3 else ("guid", "FMUstate")
    time = '<Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>'
    lines, outputs = [time] if fmi == 3 else [], []
    for reference, variable in enumerate(MODELS[name], 1):
        variability = "fixed" if variable.causality == "parameter" else "continuous"
        initial = "" if variable.causality == "input" else 'initial="exact"'
        unit = f'unit="{variable.unit}"' if variable.unit else ""
        about = f'name="{variable.name}" valueReference="{reference}" causality="{variable.causality}" '
        about += f'variability="{variability}" {initial}'
        number = f'{unit} start="{variable.start}"'
        if fmi == 3:
            lines.append(f"<Float64 {about} {number}/>")
        else:
            lines.append(f"<ScalarVariable {about}><Real {number}/></ScalarVariable>")
        if variable.causality == "output":
            outputs.append(f'<Output valueReference="{reference}"/>' if fmi == 3 else f'<Unknown index="{reference}"/>')
    listed = "".join(outputs) if fmi == 3 else f"<Outputs>{''.join(outputs)}</Outputs>"
    capable = f'canGetAndSet{state}="{saves}" canSerialize{state}="{saves}"'
    return (
        '<?xml version="1.0" encoding="UTF-8"?>'
        f'<fmiModelDescription fmiVersion="{fmi}.0" modelName="{name}" {key}="{{0}}">'
        f'<{kind} modelIdentifier="{name}" {capable} {told}/>'
        f"<UnitDefinitions>{UNITS}</UnitDefinitions><ModelVariables>{''.join(lines)}</ModelVariables>"
        f"<ModelStructure>{listed}</ModelStructure></fmiModelDescription>"
    )
