# SPDX-License-Identifier: Apache-2.0
"""Identification of the drive while it runs, and the law that uses it."""

import numpy as np
import pytest
from cells import form_error, run, scenario
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_rc import harness
from lathe_rc.control.identification import DriveIdentifier
from lathe_rc.errors import InputError
from lathe_rc.plants.electrodynamic import ElectrodynamicDrive

STATUS = "/coarse/learning"
STEP = 1 / 64000
DELAY = 300


def identify(command, *, natural_frequency=1038.0, damping=0.804, delay=0.36e-3, block=1000, model_delay=None):
    drive = ElectrodynamicDrive(
        natural_frequency=natural_frequency, damping=damping, delay=delay, stroke=1e3, moving_mass=1.0,
        force_constant=1.0, step=STEP, method="foh",
    )  # fmt: skip
    position = np.empty(command.size)
    drive.block(command, position, np.empty(command.size), np.empty(command.size))
    identifier = DriveIdentifier(
        model_delay=delay if model_delay is None else model_delay,
        feedback_delay=DELAY,
        bandwidth=1000.0,
        forgetting=0.5,
        step=STEP,
        block=DELAY,
    )
    late = np.concatenate((np.zeros(DELAY), position))[: command.size]
    for start in range(0, command.size, min(block, DELAY)):
        part = slice(start, min(start + min(block, DELAY), command.size))
        identifier.block(start, 0, part.stop - start, late[part])
        identifier.commanded(start, command[part])
    return identifier.fit()


@given(st.floats(300.0, 3000.0), st.floats(0.2, 1.5), st.floats(0.0, 1e-3), st.floats(60.0, 500.0))
def test_one_harmonic_is_enough(natural_frequency, damping, delay, frequency):
    command = np.sin(frequency * STEP * np.arange(12_000))
    found = identify(command, natural_frequency=natural_frequency, damping=damping, delay=delay)
    assert found.natural_frequency == pytest.approx(natural_frequency, rel=2e-3)
    assert found.damping == pytest.approx(damping, rel=2e-3)
    assert found.residual < 1e-3


@given(st.integers(1, DELAY))
def test_blocks_change_no_bit(block):
    command = np.sin(209.0 * STEP * np.arange(3000))
    assert identify(command, block=block) == identify(command)


def test_nothing_moves_nothing_is_found():
    assert identify(np.zeros(5000)) is None


def test_wrong_delay_is_taken_for_damping():
    """To first order e^{-pΔτ} is what 2ζ/ωn is: the residual stays small, the model good at the harmonic."""
    found = identify(np.sin(209.0 * STEP * np.arange(20_000)), model_delay=0.26e-3)
    assert 2 * found.damping / found.natural_frequency == pytest.approx(2 * 0.804 / 1038 + 0.1e-3, rel=0.02)


# --- in the cell

FAR_OFF = [(1.2, 0.8), (0.8, 1.2), (1.2, 1.2), (0.8, 0.8)]
ADAPTIVE = {
    "correction": "second_order_inverse_dynamic", "correction_model": "identified", "identify": True,
    "lead_law": "variable_second_order", "lead_time": 0.36e-3, "q_time": 40e-6, "soft_start": 1.0,
}  # fmt: skip


def wrong(frequency, damping):
    return {"model_natural_frequency": 1038 * frequency, "model_damping": 0.804 * damping}


@pytest.mark.parametrize(("frequency", "damping"), FAR_OFF)
def test_status_tells_the_identified_drive_and_its_margin(frequency, damping):
    swing = {"deviation_amplitude": [0.1], "deviation_frequency": [106.0]}
    result = run(
        spindle_encoder={"revolutions": 12.0, **swing},
        learning_controller={"identify": True, **wrong(frequency, damping)},
    )
    status = result.recording.sparse[STATUS].values
    assert_allclose(status["model_natural_frequency"][2:], 1038.0, rtol=1e-3)
    assert_allclose(status["model_damping"][2:], 0.804, rtol=1e-3)
    assert max(status["model_residual"][2:]) < 1e-3
    given = run(spindle_encoder={"revolutions": 12.0, **swing}, learning_controller={"identify": False})
    given_model = given.recording.sparse[STATUS].values
    assert_allclose(status["stability_margin"][3:], given_model["stability_margin"][3:], atol=5e-3)
    assert np.isnan(given_model["model_residual"]).all()


def largest_error(frequency, **controller):
    start = 3.0
    result = run(
        spindle_encoder={
            "revolutions": 65.0,
            "deviation_amplitude": [0.1],
            "deviation_frequency": [frequency],
            "deviation_start": start,
        },
        learning_controller={"events": [f"second {start}: freeze"], **controller},
    )
    return np.abs(form_error(result)[int(start * 64000) :]).max()


@pytest.mark.parametrize(("frequency", "damping"), FAR_OFF)
@pytest.mark.parametrize("deviation", [10.7, 106.0, 213.0])
def test_adaptive_inverse_beats_the_variable_lead_fivefold(frequency, damping, deviation):
    """Without knowing the speed law, with 20 % error in ωn and ζ."""
    variable = largest_error(deviation, lead_time=2e-3, q_time=130e-6)
    assert variable > 5 * largest_error(deviation, **ADAPTIVE, **wrong(frequency, damping))


def test_inverse_of_the_wrong_model_is_worse_than_the_lead():
    """The purpose of the identification."""
    given_model = {**ADAPTIVE, "correction_model": "given"}
    variable = largest_error(10.7, lead_time=2e-3, q_time=130e-6)
    assert largest_error(10.7, **given_model, **wrong(1.2, 0.8)) > 2 * variable


def test_identified_model_without_identification_is_refused():
    with pytest.raises(InputError, match="correction_model = identified without identification; set identify as well"):
        harness.run(scenario(learning_controller={"identify": False, "correction_model": "identified"}))
