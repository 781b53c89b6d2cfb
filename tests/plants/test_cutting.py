# SPDX-License-Identifier: Apache-2.0
"""The cutting process: numbers of the spec, chip, lag, part, wear, deflection, remembered surface."""

import numpy as np
import pytest
from cells import cuts, same
from hypothesis import given
from hypothesis import strategies as st
from machines import assert_refused, refusals, run
from numpy.testing import assert_allclose

from lathe_machine.plants.cutting import GIVEN, MADE, CuttingProcess
from lathe_machine.plants.cutting_force import PAPER, REALISTIC, RIGID, STEEL, Elasticity, Flank, SpecificForce, Wear
from lathe_machine.plants.workpiece import HardSpot, Workpiece
from lathe_machine.signals.allowance import PAPER_RMS, Allowance, mean_reverting
from lathe_machine.transfer import LinearSystem, TransferFunction
from lathe_rc.errors import LatheError
from lathe_rc.signals import speed as speeds

STEP = 1 / 64000
SPEED = 100.0  # [rad/s]
STIFFNESS = 233.3e3  # W4 of paper 004 [N/m]
FEED = STEEL.feed_for(STIFFNESS)  # [m/rev]
DEPTH = 150.0 / STIFFNESS  # [m]


def make(**options):
    return CuttingProcess(**{"depth": DEPTH, "lag": 0.0, "step": STEP, **options})


def cut(process, samples, lengths=None, **inputs):
    """The outputs of a process, at constant speed and feed by default."""
    rate = np.float64(inputs.get("speed", SPEED))
    default = {"angle": SPEED * STEP * np.arange(samples), "speed": rate, "feed_velocity": FEED * rate / (2 * np.pi)}
    values = {**default, **inputs}
    # Copies, for Numba compiles anew for arrays that cannot be written.
    arrays = [np.array(np.broadcast_to(np.float64(values.get(name, 0.0)), samples)) for name in GIVEN]

    def block(_, *parts):
        process.block(**dict(zip(GIVEN + MADE, parts, strict=True)))

    outputs = run(block, len(MADE), *arrays, lengths=lengths)
    return dict(zip(MADE, outputs, strict=True))


# --- numbers of the spec


def test_w4_of_the_paper_is_the_feed_that_the_spec_names():
    """233.3 N/mm at 0.071 mm/rev in steel, both rounded: 0.07081 mm exactly."""
    assert round(FEED * 1e3, 3) == 0.071
    assert STEEL.stiffness(0.071e-3) == pytest.approx(STIFFNESS, rel=3e-3)
    assert STEEL.stiffness(0.071e-3) == pytest.approx(1e3 * 1700 * 0.071**0.75)  # Kienzle in N and mm


def test_150_newtons_are_0643_mm():
    assert round(DEPTH * 1e3, 3) == 0.643
    assert_allclose(cut(make(), 10)["force"], 150.0)


def test_allowance_of_the_paper_makes_its_disturbance():
    """0.0207 mm RMS are 4.83 N RMS at 233.3 N/mm; the walk's own RMS is known to 1.6 %."""
    step, samples = 0.02, 200_000
    allowance, none = np.empty(samples), np.empty(0)
    walk = Allowance(mean_reverting(PAPER_RMS, 1.0, step), order=none, amplitude=none, phase=none, seed=5)
    walk.block(np.zeros(samples), allowance)
    force = cut(make(step=step), samples, allowance=allowance)["force"]
    assert force.std() / allowance.std() * PAPER_RMS == pytest.approx(4.83, abs=0.005)
    assert force.std() == pytest.approx(4.83, rel=0.04)


# --- force


def test_specific_force_is_the_power_law():
    material = SpecificForce(2.1e9, 0.3, wear_factor=800.0)
    assert material.stiffness(1e-3) == pytest.approx(2.1e6)
    assert material.stiffness(0.2e-3) / material.stiffness(0.1e-3) == pytest.approx(2**0.7)
    assert material.stiffness(0.2e-3, 0.25e-3) == pytest.approx(1.2 * material.stiffness(0.2e-3))
    assert material.feed_for(material.stiffness(0.2e-3, 1e-4), 1e-4) == pytest.approx(0.2e-3)


