# SPDX-License-Identifier: Apache-2.0
"""A spindle that the cut slows: limits to the bit, balances, speed over load, torque limit, hosts."""

import numpy as np
import pytest
from cells import in_blocks, scenario
from numpy.testing import assert_allclose

from lathe_rc import harness, hosts
from lathe_rc.cell.scenario import Scenario
from lathe_rc.errors import InputError, LatheError
from lathe_rc.plants.spindle import Belt, LoadedSpindle, SpeedLoop
from lathe_rc.transfer import TransferFunction

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


CUT = {
    "moved_by": ["tool"],
    "depth": 0.3e-3,
    "lag": 2e-3,
    "elasticity": "rigid",
    "gap_start": [1.0],
    "gap_width": [0.4],
}
LAW = {"deviation_amplitude": [0.02], "deviation_frequency": [30.0], "counts_per_revolution": 20000}
SAME = ("/encoder", "/tool", "/cut", "/coarse/command")


@pytest.mark.parametrize("what", [{"inertia": 1e30}, {"part_radius": 0.0}], ids=["infinite inertia", "no torque"])
def test_a_spindle_that_nothing_slows_follows_its_law_to_the_bit(what):
    law = harness.run(scenario(spindle_encoder=LAW, cutting_process=CUT)).digest
    spindle = {"stage": "loaded_spindle", **LAW, **what}
    held = harness.run(scenario(spindle_encoder=spindle, cutting_process=CUT)).digest
    assert [held[topic] for topic in SAME] == [law[topic] for topic in SAME]


@pytest.mark.parametrize("belt", [None, BELT])
def test_the_length_of_a_block_changes_no_bit(belt):
    force = interrupted(3000)
    whole, pieces = turned(make(belt), force), turned(make(belt), force, [1, 64, 935, 1000, 1000])
    assert all(np.array_equal(one, other) for one, other in zip(whole, pieces, strict=True))


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


def test_momentum_and_energy_of_a_spindle_on_its_belt_are_in_balance():
    """Between two samples the state is followed by the equations, from sample to sample by the machine."""
    force, spindle = interrupted(8000), make(BELT)
    angle, speed, torque = turned(spindle, force)
    inertia, motor = INERTIA["inertia"], INERTIA["motor_inertia"]
    load, wind = RADIUS * force, angle - SPEED * STEP * np.arange(force.size)
    # What the motor does follows from momentum: J·Δδ' + Jm·Δϑ' = ∫(T - r·F)dt.
    push = np.cumsum(STEP * (torque[1:] - (load[1:] + load[:-1]) / 2))
    motor_speed = np.concatenate(([0.0], (push - inertia * (speed[1:] - SPEED)) / motor))
    assert motor_speed[-1] == pytest.approx(spindle.table.state[3], rel=1e-9)
    # Energy of the masses and of the belt, in the frame that turns as the law says.
    motor_angle = wind + 0.0
    motor_angle[-1] = spindle.table.state[2]
    state = np.array([wind[-1], speed[-1] - SPEED, motor_angle[-1], motor_speed[-1]])
    assert_allclose(state, spindle.table.state, rtol=1e-9, atol=1e-15)
    energy = 0.5 * inertia * state[1] ** 2 + 0.5 * motor * state[3] ** 2
    energy += 0.5 * BELT.stiffness * (state[2] - state[0]) ** 2
    follow, exchanged, passed = np.zeros(4), 0.0, 0.0
    stiff = 8  # parts of a step, each by Runge and Kutta
    for n in range(1, force.size):
        for part in range(stiff):
            follow, work = _part_of_a_step(follow, torque[n], load[n - 1], load[n], part / stiff, STEP / stiff)
            exchanged, passed = exchanged + work, passed + abs(work)
    assert abs(energy - exchanged) < 1e-9 * passed
    assert_allclose(follow, state, rtol=1e-7)


def _part_of_a_step(state, torque, before, after, since, step):
    """State and work of torque, load and the belt's damper after a part of a step."""
    inertia, motor = INERTIA["inertia"], INERTIA["motor_inertia"]

    def rates(y, at):
        load = before + (after - before) * at
        twist = y[3] - y[1]
        belt = BELT.stiffness * (y[2] - y[0]) + BELT.damping * twist
        work = torque * y[3] - load * y[1] - BELT.damping * twist**2
        return np.array([y[1], (belt - load) / inertia, y[3], (torque - belt) / motor, work])

    y, share = np.append(state, 0.0), step / STEP
    k1 = rates(y, since)
    k2 = rates(y + step / 2 * k1, since + share / 2)
    k3 = rates(y + step / 2 * k2, since + share / 2)
    k4 = rates(y + step * k3, since + share)
    y = y + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return y[:4], y[4]


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
        spindle_encoder={"stage": "loaded_spindle", "revolutions": 4.0, **values},
        profile={},
        tool={"reference": "topic"},
        loaded_drive={f"cut_{name}": value for name, value in CUT.items() if name != "moved_by"},
    )
    return Scenario("test", {name: table for name, table in cell.nodes.items() if name != "electrodynamic_actuator"})


def test_an_interrupted_cut_makes_the_speed_swing_in_every_host(tmp_path):
    cell = loaded()
    found = hosts.digests_by_host(cell, tmp_path)
    assert all(topics == found["offline"] for topics in found.values())
    speed = harness.run(cell).recording.dense["/encoder"]["speed_true"]
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
    with pytest.raises(InputError, match="spindle_encoder: feedback of cut is delayed by 63 samples, block_size = 64"):
        harness.run(loaded(load_delay=63))
    with pytest.raises(InputError, match="speed loop of 200000 rad/s: largest pole"):
        make(Belt(2000.0, 0.0), SpeedLoop(200e3, 0.01))
    with pytest.raises(InputError, match="a stiff belt needs damping"):
        make(Belt(1e10, 0.0), SpeedLoop(30.0, 0.1))
    make(Belt(1e10, 1.0), SpeedLoop(30.0, 0.1))
