# SPDX-License-Identifier: Apache-2.0
"""``lathe export fmu --platform win64``: FMUs for Windows, under wine; skipped without mingw-w64 or wine64."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("fmpy")

import fmpy

from lathe_export.c_library.fmu import export_fmu
from lathe_export.c_library.reference import Reference
from lathe_rc.cell.scenario import load
from lathe_rc.cell.wiring import Cell

COMPILER, WINE = "x86_64-w64-mingw32-gcc", shutil.which("wine64") or shutil.which("/usr/lib/wine/wine64")

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(not shutil.which(COMPILER), reason="no compiler for Windows (apt install gcc-mingw-w64-x86-64)"),
    pytest.mark.skipif(not WINE, reason="no wine to run programs of Windows (apt install wine64)"),
]


@pytest.fixture(scope="module")
def wine(tmp_path_factory):
    """A folder for wine, in place of that in the home folder."""
    return {"WINEPREFIX": str(tmp_path_factory.mktemp("wine")), "WINEDEBUG": "-all", "PATH": "/usr/bin:/bin"}


def differences(name, nodes, place, wine, samples=40_000):
    """Largest distance of each output of an FMU on Windows from the engine [ulp of the signal's largest value]."""
    cell = load(name)
    path, library = export_fmu(cell, nodes, place / "exported.fmu", name="exported", platform=["win64"])
    reference, folder = Reference(library, Cell(cell.nodes), samples), Path(fmpy.extract(path, place / "unit"))
    token = fmpy.read_model_description(path).instantiationToken
    inputs, outputs = ([reference.signal(each) for each in of] for of in (library.inputs, library.outputs))
    np.array(inputs, float).T.tofile(place / "given")
    host, source = place / "host.exe", Path(__file__).parents[1] / "support" / "windows_host.c"
    subprocess.run([COMPILER, "-O2", "-Wall", f"-I{folder}/sources", "-o", host, source], check=True)
    kinds = ["".join("d" if each.bytes == 8 else "u" for each in of) for of in (library.inputs, library.outputs)]
    (dll,) = (folder / "binaries" / "x86_64-windows").glob("*.dll")
    command = [WINE, host, dll, token, repr(library.step), str(reference.samples), kinds[0] or "x", kinds[1]]
    subprocess.run(command, check=True, cwd=place, env=wine)
    found = np.fromfile(place / "found").reshape(-1, len(outputs)).T
    assert found.shape[1] == reference.samples
    return {
        each.name: float(np.abs(got - wanted).max() / np.spacing(np.abs(wanted).max()))
        for each, got, wanted in zip(library.outputs, found, outputs, strict=True)
    }


@pytest.mark.parametrize(
    ("name", "nodes", "most"),
    [
        ("piston", ["learning_controller"], 0.0),
        ("robust", ["disturbance_controller"], 0.0),
        ("two_channel", [], 0.0),
        ("piston", [], 256.0),  # a spindle whose speed varies: another sin in its angle
    ],
)
def test_an_fmu_for_windows_has_the_bits_of_the_engine_or_differs_by_its_sin(name, nodes, most, tmp_path, wine):
    """Laws, and a cell at constant speed; the whole piston differs by at most 256 ulp of a signal's largest value."""
    assert max(differences(name, nodes, tmp_path, wine, 20_000).values()) <= most
