# SPDX-License-Identifier: Apache-2.0
"""Predistortion: the equation of the cut, the path that cancels, learning from part to part, files, blocks, the cut."""

from pathlib import Path

import numpy as np
import pytest
from cells import cuts, in_blocks
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lathe_machine.analysis.shaft import Shaft
from lathe_machine.control.predistortion import Predistortion, cancelling, contraction, proportional, turned
from lathe_machine.plants.cutting import CuttingProcess
from lathe_machine.plants.cutting_force import STEEL, Elasticity
from lathe_machine.plants.workpiece import Workpiece
from lathe_rc.errors import InputError

STIFFNESS = 233.3e3  # [N/m]
DEPTH = 150.0 / STIFFNESS  # [m]
SHAFT = Shaft(0.6, 0.034, head=2e7, tail=1e7, carriage=5e7)
HEIGHTS = np.linspace(0.0, 0.6, 61)
COMPLIANCE = SHAFT.compliance(HEIGHTS)
STRAIGHT = Predistortion(HEIGHTS, np.zeros(61))

compliances = st.lists(st.floats(0.0, 1e-4), min_size=1, max_size=20).map(np.array)


def power(exponent, factor):
    """A force that is no straight line of the depth of cut."""
    return lambda depth: factor * np.maximum(depth, 0.0) ** exponent


# --- the equation


@given(compliances, st.floats(0.3, 1.5), st.floats(0.0, 2e-3))
def test_radius_solves_the_equation_for_any_law(compliance, exponent, depth):
    law, path = power(exponent, 150 / 1e-3**exponent), np.linspace(-1e-4, 1e-3, compliance.size)
    radius = turned(compliance, law, depth, path)
    assert np.all(radius >= path)
    error = np.abs(radius - path - compliance * law(depth - radius))
    # a unit in the last place of the radius changes the force by this much
    slope = np.abs(law(depth - radius + 1e-18) - law(depth - radius - 1e-18))
    assert np.all(error <= 1e-16 + 2 * compliance * slope)


@given(compliances, st.sampled_from([0.8, 1.0, 1.2]), st.floats(-2e-4, 2e-4))
def test_path_cancels_the_deflection(compliance, exponent, wanted):
    law = power(exponent, 150 / 1e-3**exponent)
    depth = DEPTH + 1e-5 * np.sin(np.arange(compliance.size))
    target = wanted * np.cos(np.arange(compliance.size))
    path = cancelling(compliance, law, depth, target)
    assert_allclose(turned(compliance, law, depth, path), target, atol=1e-15)
    assert np.all(path <= target)


def test_taking_off_the_deflection_once_falls_short():
    """It leaves (CK/(1 + CK))² of the depth, and none of it is left by the solved path."""
    law, straight = proportional(STIFFNESS), np.zeros(61)
    seen = turned(COMPLIANCE, law, DEPTH, straight)
    share = COMPLIANCE * STIFFNESS / (1 + COMPLIANCE * STIFFNESS)
    assert_allclose(seen, share * DEPTH)
    assert_allclose(turned(COMPLIANCE, law, DEPTH, -seen), share**2 * DEPTH)
    assert np.abs(turned(COMPLIANCE, law, DEPTH, cancelling(COMPLIANCE, law, DEPTH))).max() < 1e-16


# --- from part to part


@given(compliances, st.floats(1e4, 1e6), st.floats(0.05, 1.95), st.floats(0.3, 3.0), st.integers(0, 1000))
def test_learning_converges_at_the_rate_of_the_formula(compliance, stiffness, gain, guess, seed):
    """From the path of a wrong model, ``guess`` times as soft; the error shrinks by 1 - γ/(1 + CK) a part."""
    heights, wanted = np.arange(compliance.size) * 0.01, np.random.default_rng(seed).normal(0, 1e-5, compliance.size)
    law = proportional(stiffness)
    path = Predistortion(heights, cancelling(guess * compliance, law, DEPTH, wanted))
    factor = 1 - gain / (1 + compliance * stiffness)
    error = turned(compliance, law, DEPTH, path.offsets) - wanted
    assert contraction(compliance, stiffness, gain) == pytest.approx(np.abs(factor).max())
    assert contraction(compliance, stiffness, gain) < 1.0
    for _ in range(4):
        path = path.corrected(heights, error, gain)
        before, error = error, turned(compliance, law, DEPTH, path.offsets) - wanted
        cutting = (before + wanted < DEPTH) & (error + wanted < DEPTH)
        assert_allclose(error[cutting], (factor * before)[cutting], rtol=1e-6, atol=1e-15)


@given(st.floats(0.7, 1.3), st.floats(0.3, 1.7))
@settings(max_examples=10)
def test_learning_converges_for_other_laws(exponent, gain):
    law, heights, compliance = power(exponent, 150 / DEPTH**exponent), HEIGHTS[::10], COMPLIANCE[::10]
    path = Predistortion(heights, np.zeros(heights.size))
    for _ in range(80):
        path = path.corrected(heights, turned(compliance, law, DEPTH, path.offsets), gain)
    assert_allclose(path.offsets, cancelling(compliance, law, DEPTH), atol=1e-12)