def test_feed_is_that_of_a_revolution_at_any_speed():
    rate = np.linspace(50.0, 200.0, 100)
    out = cut(make(), 100, speed=rate, feed_velocity=2e-3)
    assert_allclose(out["feed"], 2e-3 * 2 * np.pi / rate)
    assert_allclose(out["force"], [STEEL.stiffness(feed) * DEPTH for feed in out["feed"]])


def test_feed_backwards_cuts_nothing():
    out = cut(make(), 30, feed_velocity=np.repeat([1e-3, -1e-3, 0.0], 10))
    assert np.all(out["force"][:10] > 0.0)
    assert not np.any(out["force"][10:])
    assert not np.any(out["feed"][10:])


def test_lag_is_exact_for_a_chip_that_is_linear_between_samples():
    """A chip that grows in the sample before the first: the mean of the step responses over it."""
    lag = 2e-3
    time = STEP * np.arange(1000)
    force = cut(make(lag=lag), 1000)["force"]
    assert_allclose(force, 150.0 * (1 - np.exp(-time / lag) * lag / STEP * -np.expm1(-STEP / lag)), rtol=1e-12)


def test_chip_is_what_stands_before_the_edge_and_never_negative():
    random = np.random.default_rng(1)
    cross, tool, allowance = random.normal(scale=DEPTH / 2, size=(3, 1000))
    out = cut(make(), 1000, cross_position=cross, displacement=tool, allowance=allowance)
    free = DEPTH + allowance - cross - tool
    assert_allclose(out["depth_of_cut"], np.maximum(free, 0.0), atol=1e-18)
    assert np.all(out["force"] >= 0.0)
    assert np.sum(free < 0.0) > 50


# --- part


@given(st.floats(-10.0, 10.0), st.floats(0.05, 6.0), st.floats(0.0, 1e4))
def test_keyway_leaves_its_part_of_a_revolution_uncut(start, width, begin):
    """A second keyway within the first makes no difference."""
    samples = 4000
    angle = begin + 2 * np.pi * (np.arange(samples) + 0.5) / samples
    out = cut(make(part=Workpiece(gaps=[(start, width), (start, width / 3)])), samples, angle=angle)
    gap = out["depth_of_cut"] == 0.0
    assert abs(gap.mean() - width / (2 * np.pi)) <= 1.5 / samples
    middle = np.cos(angle - start - width / 2)
    assert middle[gap].min() >= np.cos(width / 2) - 1e-2
    assert np.all(out["force"][gap] == 0.0)


def test_hard_spot_is_a_window_of_angle_and_height():
    spots = [HardSpot(6.0, 0.6, 0.01, 0.02, 1.5), HardSpot(0.1, 0.1, 0.0, 1.0, 2.0)]
    process = make(part=Workpiece(hard_spots=spots))
    angle = np.array([6.1, 0.05, 0.15, 0.25, 0.4, 6.1, 6.1, 0.15])
    height = np.array([0.015, 0.015, 0.015, 0.015, 0.015, 0.005, 0.021, 0.5])
    factor = cut(process, 8, angle=angle, height=height)["force"] / 150.0
    assert_allclose(factor, [1.5, 1.5, 3.0, 1.5, 1.0, 1.0, 1.0, 2.0])


# --- wear


def test_wear_grows_with_time_and_path_in_the_cut():
    wear = Wear(initial=1e-5, per_metre=1e-7, per_second=1e-6)
    process = make(wear=wear, part=Workpiece(radius=0.04), material=SpecificForce(wear_factor=1000.0))
    cross = np.where(np.arange(64_000) < 32_000, 0.0, 2 * DEPTH)  # half a second of cutting
    out = cut(process, 64_000, cross_position=cross)
    time = np.minimum(np.arange(64_000), 32_000) * STEP
    assert_allclose(out["wear"], 1e-5 + (1e-7 * 0.04 * SPEED + 1e-6) * time, rtol=1e-9)
    assert_allclose(out["force"][:32_000], 150.0 * (1 + 1000.0 * out["wear"][:32_000]), rtol=1e-12)


