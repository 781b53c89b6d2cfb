# SPDX-License-Identifier: Apache-2.0
"""``lathe export hal``: the files of a component, and what HAL has no room for."""

from dataclasses import replace

import pytest
from cells import scenario

from lathe_export.c_library.hal import export_hal, files
from lathe_export.c_library.sources import library_of
from lathe_rc import InputError

LAW = scenario()


def test_a_component_has_the_pins_of_the_signals_with_their_units(tmp_path):
    """Inputs, outputs and parameters by words with dashes, beside the C library of one sample a call."""
    exported = export_hal(LAW, "learning_controller", tmp_path / "law", name="law", samples=100)
    text = (exported.place / "law.comp").read_text(encoding="utf-8")
    pins = [line.partition(" = ")[0].split('"')[:2] for line in text.splitlines() if line.startswith("pin ")]
    assert {name.split()[-1]: doc.split("]")[0] for name, doc in filter(lambda pin: len(pin) > 1, pins)} == {
        "enable": "false: the outputs are 0, and the next enabled sample is the first one again",
        "reset": "true: the same, and the fault is cleared",
        "fault": "stays until reset",
        "reason": "of the fault, see the notes; 0: none",
        "encoder-angle": "[rad",
        "encoder-speed": "[rad/s",
        "tool-measured-error": "[m",
        "coarse-state-measured-position": "[m",
        "coarse-command-position": "[m",
    }
    for line in ("pin io bit learning = 1.0 ", "pin io float learning-gain = 1.0 ", 'license "Apache-2.0"'):
        assert line in text
    assert exported.library.block == 1
    assert {"law.c", "lathe.c", "learning_controller_step.c", "reference.bin", "Makefile"} <= {
        path.name for path in exported.place.iterdir()
    }


def test_names_that_hal_cannot_hold_are_refused(tmp_path):
    """More than 47 characters; two signals that differ by a dash alone; nothing is written."""
    with pytest.raises(InputError, match=r"electrodynamic-actuator\.coarse-state-measured-position: 54 characters.*47"):
        export_hal(LAW, "electrodynamic_actuator", tmp_path / "drive")
    library = library_of(LAW, ["tool"], "tip", 1, ())
    library.inputs.append(replace(library.inputs[0], topic="encoder/angle", field="true"))
    with pytest.raises(InputError, match=r"pin tip\.encoder-angle-true: the name of another pin"):
        files(library, "piston")
    assert not list(tmp_path.iterdir())
