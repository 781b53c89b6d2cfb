# SPDX-License-Identifier: Apache-2.0
"""A spindle that the cut slows: limits to the bit, balances, speed over load, torque limit, hosts."""

import numpy as np
import pytest
from cells import in_blocks, scenario
from machines import assert_refused
from numpy.testing import assert_allclose
from scipy.signal import lsim

from lathe_machine.plants.spindle import Belt, LoadedSpindle, SpeedLoop
from lathe_machine.transfer import TransferFunction
from lathe_rc import harness
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import LatheError

STEP = 1 / 64000
SPEED = 100.0  # [rad/s]
INERTIA = {"inertia": 0.03, "motor_inertia": 0.01}
LOOP = SpeedLoop(bandwidth=30.0, integral_time=0.1)
BELT = Belt(stiffness=2000.0, damping=0.5)
RADIUS = 0.05  # [m]


def make(belt=None, loop=LOOP, **options):
    return LoadedSpindle(**{**INERTIA, **options}, belt=belt, loop=loop, radius=RADIUS, step=STEP)


def turned(spindle, force, lengths=None, angle=None, speed=None):
    """Angle, speed and torque under a force, at constant speed by default."""
    time = STEP * np.arange(force.size)
    rows = [force, SPEED * time if angle is None else angle.copy()]
    rows += [np.full(force.size, SPEED) if speed is None else speed.copy(), np.empty(force.size)]

    def block(first, force, angle, speed, torque):
        torque[:] = spindle.block(first, force, angle, speed)

    in_blocks(lengths or [force.size], block, *rows)
    return rows[1:]


def interrupted(samples):
    """100 N with two gaps a revolution, behind a lag of 1 ms or so."""
    time = STEP * np.arange(samples)
    force = 100.0 * ((SPEED * time) % np.pi > 0.4)
    kernel = np.exp(-time[:640] / 1e-3)
    return np.convolve(force, kernel / kernel.sum())[:samples]


# --- limits


CUT = {"depth": 0.3e-3, "lag": 2e-3, "elasticity": "rigid", "gap_start": [1.0], "gap_width": [0.4]}
LAW = {"deviation_amplitude": [0.02], "deviation_frequency": [30.0], "counts_per_revolution": 20000, "edge_clock": 1e-7}
SAME = ("/encoder", "/tool", "/cut", "/coarse/command")


@pytest.mark.parametrize("what", [{"inertia": 1e30}, {"part_radius": 0.0}], ids=["infinite inertia", "no torque"])
def test_a_spindle_that_nothing_slows_follows_its_law_to_the_bit(what):
    law, held = (
        harness.run(scenario(spindle_encoder={**LAW, **more}, cutting_process={"moved_by": ["tool"], **CUT})).digest
        for more in ({}, {"stage": "loaded_spindle", **what})
    )
    assert [held[topic] for topic in SAME] == [law[topic] for topic in SAME]


# --- balances


@pytest.mark.parametrize("limit", [np.inf, 4.0])
def test_momentum_and_energy_of_a_rigid_spindle_are_in_balance(limit):
    """The torque stands through a step and the load is linear in it: every integral is exact."""
    inertia, loop = sum(INERTIA.values()), SpeedLoop(30.0, 0.1, torque_limit=limit)
    force = interrupted(20_000)
    angle, speed, torque = turned(make(loop=loop), force)
    assert (np.abs(torque).max() == 4.0) == np.isfinite(limit)
    load, given = RADIUS * force, torque[1:]
    before, after = load[:-1], load[1:]
    push = STEP * (given - (before + after) / 2)
    through = STEP * float(np.abs(given).sum() + load.sum())
    assert abs(inertia * (speed[-1] - speed[0]) - push.sum()) < 1e-9 * through
    # ∫(T - M)·Ω over a step, with Ω the parabola that both its ends and the mean of its slope give.
    nodes, weights = np.polynomial.legendre.leggauss(4)
    t = STEP * (nodes[:, None] + 1) / 2
    slope = (after - before) / STEP
    rate = speed[:-1] + ((given - before) * t - slope * t**2 / 2) / inertia
    power = given - before - slope * t
    work = STEP / 2 * float((weights @ (power * rate)).sum())
    passed = STEP / 2 * float((weights @ ((np.abs(given) + np.abs(before)) * rate)).sum())
    assert abs(inertia * (speed[-1] ** 2 - speed[0] ** 2) / 2 - work) < 1e-9 * passed
    assert_allclose(STEP / 2 * (weights @ rate), np.diff(angle), rtol=1e-9)


