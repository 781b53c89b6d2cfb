# SPDX-License-Identifier: Apache-2.0
"""Gain, complex residues and real poles of the electrodynamic drive: run, margin and models against their responses."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lsim

import lathe_rc
from lathe_machine.plants.coil import Coil
from lathe_machine.plants.electrodynamic import ElectrodynamicDrive
from lathe_machine.plants.modes import Modes, carriage
from lathe_machine.plants.tool_drive import ToolDrive
from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuator, ElectrodynamicActuatorParameters
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

STEP = 1 / 64000
LOOP = (2 * np.pi * 165.0, 0.7)  # ω1, ζ1
OF_COIL = {"moving_mass": 1.2, "force_constant": 30.0, "stroke": 1e9, "step": STEP, "method": "foh"}
FREQUENCY, DAMPING = (2 * np.pi * 900.0, 2 * np.pi * 1600.0), (0.02, 0.03)
SHARES = (0.08, -0.03)
LAG = 1.0 / (2 * np.pi * 400.0)
COMPLEX = Modes(FREQUENCY, DAMPING, SHARES, SHARES, (0.05, 0.02))
LAGS = Modes(lag_time=(LAG, 0.5e-3), lag=(0.4, -0.1))
ALL = Modes(FREQUENCY, DAMPING, SHARES, (0.15, 0.05), (0.05, 0.02), (LAG,), (1.5,))
ANGULAR = 2 * np.pi * np.linspace(5.0, 3000.0, 80)


def response(modes, place, angular=ANGULAR):
    """Sum of the sections, as modes.py states it."""
    p = 1j * angular
    parts = getattr(modes, place)
    velocities = modes.velocity or (0.0,) * len(parts)
    rates = sum(r / t for r, t in zip(modes.lag, modes.lag_time, strict=True))
    own_velocity = -(np.dot(velocities, modes.frequency) + rates) / LOOP[0]
    sections = [(*LOOP, 1.0 - sum(parts) - sum(modes.lag), own_velocity)]
    sections += list(zip(modes.frequency, modes.damping, parts, velocities, strict=True))
    value = sum((e + v * p / w) / (1.0 + 2.0 * z * p / w + (p / w) ** 2) for w, z, e, v in sections)
    return value + sum(r / (1.0 + p * t) for r, t in zip(modes.lag, modes.lag_time, strict=True))


def output(a, column, place):
    p = 1j * ANGULAR[:, None, None]
    return np.linalg.solve(p * np.eye(a.shape[0]) - a, column.astype(complex)[None, :, None])[:, place, 0]


@pytest.mark.parametrize("modes", [COMPLEX, LAGS, ALL])
def test_sensor_and_edge_respond_as_the_sum_of_their_sections(modes):
    """Velocities too, on which the command does not act at once."""
    a, command, _, edge = carriage(*LOOP, modes)
    for place, at in (("sensor", 0), ("edge", edge)):
        wanted = response(modes, place)
        assert_allclose(output(a, command, at), wanted, rtol=1e-8)
        assert_allclose(output(a, command, at + 1), 1j * ANGULAR * wanted, rtol=1e-8)


@pytest.mark.parametrize("gain", [0.5, -2.0])
@pytest.mark.parametrize("modes", [Modes(), COMPLEX, LAGS, ALL])
def test_drive_is_exact_for_commands_linear_between_samples(modes, gain):
    """With its gain, in motion and in the response that the checks use; the current of a drive at rest is 0."""
    command = np.random.default_rng(2).normal(size=400).cumsum()
    drive = ElectrodynamicDrive(
        natural_frequency=LOOP[0], damping=LOOP[1], delay=3.5 * STEP, gain=gain, modes=modes, **OF_COIL
    )
    position, velocity, current = np.empty((3, command.size))
    drive.block(command, position, velocity, current)
    a, b, _, edge = carriage(*LOOP, modes)
    fine = np.arange(-2, 2 * command.size) / 2
    delayed = np.interp(fine - 3.5, np.arange(-1, command.size), np.append(0.0, command), left=0.0)
    order = b.size
    _, _, states = lsim((a, gain * b[:, None], np.eye(order), np.zeros((order, 1))), delayed, (fine + 1) * STEP)
    assert_allclose(position, states[2::2, edge], rtol=1e-7, atol=1e-7)
    assert_allclose(velocity, states[2::2, edge + 1], rtol=1e-7, atol=1e-3)
    shown = drive.plant.response(ANGULAR) * np.exp(3.5j * STEP * ANGULAR)
    triangle = np.sinc(ANGULAR * STEP / 2 / np.pi) ** 2
    assert_allclose(shown, gain * response(modes, "sensor") * triangle, rtol=0, atol=1e-3 * abs(gain))
    drive.block(np.full(64_000, 1e-3), *np.empty((3, 64_000)))
    at_rest = np.empty((3, 1))
    drive.block(np.full(1, 1e-3), *at_rest)
    assert_allclose(at_rest[:, 0], [gain * 1e-3, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("gain", [0.5, -2.0])
def test_coupled_drives_have_the_gain_with_and_without_a_current_loop(gain):
    coil = Coil(resistance=2.0, inductance=2e-3, bandwidth=12e3, back_emf=True, current_limit=np.inf,
                voltage_limit=np.inf, slew_rate=np.inf)  # fmt: skip
    for each in (None, coil):
        made = [
            ToolDrive(natural_frequency=LOOP[0], damping=LOOP[1], delay=0.0, gain=g, coil=each, **OF_COIL)
            for g in (1.0, gain)
        ]
        one, other = (drive.coarse_response(ANGULAR) for drive in made)
        assert_allclose(other, gain * one, rtol=1e-9)


def test_laws_take_the_second_order_drive_of_low_frequencies():
    """A drive of second order with a further real pole has the Taylor coefficients of their product."""
    ratio = LOOP[0] * LAG
    below = 1.0 - 2.0 * LOOP[1] * ratio + ratio**2  # of the loop at the real pole
    modes = Modes(lag_time=(LAG,), lag=(ratio**2 / below,))
    product = 1.0 / (
        (1.0 + 2.0 * LOOP[1] * 1j * ANGULAR / LOOP[0] - (ANGULAR / LOOP[0]) ** 2) * (1.0 + 1j * ANGULAR * LAG)
    )
    assert_allclose(response(modes, "sensor"), product, rtol=1e-9)
    frequency, damping = modes.model(*LOOP)
    assert_allclose(2.0 * damping / frequency, 2.0 * LOOP[1] / LOOP[0] + LAG)
    assert_allclose(1.0 / frequency**2, 1.0 / LOOP[0] ** 2 + 2.0 * LOOP[1] / LOOP[0] * LAG)
    values = ["electrodynamic_actuator.lag_time=[4e-4]", "electrodynamic_actuator.lag_participation=[0.3]"]
    controller = lathe_rc.load("piston", values).nodes["learning_controller"]
    known = Modes(lag_time=(4e-4,), lag=(0.3,)).model(1038.0, 0.804)
    assert (controller.model_natural_frequency, controller.model_damping) == pytest.approx(known)


def test_margin_and_run_have_the_gain_and_a_wrong_sign_diverges():
    def cell(*changes):
        cell = Cell(lathe_rc.load("piston", list(changes)).nodes)
        cell.check()
        return cell

    gain = "electrodynamic_actuator.gain"
    with pytest.raises(InputError, match="learning diverges with electrodynamic_actuator"):
        cell(f"{gain}=-1")
    one, half = (cell(f"{gain}={value}").drive_margins["learning_controller"].error for value in (1.0, 0.5))
    assert half > one
    run = lathe_rc.run(lathe_rc.load("piston", [f"{gain}=0.5", "spindle_encoder.revolutions=30"]))
    assert run.errors.rms[-1] < 2e-6


def test_lost_members_make_a_drive_go_to_its_safe_position_whatever_its_gain():
    for gain in (1.0, -0.5):
        drive = ElectrodynamicActuator("drive", ElectrodynamicActuatorParameters(gain=gain))
        drive.go_safe()
        outputs = np.empty((4, 64_000))
        drive.step(drive.memory, 0, 0, (np.zeros(64_000),), (), tuple(outputs))
        assert_allclose(outputs[0, -1], 0.3e-3, rtol=1e-6)
        assert np.abs(outputs[1]).max() <= 0.1