# --- deflection


@pytest.mark.parametrize("elasticity", [PAPER, REALISTIC, Elasticity(2e-6, 0.0, 0.0, away=True)])
def test_deflection_settles_where_force_and_spring_agree(elasticity):
    """F = K·(depth - σ·c·F)."""
    out = cut(make(elasticity=elasticity, step=1e-2), 50_000)
    sign = 1.0 if elasticity.away else -1.0
    static = 150.0 / (1 + sign * elasticity.compliance * STIFFNESS)
    assert_allclose(out["force"][-100:], static, rtol=1e-9)
    assert_allclose(out["deflection"][-100:], sign * elasticity.compliance * static, rtol=1e-9)
    assert_allclose(out["depth_of_cut"] + out["deflection"], DEPTH)


@pytest.mark.parametrize("lag", [0.0, 2e-3])
@pytest.mark.parametrize("elasticity", [PAPER, REALISTIC])
def test_force_bends_the_tool_of_its_own_sample(elasticity, lag):
    """To rounding, at a step of a tenth of the mode's period or more."""
    allowance = np.random.default_rng(6).normal(scale=1e-5, size=500)
    out = cut(make(elasticity=elasticity, lag=lag, step=2e-3), 500, allowance=allowance)
    assert_allclose(out["depth_of_cut"] + out["deflection"], DEPTH + allowance, rtol=1e-13)


@pytest.mark.parametrize("lag", [0.0, 0.075])
@pytest.mark.parametrize("elasticity", [PAPER, REALISTIC])
def test_loop_over_the_deflection_is_the_linear_one(elasticity, lag):
    """F/d = K/(1 + pT)/(1 + σ·K·W3/(1 + pT)), to the square of the step."""
    samples, sign = 20_000, 1.0 if elasticity.away else -1.0
    allowance = 1e-5 * np.sin(300.0 * STEP * np.arange(samples)) + 1e-5 * np.sin(15.0 * STEP * np.arange(samples))
    runs = [cut(make(elasticity=elasticity, lag=lag), samples, allowance=part) for part in (allowance, 0.0)]
    change = runs[0]["force"] - runs[1]["force"]
    w3 = elasticity.transfer
    bottom = np.polyadd(np.polymul((lag, 1.0), w3.denominator), np.multiply(sign * STIFFNESS, w3.numerator))
    closed = LinearSystem(TransferFunction(tuple(np.multiply(STIFFNESS, w3.denominator)), tuple(bottom)), STEP)
    expected = np.empty(samples)
    closed.block(allowance, expected)
    assert_allclose(change, expected, atol=2e-5 * np.abs(expected).max())


def test_presets_are_the_modes_that_the_spec_says():
    for elasticity, hertz, damping, away in ((PAPER, 2.9, 0.0046, False), (REALISTIC, 53.0, 0.0833, True)):
        pole = elasticity.transfer.poles[0]
        assert abs(pole) / (2 * np.pi) == pytest.approx(hertz, rel=5e-3)
        assert -pole.real / abs(pole) == pytest.approx(damping, rel=0.01)
        assert elasticity.away is away


def test_compliance_follows_the_height():
    part = Workpiece(heights=np.array([0.0, 0.1, 0.2]), compliances=np.array([1e-7, 5e-7, 1e-7]))
    elasticity = Elasticity(1.0, 0.0, 0.0, away=True)  # its shape alone counts
    height = np.array([-1.0, 0.0, 0.05, 0.1, 0.175, 0.3])
    out = cut(make(elasticity=elasticity, part=part), 6, height=height)
    assert_allclose(out["deflection"] / out["force"], [1e-7, 1e-7, 3e-7, 5e-7, 2e-7, 1e-7])


# --- process damping


