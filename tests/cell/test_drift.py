# SPDX-License-Identifier: Apache-2.0
"""A drive that drifts, and a sensor that samples with jitter."""

import numpy as np
import pytest
from cells import scenario
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

from lathe_machine.plants.drift import Drift
from lathe_machine.plants.electrodynamic import ElectrodynamicDrive
from lathe_machine.plants.modes import Modes
from lathe_machine.plants.tool_drive import ToolDrive
from lathe_machine.plants.tool_motion import advance
from lathe_rc import harness
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

STEP = 1 / 64000
SERVO = {"natural_frequency": 1036.7, "damping": 0.7, "delay": 0.2e-3, "stroke": 1.0, "moving_mass": 1.2}
SERVO |= {"force_constant": 30.0, "step": STEP, "method": "foh"}
FREQUENCY, DAMPING, SHARES = (5654.9, 10053.1), (0.02, 0.02), (0.02, -0.01)
MODES = Modes(FREQUENCY, DAMPING, SHARES, SHARES)
COUNT = 4096
TIME = STEP * np.arange(COUNT)
COMMAND = 1e-4 * (np.sin(5654.9 * TIME) + np.sin(700.0 * TIME) + np.sin(10100.0 * TIME))


def moved(drift, length=COUNT):
    """Position and current of the drive for the command, in blocks of a length."""
    drive = ElectrodynamicDrive(**SERVO, modes=MODES, drift=drift)
    position, velocity, current = np.zeros((3, COUNT))
    for first in range(0, COUNT, length):
        part = slice(first, first + length)
        drive.block(COMMAND[part], position[part], velocity[part], current[part], first)
    return position, current


def exact(drift):
    """Position by integration of the equations with time-varying frequencies."""
    omega, zeta = np.array([SERVO["natural_frequency"], *FREQUENCY]), np.array([SERVO["damping"], *DAMPING])
    share = np.array([1.0 - sum(SHARES), *SHARES])

    def rates(t, state):
        passed = min(t, drift.end)
        own = omega * np.array([1.0, *[1.0 + drift.modes * passed] * 2])
        entered = t - SERVO["delay"]
        given = np.interp(entered, TIME, COMMAND, left=0.0) * (1.0 + drift.gain * min(max(entered, 0.0), drift.end))
        x, v = state[:3], state[3:]
        return np.concatenate((v, own**2 * (given - x) - 2.0 * zeta * own * v))

    found = solve_ivp(rates, (0.0, TIME[-1]), np.zeros(6), t_eval=TIME, rtol=1e-8, atol=1e-13, max_step=STEP)
    return share @ found.y[:3]


def test_a_drift_moves_the_drive_as_its_equations_with_varying_coefficients():
    drift = Drift(gain=2.0, modes=-1.5, end=0.04)  # by 8 and -6 %, then they stay
    position, _ = moved(drift)
    wanted = exact(drift)
    still = moved(Drift())[0]
    assert abs(still - wanted).max() > 0.1 * abs(wanted).max()
    assert_allclose(position, wanted, rtol=0.0, atol=2e-3 * abs(wanted).max())


def test_a_drift_has_the_same_bits_for_all_block_lengths_and_moves_the_loaded_drive_alike():
    drift = Drift(gain=2.0, modes=-1.5, end=0.04)
    wanted = moved(drift)
    for length in (1, 17, 64, 1000):
        for one, other in zip(moved(drift, length), wanted, strict=True):
            assert_array_equal(one, other)
    loaded = ToolDrive(**SERVO, modes=MODES, drift=drift)
    motion, still = tuple(np.zeros((7, COUNT))), np.zeros(COUNT)
    advance(loaded.table, 0, COMMAND, still, still, np.empty(0), motion)
    assert_allclose(motion[0], wanted[0], rtol=0.0, atol=1e-17)
    assert_allclose(motion[2], wanted[1], rtol=0.0, atol=1e-10)


DRIFTS = {"gain_drift": 0.05, "mode_drift": -0.5, "drift_time": 0.06}
RESONANT = {"mode_frequency": [5654.9], "mode_damping": [0.02], "mode_participation": [0.001]}


def test_jitter_reads_the_position_at_other_instants():
    """The reading is the position 1 µs RMS late or early, and the motion stays that of the same command."""
    made = {"noise_rms": 0.0, "sampling_jitter": 1e-6, **RESONANT}
    one, other = (
        harness.run(scenario({"block_size": size}, electrodynamic_actuator=made)).recording for size in (64, 17)
    )
    state = one.dense["/coarse/state"]
    off, fast = state["measured_position"] - state["position"], abs(state["velocity"]) > 0.01
    late = off[fast] / state["velocity"][fast]
    assert late.std() == pytest.approx(1e-6, rel=0.05)
    assert abs(late.mean()) < 5e-8
    assert abs(np.corrcoef(late[1:], late[:-1])[0, 1]) < 0.05
    assert_array_equal(state["measured_position"], other.dense["/coarse/state"]["measured_position"])


def test_the_margin_is_that_of_the_worst_state_of_a_drift():
    def checked(**more):
        cell = Cell(scenario(electrodynamic_actuator={**RESONANT, **more}, learning_controller={"q_time": 1e-4}).nodes)
        cell.check()
        return cell.margins["learning_controller"], cell.drive_margins["learning_controller"].error

    start = checked()
    end = checked(mode_frequency=[0.97 * 5654.9], gain=1.003)
    along = checked(**DRIFTS)
    assert start != end
    assert along[0] <= min(start[0], end[0]) + 1e-9
    assert along[1] <= min(start[1], end[1]) + 1e-9


def test_a_drift_that_ends_in_divergence_is_refused():
    strong = {**RESONANT, "mode_participation": [0.01], "mode_frequency": [6200.0]}
    Cell(scenario(electrodynamic_actuator=strong).nodes).check()
    cell = Cell(scenario(electrodynamic_actuator={**strong, "mode_drift": -1.5, "drift_time": 0.1}).nodes)
    with pytest.raises(InputError, match=r"diverges with electrodynamic_actuator after 0\.0?\d+ s of its drift"):
        cell.check()
