# SPDX-License-Identifier: Apache-2.0
"""Drives and cut as one mechanical system: limits to the bit, balances, stiffness, chatter, the current loop."""

import numpy as np
import pytest
from cells import scenario
from numpy.testing import assert_allclose

from lathe_rc import harness
from lathe_rc.analysis.loaded import compliance, compliance_in_series
from lathe_rc.analysis.regeneration import Regeneration
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, LatheError
from lathe_rc.plants.cutting import RIGID, CuttingProcess
from lathe_rc.plants.cutting_force import STEEL, SpecificForce
from lathe_rc.plants.loaded import Coil, LoadedDrive, Piezo
from lathe_rc.plants.piezo import Stack
from lathe_rc.transfer import TransferFunction

STEP = 1 / 64000
SPEED = 100.0  # [rad/s]
SERVO = {"natural_frequency": 1038.0, "damping": 0.804, "moving_mass": 1.2}
STACK = {"tool_frequency": 14600.0, "tool_damping": 0.299, "mass_ratio": 0.1}
COIL = Coil(resistance=2.0, inductance=2e-3, bandwidth=12e3)
FORCE_CONSTANT = 30.0
DELAY = 23 * STEP  # whole samples: what the servo follows is linear from sample to sample


def loaded(*, series=False, coil=None, radial=0.4, step=STEP, servo=None, stack=None, **piezo):
    servo, stack = {**SERVO, **(servo or {})}, {**STACK, **(stack or {})}
    linear = Stack(
        stroke=15e-6, amplifier_lag=0.0, hysteresis=None, inverse=None, creep_per_decade=0.0, creep_times=np.empty(0),
        step=step, method="foh",
    )  # fmt: skip
    return LoadedDrive(
        carriage_frequency=servo["natural_frequency"],
        carriage_damping=servo["damping"],
        delay=DELAY,
        carriage_stroke=servo.get("stroke", 1e-3),
        moving_mass=servo["moving_mass"],
        force_constant=FORCE_CONSTANT,
        radial=radial,
        coil=coil,
        piezo=Piezo(linear, full_voltage=100.0, **stack, **piezo) if series else None,
        step=step,
        method="foh",
        kept=8192,
    )


def cutting(stiffness=300e3, depth=0.3e-3, lag=2e-3, step=STEP, **options):
    """A cut whose K is ``stiffness`` at a feed of 1 mm."""
    return CuttingProcess(
        material=SpecificForce(kc1=stiffness / 1e-3), depth=depth, lag=lag, elasticity=RIGID, step=step, **options
    )


def turning(samples, step=STEP, speed=SPEED, **given):
    """What a block takes, at constant speed and a feed of 1 mm."""
    rate = np.full(samples, speed)
    found = {"command": np.zeros(samples), "angle": rate * step * np.arange(samples), "speed": rate}
    return found | {"feed_velocity": 1e-3 * rate / (2 * np.pi)} | given


# --- limits, to the bit


FORM = {"harmonic_order": [2], "harmonic_amplitude": [50e-6]}
CUT = {"depth": 0.3e-3, "lag": 2e-3, "elasticity": "realistic", "gap_start": [1.0], "gap_width": [0.4]}
CUT |= {"run_out_order": [1], "run_out_amplitude": [5e-6], "regeneration": 0.5}


def prefixed(prefix, values):
    return {prefix + name: value for name, value in values.items()}


def apart(**drives):
    """Drives and cut as nodes of their own, as they were before."""
    cell = scenario(
        profile=FORM,
        tool={"reference": "topic", "drives": ["coarse", "fine"] if "series_drive" in drives else ["coarse"]},
        cutting_process={"moved_by": ["tool"], **CUT},
        **drives,
    )
    left_out = [] if "electrodynamic_actuator" in drives else ["electrodynamic_actuator"]
    return without(cell, left_out)


def together(kind, **values):
    cell = scenario(
        profile=FORM,
        tool={"reference": "topic", "drives": ["coarse", "fine"] if kind == "loaded_series_drive" else ["coarse"]},
        **{kind: {**prefixed("cut_", CUT), **values}},
    )
    return without(cell, ["electrodynamic_actuator"])


def without(cell, names):
    return Scenario("test", {name: table for name, table in cell.nodes.items() if name not in names})


SIGNALS = ("/coarse/state", "/cut", "/tool", "/coarse/command")


def test_without_a_force_on_it_a_drive_and_its_cut_are_those_of_two_nodes():
    loose = harness.run(apart(electrodynamic_actuator={})).digest
    held = harness.run(together("loaded_drive", radial_ratio=0.0)).digest
    assert [held[topic] for topic in SIGNALS] == [loose[topic] for topic in SIGNALS]


@pytest.mark.parametrize("compensates", [[], ["coarse"]])
def test_without_a_force_on_them_both_drives_in_series_and_their_cut_are_those_of_two_nodes(compensates):
    fine = {"fine_use_command": False, "fine_use_reference": True, "fine_compensates": compensates}
    loose = harness.run(apart(series_drive=fine)).digest
    held = harness.run(together("loaded_series_drive", radial_ratio=0.0, **fine)).digest
    topics = (*SIGNALS, "/fine/state")
    assert [held[topic] for topic in topics] == [loose[topic] for topic in topics]


def test_a_mass_that_nothing_moves_is_a_rigid_drive():
    """The force moves it by less than the last bit of the chip; what the coil would need for it is another matter."""
    runs = [
        harness.run(together("loaded_drive", radial_ratio=radial, coarse_moving_mass=1e30)) for radial in (0.0, 0.4)
    ]
    assert runs[0].digest["/cut"] == runs[1].digest["/cut"]
    forms = [run.recording.dense["/tool"]["displacement"] for run in runs]
    assert_allclose(forms[0], forms[1], rtol=0.0, atol=1e-30)