def test_gain_below_one_averages_the_noise_of_the_measurement():
    """Independent noise of each part leaves γ/(2 - γ) of its variance, C being nearly 0."""
    random, law = np.random.default_rng(2), proportional(STIFFNESS)
    heights, errors = np.arange(500) * 1e-3, []
    path = Predistortion(heights, np.zeros(500))
    for _ in range(60):
        measured = turned(np.zeros(500), law, DEPTH, path.offsets) + random.normal(0, 1e-6, 500)
        path = path.corrected(heights, measured, 0.3)
        errors.append(path.offsets)
    assert np.std(errors[30:]) == pytest.approx(1e-6 * np.sqrt(0.3 / 1.7), rel=0.05)


def test_measured_heights_need_not_be_those_of_the_path():
    path = Predistortion(np.array([0.0, 0.1, 0.2, 0.3]), np.zeros(4))
    learned = path.corrected(np.array([0.05, 0.25]), np.array([1e-6, 3e-6]))
    assert_allclose(learned.offsets, [-1e-6, -1.5e-6, -2.5e-6, -3e-6])
    assert np.array_equal(path.offsets, np.zeros(4))


# --- in the cut


def test_cutting_process_turns_the_shaft_straight():
    """Along the whole shaft, slowly, against the compliance table of the process itself."""
    step, samples = 1e-3, 60_000
    speed = np.full(samples, 100.0)
    height = np.linspace(0.0, 0.6, samples)
    feed = STEEL.feed_for(STIFFNESS)
    part = Workpiece(heights=HEIGHTS, compliances=COMPLIANCE)
    elasticity = Elasticity(1.0, 0.003**2, 0.0005, away=True)
    errors = []
    for offsets in (np.zeros(61), cancelling(COMPLIANCE, proportional(STIFFNESS), DEPTH)):
        process = CuttingProcess(depth=DEPTH, lag=0.0, elasticity=elasticity, part=part, step=step)
        set_point, still = np.empty(samples), np.zeros(samples)
        Predistortion(HEIGHTS, offsets).block(height, set_point)
        out = {key: np.empty(samples) for key in ("force", "deflection", "depth_of_cut", "feed", "wear")}
        process.block(
            angle=0.1 * np.arange(samples), speed=speed, height=height, cross_position=set_point, displacement=still,
            feed_velocity=feed * speed / (2 * np.pi), allowance=still, **out,
        )  # fmt: skip
        errors.append(np.abs(set_point + out["deflection"])[500:].max())  # once the mode has settled
    share = COMPLIANCE.max() * STIFFNESS
    assert errors[0] == pytest.approx(DEPTH * share / (1 + share), rel=1e-3)
    assert errors[1] < 1e-3 * errors[0]


# --- set points


def block(path, height, lengths=None):
    set_point = np.full(height.size, np.nan)
    in_blocks(lengths or [height.size], lambda _, *parts: path.block(*parts), height, set_point)
    return set_point


def test_set_point_is_linear_between_heights_and_counted_beyond():
    path = Predistortion(np.array([0.1, 0.2, 0.4]), np.array([-1e-6, -3e-6, 1e-6]))
    values = block(path, np.array([0.0, 0.1, 0.15, 0.3, 0.4, 0.5]))
    assert_allclose(values, [-1e-6, -1e-6, -2e-6, -1e-6, 1e-6, 1e-6])
    assert path.beyond == 2


@given(cuts)
def test_cuts_change_nothing(lengths):
    height = np.linspace(-0.01, 0.61, sum(lengths))
    one, other = (Predistortion(HEIGHTS, np.random.default_rng(4).normal(size=61)) for _ in range(2))
    assert np.array_equal(block(one, height, lengths), block(other, height))
    assert one.beyond == other.beyond


# --- files


@settings(max_examples=20)
@given(st.lists(st.floats(-1e-3, 1e-3), min_size=1, max_size=20))
def test_file_comes_back(tmp_path_factory, offsets):
    file = tmp_path_factory.mktemp("path") / "path.csv"
    path = Predistortion(np.arange(len(offsets)) / 7, np.array(offsets))
    path.save(file, comment="shaft\n7")
    assert file.read_text(encoding="utf-8").splitlines()[:2] == ["# shaft 7", "height_mm,offset_um"]
    again = Predistortion.load(file)
    assert_allclose(again.heights, path.heights, rtol=1e-14)
    assert_allclose(again.offsets, path.offsets, rtol=1e-14)
    assert [entry.name for entry in file.parent.iterdir()] == ["path.csv"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("height_mm,offset\n0,0\n", r"path.csv: column 'offset' has no unit; allowed for offset: m, mm, um"),
        ("height_mm,offset_um\n1,0\n0,0\n", r"path.csv: predistortion: height 0.001 m is followed by 0 m; allowed"),
    ],
)
def test_bad_file_is_refused(tmp_path, text, message):
    file = tmp_path / "path.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        Predistortion.load(file)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Predistortion(np.zeros(2), np.zeros(1)), "2 heights and 1 offsets; give as many of each"),
        (lambda: Predistortion(np.zeros(1), np.array([np.nan])), "not all numbers are finite"),
        (lambda: STRAIGHT.corrected(HEIGHTS, np.zeros(61), 2.0), "gain 2 from part to part"),
        (lambda: STRAIGHT.corrected(HEIGHTS, np.zeros(61), 0.0), "gain 0 from part to part"),
        (lambda: STRAIGHT.save(Path("/nowhere/path.csv")), r"cannot be written .*; choose another place"),
    ],
)
def test_what_cannot_be_is_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()