def test_a_spindle_on_its_belt_obeys_its_equations_of_motion():
    """The torque stands through a step and the load is linear in it: SciPy's holds are exact for both."""
    force, spindle = interrupted(8000), make(BELT)
    angle, speed, torque = turned(spindle, force)
    inertia, motor = INERTIA["inertia"], INERTIA["motor_inertia"]
    twist = np.array([-BELT.stiffness, -BELT.damping, BELT.stiffness, BELT.damping])
    a = np.array([[0, 1, 0, 0], twist / inertia, [0, 0, 0, 1], -twist / motor])  # δ, δ', ϑ, ϑ'
    time = STEP * np.arange(force.size + 1)  # from the sample before the first on
    moved = np.zeros((time.size, 4))
    for gain, signal, linear in (
        ([0, -1 / inertia, 0, 0], np.append(0.0, RADIUS * force), True),
        ([0, 0, 0, 1 / motor], np.append(torque, 0.0), False),
    ):
        system = a, np.array(gain)[:, None], np.eye(4), np.zeros((4, 1))
        moved += lsim(system, signal, time, interp=linear)[2]
    assert_allclose(angle - SPEED * time[:-1], moved[1:, 0], atol=1e-9 * np.abs(moved[:, 0]).max())
    assert_allclose(speed - SPEED, moved[1:, 1], atol=1e-9 * np.abs(moved[:, 1]).max())
    assert_allclose(spindle.table.state, moved[-1], rtol=1e-7, atol=1e-9)


# --- speed over load


def speed_over_load(*, inertia, motor_inertia, belt, loop):
    """δ' over the load's torque [rad/s over N·m], without the torque limit and the sampling of the loop.

    With a rigid belt -p/((J + Jm)·p² + Kp·p + Ki).

    """
    whole = inertia + motor_inertia
    proportional, integral = loop.gains(whole)
    if belt is None:
        return TransferFunction((-1.0, 0.0), (whole, proportional, integral))
    twist = np.array([belt.damping, belt.stiffness])
    motor = np.polyadd([motor_inertia, proportional, integral], twist)
    spindle = np.polyadd([inertia, 0.0, 0.0], twist)
    bottom = np.polysub(np.polymul(spindle, motor), np.polymul(twist, twist))
    return TransferFunction(tuple(-np.polymul([1.0, 0.0], motor)), tuple(bottom))


@pytest.mark.parametrize("frequency", [5.0, 30.0, 200.0, 500.0, 1500.0])
@pytest.mark.parametrize("belt", [None, BELT], ids=["rigid", "belt"])
def test_speed_over_load_is_that_of_the_formula(belt, frequency):
    """Speed over torque of a sine, within 1 %."""
    period = round(2 * np.pi / frequency / STEP)
    settle = -(-round(1.2 / STEP) // period)
    force = 10.0 * np.sin(2 * np.pi / period * np.arange((settle + 4) * period))
    _, speed, _ = turned(make(belt), force)
    kernel = np.exp(-2j * np.pi * np.arange(4 * period) / period)
    found = ((speed - SPEED)[-kernel.size :] @ kernel) / (RADIUS * force[-kernel.size :] @ kernel)
    exact = speed_over_load(**INERTIA, belt=belt, loop=LOOP).response(2 * np.pi / (period * STEP))
    assert abs(found / exact - 1.0) < 0.01


def test_the_motor_also_accelerates_the_spindle_as_its_law_says():
    """It may add as much to the torque of the law as that leaves of the limit."""
    time = STEP * np.arange(6400)
    law = SPEED + 200.0 * time
    spindle = make(loop=SpeedLoop(30.0, 0.1, torque_limit=10.0))
    _, _, torque = turned(spindle, np.full(6400, 100.0), angle=SPEED * time + 100.0 * time**2, speed=law)
    assert torque.max() == pytest.approx(10.0 - 200.0 * 0.04, rel=1e-6)  # 5 N·m of load are beyond it


# --- in a cell


def loaded(**values):
    """A whole cell in which drive, cut and spindle load each other."""
    cell = scenario(
        spindle_encoder={"stage": "loaded_spindle", "revolutions": 2.0, **values},
        profile={},
        tool={"reference": "topic"},
        loaded_drive={f"cut_{name}": value for name, value in CUT.items()},
    )
    return Scenario("test", {name: table for name, table in cell.nodes.items() if name != "electrodynamic_actuator"})


def test_an_interrupted_cut_makes_the_speed_swing():
    speed = harness.run(loaded()).recording.dense["/encoder"]["speed_true"]
    assert 0.05 < np.ptp(speed[speed.size // 2 :]) < 5.0


def test_a_torque_limit_is_told():
    found = harness.run(loaded(torque_limit=3.0)).recording.sparse["/spindle_encoder/events"]
    assert found.values["action"][0] == "limited: torque"


def test_a_load_or_a_deviation_beyond_what_is_allowed_ends_the_run():
    with pytest.raises(LatheError, match=r"spindle_encoder: the cut loads the spindle with .* largest_load = 1 N"):
        harness.run(loaded(largest_load=1.0))
    with pytest.raises(LatheError, match=r"spindle_encoder: the load changes the speed by -0\.1"):
        harness.run(loaded(largest_deviation=1e-3))


def test_a_delay_shorter_than_a_block_and_a_loop_that_oscillates_are_refused():
    delayed = loaded(load_delay=63)
    assert_refused(
        lambda: harness.run(delayed), "spindle_encoder: feedback of cut is delayed by 63 samples, block_size"
    )
    assert_refused(lambda: make(Belt(2000.0, 0.0), SpeedLoop(200e3, 0.01)), "speed loop of 200000 rad/s: largest pole")
    assert_refused(lambda: make(Belt(1e10, 0.0), SpeedLoop(30.0, 0.1)), "a stiff belt needs damping")
    make(Belt(1e10, 1.0), SpeedLoop(30.0, 0.1))
