# SPDX-License-Identifier: Apache-2.0
"""Resonances of the electrodynamic drive: alone, under force and with a piezo, against their transfer functions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lsim

import lathe_rc
from lathe_machine.plants.electrodynamic import ElectrodynamicDrive
from lathe_machine.plants.modes import Modes, carriage
from lathe_machine.plants.piezo import Stack
from lathe_machine.plants.tool_drive import Piezo, ToolDrive

STEP = 1 / 64000
LOOP = (2 * np.pi * 165.0, 0.7)  # ω1, ζ1
MASS, STROKE = 1.2, 1e9
OF_COIL = {"moving_mass": MASS, "force_constant": 30.0, "stroke": STROKE, "step": STEP}
FREQUENCY, DAMPING = (2 * np.pi * 900.0, 2 * np.pi * 1600.0), (0.02, 0.03)
ALIKE = Modes(FREQUENCY, DAMPING, (0.08, -0.03), (0.08, -0.03))
APART = Modes(FREQUENCY, DAMPING, (0.08, -0.03), (0.15, 0.05))
ONE_UNSEEN = Modes(FREQUENCY, DAMPING, (0.0, -0.03), (-0.1, 0.05))
ANGULAR = 2 * np.pi * np.linspace(5.0, 3000.0, 80)


def parts(modes, place):
    """Participations with that of the loop in front."""
    values = np.array(getattr(modes, place))
    return np.append(1.0 - values.sum(), values)


def resonators(modes):
    """1/(1 + 2ζp/ω + p²/ω²) of loop and modes, shape (n, frequencies)."""
    omega, zeta = np.array([LOOP[0], *modes.frequency]), np.array([LOOP[1], *modes.damping])
    p = 1j * ANGULAR / omega[:, None]
    return 1.0 / (1.0 + 2.0 * zeta[:, None] * p + p**2)


def compliance(modes):
    """Edge over the force at it [m/N]."""
    sensor, edge = parts(modes, "sensor"), parts(modes, "edge")
    kappa = np.array([e / abs(s) if s else np.sign(e) for s, e in zip(sensor, edge, strict=True)])
    return (edge * kappa) @ resonators(modes) / (MASS * LOOP[0] ** 2)


def output(a, column, place):
    """Response of a state to an input."""
    p = 1j * ANGULAR[:, None, None]
    return np.linalg.solve(p * np.eye(a.shape[0]) - a, column.astype(complex)[None, :, None])[:, place, 0]


@pytest.mark.parametrize("modes", [ALIKE, APART, ONE_UNSEEN])
def test_sensor_and_edge_respond_as_the_sum_of_their_modes(modes):
    a, command, force, edge = carriage(*LOOP, modes)
    assert a.shape == (6, 6)
    assert_allclose(output(a, command, 0), parts(modes, "sensor") @ resonators(modes), rtol=1e-9)
    assert_allclose(output(a, command, edge), parts(modes, "edge") @ resonators(modes), rtol=1e-9)
    assert_allclose(output(a, force / MASS, edge), compliance(modes), rtol=1e-9)


def test_the_edge_yields_to_its_force_at_every_resonance_in_phase():
    """The power of a force at its own point is not negative: Im(x/F) <= 0."""
    for modes in (ALIKE, APART, ONE_UNSEEN):
        assert np.all(compliance(modes).imag < 0.0)


@pytest.mark.parametrize("modes", [ALIKE, APART, ONE_UNSEEN])
def test_a_drive_with_modes_is_exact_for_commands_linear_between_samples(modes):
    command = np.random.default_rng(2).normal(size=400).cumsum()
    drive = ElectrodynamicDrive(
        natural_frequency=LOOP[0], damping=LOOP[1], delay=3.5 * STEP, method="foh", modes=modes, **OF_COIL
    )
    position, velocity, current = np.empty((3, command.size))
    drive.block(command, position, velocity, current)
    a, b, _, edge = carriage(*LOOP, modes)
    fine = np.arange(-2, 2 * command.size) / 2
    delayed = np.interp(fine - 3.5, np.arange(-1, command.size), np.append(0.0, command), left=0.0)
    _, _, states = lsim((a, b[:, None], np.eye(6), np.zeros((6, 1))), delayed, (fine + 1) * STEP)
    assert_allclose(position, states[2::2, edge], rtol=1e-8, atol=1e-8)
    assert_allclose(velocity, states[2::2, edge + 1], rtol=1e-8, atol=1e-4)
    shown = drive.plant.response(ANGULAR) * np.exp(3.5j * STEP * ANGULAR)
    triangle = np.sinc(ANGULAR * STEP / 2 / np.pi) ** 2
    assert_allclose(shown, parts(modes, "sensor") @ resonators(modes) * triangle, rtol=0, atol=2e-4)


@pytest.mark.parametrize("modes", [Modes(), ALIKE, APART, ONE_UNSEEN])
def test_a_piezo_rides_on_the_edge_of_a_carriage_with_modes(modes):
    """Tool over extension: mt·x2'' = mt·q, the base moves by -mt·q at the edge."""
    ratio, omega, zeta = 0.1, 2 * np.pi * 700.0, 0.3
    piezo = Piezo(Stack(stroke=1.0, step=STEP, method="foh"), omega, zeta, ratio, 1.0)
    drive = ToolDrive(natural_frequency=LOOP[0], damping=LOOP[1], delay=0.0, method="foh", modes=modes, piezo=piezo,
                      **OF_COIL)  # fmt: skip
    p = 1j * ANGULAR
    spring, loss = omega**2, 2.0 * zeta * omega
    give = compliance(modes) * ratio * MASS  # of the base, by the acceleration of the tool
    # p²·x2 = q, base = -give·q, q = spring·(e - x2 + base) - loss·p·(x2 - base)
    q = spring / (1.0 + (spring + loss * p) * (1.0 / p**2 + give))
    triangle = np.sinc(ANGULAR * STEP / 2 / np.pi) ** 2
    assert_allclose(drive.fine_response(ANGULAR), q / p**2 * triangle, rtol=0, atol=3e-4 * abs(q / p**2).max())


PISTON = [
    "electrodynamic_actuator.mode_frequency=[5654.9, 10053.1]",
    "electrodynamic_actuator.mode_damping=[0.02, 0.02]",
    "electrodynamic_actuator.mode_participation=[0.02, 0.01]",
    "learning_controller.q_time=0.00016",
    "spindle_encoder.revolutions=12",
]


def test_the_form_error_is_that_of_the_edge_and_the_sensor_reads_its_own_place():
    """A mode that the sensor does not see bends the edge as the acceleration does; learning leaves that error."""
    seen = lathe_rc.run(lathe_rc.load("piston", PISTON))
    edge = "electrodynamic_actuator.mode_edge=[0.07, 0.01]"
    apart = lathe_rc.run(lathe_rc.load("piston", [*PISTON, edge]))
    assert seen.errors.rms[-1] < 0.5 * apart.errors.rms[-1]
    assert apart.margins == pytest.approx(seen.margins, rel=1e-6)


@pytest.mark.system
def test_at_an_end_stop_the_edge_apart_from_the_sensor_still_makes_the_chip():
    """Depth of cut and position of the edge agree, also while the stop holds the sensor."""
    names = {"frequency": "[5e3]", "damping": "[0.02]", "participation": "[0.02]", "edge": "[0.3]"}
    changes = [f"loaded_drive.coarse_mode_{name}={value}" for name, value in names.items()]
    changes += ["loaded_drive.coarse_stroke=1e-5", "loaded_drive.cut_run_out_amplitude=[0.0]", "tool.tolerance=0.0"]
    changes += ["loaded_drive.cut_gap_start=[]", "loaded_drive.cut_gap_width=[]", "spindle_encoder.revolutions=1"]
    changes += ["controller.learned_waves=20", "controller.observer_bandwidth=2000"]
    changes += ["profile.harmonic_amplitude=[9e-6]", "loaded_drive.cut_blank=form"]
    scenario = lathe_rc.load("robust_cutting", changes)
    recording = lathe_rc.run(scenario).recording
    cut, drive, form = (recording.dense[f"/{topic}"] for topic in ("cut", "coarse/state", "reference"))
    stopped = (abs(drive["measured_position"]) > 0.99e-5) & (cut["depth_of_cut"] > 0.0)
    chip = cut["depth_of_cut"] + drive["position"] - form["reference"] - cut["allowance"]
    assert np.count_nonzero(stopped) > 100
    assert np.ptp(chip[stopped]) < 1e-9
