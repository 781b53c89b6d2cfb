# SPDX-License-Identifier: Apache-2.0
"""Every cell of the scenarios as an FMU in FMPy, and a law as an FMU under bad inputs and damaged states."""

import numpy as np
import pytest

pytest.importorskip("fmpy")

import fmpy
from bags import sized, some
from cells import SCENARIOS
from test_c_libraries import REFUSED
from test_fmu_export import STEP, Run

from lathe_export.c_library.fmu import export_fmu
from lathe_export.c_library.reference import Reference
from lathe_rc.cell.scenario import load
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

pytestmark = pytest.mark.system

BAD = (np.nan, np.inf, -np.inf, 1e300, -1e300)


@pytest.mark.timeout(1500)
@pytest.mark.parametrize("path", some(SCENARIOS, 8), ids=lambda path: path.stem)
def test_each_cell_as_an_fmu_has_the_bits_of_the_engine(path, tmp_path):
    """Or is refused by the name of what Python does in it."""
    cell, fmi = load(path), 2 + len(path.stem) % 2
    if path.stem in REFUSED:
        with pytest.raises(InputError, match=REFUSED[path.stem]):
            export_fmu(cell, [], tmp_path / "cell.fmu", fmi=fmi)
        return
    made, library = export_fmu(cell, [], tmp_path / "cell.fmu", fmi=fmi)
    reference = Reference(library, Cell(cell.nodes), 3000)
    assert Run(made).go(reference, library, 0, reference.samples) == []


@pytest.mark.timeout(1500)
@pytest.mark.parametrize("fmi", [2, 3])
def test_no_input_and_no_state_brings_an_fmu_out_of_its_range(tmp_path, fmi):
    """NaN, infinity and 1e300 at each input at random samples: held, and later the bits of the engine; flipped bits."""
    cell = load("piston")
    path, library = export_fmu(cell, ["learning_controller"], tmp_path / "law.fmu", fmi=fmi)
    reference = Reference(library, Cell(cell.nodes), 60_000)
    run, random = Run(path), np.random.default_rng(53)
    places = [run.references[each.name] for each in library.inputs]
    (command,) = (run.references[each.name] for each in library.outputs)
    inputs = np.array([reference.signal(each) for each in library.inputs])
    wanted = reference.signal(library.outputs[0])
    sample = held = 0
    while held < sized(10_000):
        for _ in range(random.integers(10)):
            run.put[8](places, inputs[:, sample])
            run.fmu.doStep((sample + held) * STEP, STEP)
            assert run.get[8]([command]) == [wanted[sample]]
            sample += 1
        with pytest.raises(fmpy.fmi1.FMICallException):
            run.put[8]([places[random.integers(len(places))]], [random.choice(BAD)])
        run.fmu.doStep((sample + held) * STEP, STEP)
        held += 1
        assert run.get[8]([command]) == [wanted[sample - 1] if sample else 0.0]
    saved = run.fmu.serializeFMUState(run.fmu.getFMUState())
    for bit in random.integers(8 * len(saved), size=sized(1000)):
        wrong = bytearray(saved)
        wrong[bit // 8] ^= 1 << bit % 8
        state = run.fmu.deserializeFMUState(bytes(wrong))
        with pytest.raises(fmpy.fmi1.FMICallException):
            run.fmu.setFMUState(state)
        run.fmu.freeFMUState(state)
    run.put[8](places, inputs[:, sample])
    run.fmu.doStep((sample + held) * STEP, STEP)
    assert run.get[8]([command]) == [wanted[sample]]