def test_flank_presses_by_the_speed_of_the_edge_and_the_square_of_its_land():
    """F = K·ap - Ksp·B·(W + VB)²/2·(dy/dt)/v where there is a chip, and nothing in a keyway."""
    flank = Flank(pressure=4e13, width=0.3e-3, land=0.1e-3)
    process = make(flank=flank, wear=Wear(0.1e-3), part=Workpiece(radius=0.04, gaps=[(3.0, 1.0)]))
    time = STEP * np.arange(8000)
    away = 50e-6 * np.sin(2 * SPEED * time)
    out = cut(process, 8000, displacement=away)
    speed = np.diff(away, prepend=0.0) / STEP
    damping = 4e13 * 0.3e-3 * 0.2e-3**2 / (2 * SPEED * 0.04)
    there = (SPEED * time) % (2 * np.pi) - 3.0
    gap = (there >= 0.0) & (there < 1.0)
    expected = np.where(gap, 0.0, STIFFNESS * (DEPTH - away) - damping * speed)
    assert_allclose(out["force"], expected, atol=1e-9)
    assert damping * speed.max() > 0.2  # [N]


def test_flank_pushes_a_springy_edge_back_at_once():
    """The force, the deflection that it makes and the speed of the edge are those of the same sample."""
    elasticity = Elasticity(1e-6, 0.0, 0.0, away=True)
    flank = Flank(pressure=4e13, width=0.2e-3, land=0.2e-3)
    out = cut(make(elasticity=elasticity, flank=flank), 500, displacement=20e-6 * np.sin(np.arange(500) / 30.0))
    edge = 20e-6 * np.sin(np.arange(500) / 30.0) + out["deflection"]
    pressed = 4e13 * 0.2e-3 * 0.2e-3**2 / (2 * SPEED * 0.05) * np.diff(edge) / STEP
    assert_allclose(out["deflection"], 1e-6 * out["force"], rtol=1e-12)
    assert_allclose(out["force"][1:], (STIFFNESS * (DEPTH - edge))[1:] - pressed, rtol=1e-9)


# --- remembered surface


@pytest.mark.parametrize("grid", [4096, 1000])
@pytest.mark.parametrize("overlap", [0.4, 1.0])
def test_chip_meets_the_surface_of_the_last_revolution_at_any_speed(overlap, grid):
    """ap = depth - x(φ) + µ·x(φ - 2π) for a given path of a rigid tool, while the speed swings by 20 %."""
    law = speeds.harmonic(SPEED, np.array([0.2]), np.array([37.0]), np.zeros(1))
    samples = 20_000
    angle, rate, _ = law.at(np.arange(samples) * STEP)
    amplitude = 1e-5

    def path(at):
        return amplitude * (np.sin(3.3 * at) + np.cos(0.7 * at))

    out = cut(make(overlap=overlap, grid=grid), samples, angle=angle, speed=rate, cross_position=path(angle))
    later = angle >= 2 * np.pi
    before = np.where(later, path(angle - 2 * np.pi), 0.0)
    tolerance = amplitude * (3.3 * 2 * np.pi / grid) ** 2  # of linear interpolation, twice
    away = np.abs(angle - 2 * np.pi) > 2 * 2 * np.pi / grid
    expected = DEPTH - path(angle) + overlap * before
    assert_allclose(out["depth_of_cut"][away], expected[away], atol=tolerance)
    assert later.sum() > 10_000


def test_nothing_is_left_where_nothing_was_cut():
    """Clear of the part for two revolutions, then in: the chip is that of the blank."""
    samples = 12_000
    angle = 8 * np.pi * np.arange(samples) / samples
    cross = np.where(angle < 4 * np.pi, 2 * DEPTH, 0.5 * DEPTH)
    chip = cut(make(overlap=1.0), samples, angle=angle, cross_position=cross)["depth_of_cut"]
    assert np.all(chip[angle < 4 * np.pi] == 0.0)
    third = (angle >= 4 * np.pi) & (angle < 6 * np.pi - 0.01)
    assert_allclose(chip[third], 0.5 * DEPTH)
    assert_allclose(chip[angle > 6 * np.pi + 0.01], DEPTH)


# --- blocks


