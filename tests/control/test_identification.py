# SPDX-License-Identifier: Apache-2.0
"""Identification of the drive while it runs, and the law that uses it."""

import numpy as np
import pytest
from cells import encoder, form_error, run
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_machine.control.identification import DriveIdentifier
from lathe_machine.plants.electrodynamic import ElectrodynamicDrive

STATUS = "/coarse/learning"
STEP = 1 / 64000
DELAY = 300


def respond(command, natural_frequency=1038.0, damping=0.804, delay=0.36e-3):
    """Position of a drive."""
    drive = ElectrodynamicDrive(
        natural_frequency=natural_frequency, damping=damping, delay=delay, stroke=1e3, moving_mass=1.0,
        force_constant=1.0, step=STEP, method="foh",
    )  # fmt: skip
    position, velocity, effort = np.empty((3, command.size))
    drive.block(command, position, velocity, effort)
    return position


def identify(command, *drive, model_delay=0.36e-3, block=DELAY):
    late = np.concatenate((np.zeros(DELAY), respond(command, *drive)))[: command.size]
    identifier = DriveIdentifier(
        model_delay=model_delay, feedback_delay=DELAY, bandwidth=1000.0, forgetting=0.5, step=STEP, block=DELAY
    )
    for start in range(0, command.size, block):
        part = slice(start, min(start + block, command.size))
        identifier.block(start, 0, part.stop - start, late[part])
        identifier.commanded(start, command[part])
    return identifier.fit()


@given(st.floats(300.0, 3000.0), st.floats(0.2, 1.5), st.floats(0.0, 1e-3), st.floats(60.0, 500.0))
def test_one_harmonic_is_enough(natural_frequency, damping, delay, frequency):
    command = np.sin(frequency * STEP * np.arange(12_000))
    found = identify(command, natural_frequency, damping, delay, model_delay=delay)
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
    "lead_time": 0.36e-3, "q_time": 40e-6, "soft_start": 1.0,
}  # fmt: skip


def wrong(frequency, damping):
    return {"model_natural_frequency": 1038 * frequency, "model_damping": 0.804 * damping}


def test_status_tells_the_identified_drive_and_its_margin():
    def status(**controller):
        spindle = {"revolutions": 8.0, "deviation_amplitude": [0.1], "deviation_frequency": [106.0]}
        return run(spindle_encoder=spindle, learning_controller=controller).recording.sparse[STATUS].values

    right = status(identify=False)
    assert np.isnan(right["model_residual"]).all()
    for far_off in FAR_OFF:
        found = status(identify=True, **wrong(*far_off))
        assert_allclose(found["model_natural_frequency"][2:], 1038.0, rtol=1e-3)
        assert_allclose(found["model_damping"][2:], 0.804, rtol=1e-3)
        assert max(found["model_residual"][2:]) < 1e-3
        assert_allclose(found["stability_margin"][3:], right["stability_margin"][3:], atol=5e-3)


def largest_error(lead_law, frequency, start=2.0, **controller):
    """Largest form error after learning at constant speed, then frozen, under a speed that swings by 10 %."""
    swing = {"deviation_amplitude": [0.1], "deviation_frequency": [frequency], "deviation_start": start}
    result = run(
        spindle_encoder={"revolutions": 17.0 * start + 14.0, **swing},
        learning_controller={"lead_law": lead_law, "events": [f"second {start}: freeze"], **controller},
    )
    speed, first = encoder(result)["speed_true"], int(start / STEP)
    assert np.ptp(speed[:first]) == 0.0
    assert np.ptp(speed[first:]) == pytest.approx(0.2 * 1000 * np.pi / 30, rel=1e-3)
    return np.abs(form_error(result)[first:]).max()


LEAD = {"lead_time": 2e-3, "q_time": 130e-6}


@pytest.mark.parametrize("frequency", [10.7, 106.0, 213.0])
def test_variable_lead_beats_constant_lead_fivefold(frequency):
    constant, variable = (largest_error(law, frequency, **LEAD) for law in ("constant_angle", "variable"))
    assert constant >= 5 * variable
    # T0·ΔΩ of 2 ms · 10.5 rad/s is 0.021 rad, on a slope of 450 µm/rad.
    assert constant == pytest.approx(9.4e-6, rel=0.1)


@pytest.mark.parametrize("deviation", [10.7, 106.0, 213.0])
def test_adaptive_inverse_beats_the_variable_lead_fivefold(deviation):
    """Without knowing the speed law, with 20 % error in ωn and ζ; without identification it would be worse."""
    variable = largest_error("variable", deviation, 3.0, **LEAD)
    for far_off in FAR_OFF:
        model = {**ADAPTIVE, **wrong(*far_off)}
        assert variable > 5 * largest_error("variable_second_order", deviation, 3.0, **model)
    if deviation == 10.7:
        model |= {"correction_model": "given", **wrong(1.2, 0.8)}
        assert largest_error("variable_second_order", deviation, 3.0, **model) > 2 * variable