@given(cuts, st.sampled_from([0.0, 0.075]), st.sampled_from([PAPER, REALISTIC, RIGID]), st.sampled_from([0.0, 1.0]))
def test_cuts_change_nothing(lengths, lag, elasticity, overlap):
    samples = sum(lengths)
    random = np.random.default_rng(3)
    inputs = {
        "angle": np.cumsum(random.uniform(0.005, 0.05, samples)),
        "speed": random.uniform(80.0, 120.0, samples),
        "height": np.linspace(0.0, 0.1, samples),
        "cross_position": random.normal(scale=DEPTH, size=samples),
        "feed_velocity": random.normal(1e-3, 1e-3, samples),
        "allowance": random.normal(scale=1e-5, size=samples),
    }
    part = Workpiece(gaps=[(1.0, 0.5)], hard_spots=[HardSpot(3.0, 1.0, 0.02, 0.05, 2.0)])
    options = {
        "lag": lag, "elasticity": elasticity, "overlap": overlap, "part": part,
        "wear": Wear(0.0, 1e-6, 1e-6), "material": SpecificForce(wear_factor=1e3),
    }  # fmt: skip
    assert same(cut(make(**options), samples, lengths, **inputs), cut(make(**options), samples, **inputs))


# --- refusals


@refusals(
    (lambda: make(material=SpecificForce(kc1=0.0)), "kc1=0.0, .*allowed: kc1 above 0"),
    (lambda: make(material=SpecificForce(mc=1.0)), "mc=1.0, .*mc below 1"),
    (lambda: make(material=SpecificForce(wear_factor=-1.0)), "cutting: wear_factor -1; allowed: 0 or more"),
    (lambda: make(elasticity=Elasticity(-1e-7, 0.0, 0.0, away=True)), "compliance -1e-07; allowed: 0 or more"),
    (lambda: make(elasticity=Elasticity(1e-7, 1e-5, 0.0, away=True)), "damping 0 of the edge with inertia"),
    (lambda: make(wear=Wear(per_second=-1.0)), "cutting: per_second -1; allowed: 0 or more"),
    (lambda: Workpiece(radius=0.0), "part: radius 0 m"),
    (lambda: Workpiece(gaps=[(0.0, 7.0)]), "keyway: window at 0 rad of 7 rad; allowed: a width"),
    (lambda: Workpiece(heights=np.zeros(1)), "heights without compliances"),
    (lambda: Workpiece(heights=np.zeros(2), compliances=np.zeros(2)), "heights have to rise"),
    (lambda: Workpiece(heights=np.zeros(2), compliances=np.zeros(1)), "2 heights and 1 compliances"),
    (lambda: HardSpot(0.0, 1.0, 0.1, 0.1, 2.0), "hard spot from 0.1 to 0.1 m"),
    (lambda: HardSpot(0.0, 1.0, 0.0, 0.1, -2.0), "hard spot: factor -2"),
    (lambda: make(lag=1e-9), "cutting: lag 1e-09 s at a step of 1.5625e-05 s; allowed: 0 or at least 1.5625e-08"),
    (lambda: make(overlap=1.1), "cutting: overlap 1.1; allowed: 0"),
    (lambda: make(grid=8), "cutting: 8 grid points"),
    (lambda: make(flank=Flank(pressure=-1.0)), "cutting: pressure -1; allowed: 0 or more"),
)
def test_what_cannot_be_is_refused(make, message):
    assert_refused(make, message)


@pytest.mark.parametrize(
    ("options", "inputs", "message"),
    [
        ({}, {"speed": [10.0, 0.0, 10.0]}, "the spindle's speed is 0 rad/s in the cut; allowed: above 0"),
        ({"overlap": 1.0}, {"angle": [1.0, 0.5, 2.0]}, "the spindle turns back or jumps to 0.5 rad"),
        ({"overlap": 1.0}, {"angle": [1.0, 1.5, 9.0]}, "the spindle turns back or jumps to 9 rad"),
        ({"elasticity": Elasticity(5e-6, 0.0, 0.0, away=False)}, {}, "the force draws the edge into the part"),
    ],
)
def test_runs_that_cannot_go_on_end(options, inputs, message):
    with pytest.raises(LatheError, match=message):
        cut(make(**options), 3, **inputs)
