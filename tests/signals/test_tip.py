# SPDX-License-Identifier: Apache-2.0
"""A round tip on a steep form: its path, what it leaves, and where the flank would rub."""

from pathlib import Path

import numpy as np
import pytest
from machines import assert_refused, refusals
from numpy.testing import assert_allclose

from lathe_machine.signals.profile import Harmonics, Piston
from lathe_machine.signals.profile_table import ProfileTable
from lathe_machine.signals.tip_path import TipPath, steepest_fall
from lathe_rc import harness
from lathe_rc.cell import scenario

TURN = 2 * np.pi
EVEN = np.linspace(0.0, TURN, 240, endpoint=False)
RADIUS, TIP = 2e-3, 0.4e-3
OVAL = Harmonics(np.array([2.0, 3.0]), np.array([225e-6, 60e-6]), np.array([0.0, 1.0]))


class Eccentric:
    """A true circle beside the axis."""

    heights = np.zeros(1)
    offset = 0.3e-3

    def deviation(self, angle, height):
        return self.offset * np.cos(angle) + np.sqrt(RADIUS**2 - (self.offset * np.sin(angle)) ** 2) - RADIUS


def test_path_around_a_circle_beside_the_axis_is_a_larger_circle():
    """e·cos φ + √((R + ρ)² - e²·sin²φ), in closed form."""
    e = Eccentric.offset
    expected = e * np.cos(EVEN) + np.sqrt((RADIUS + TIP) ** 2 - (e * np.sin(EVEN)) ** 2) - RADIUS - TIP
    assert_allclose(TipPath(Eccentric(), RADIUS, TIP).deviation(EVEN, 0.0), expected, atol=1e-12)


def left_by(path, tip):
    """Radius that a tip leaves at even angles: the deepest of all circles around its centres, cut by each ray."""
    at = np.linspace(0.0, TURN, 6001)
    centre = RADIUS + tip + path(at)
    away = (at[None, :] - EVEN[:, None] + np.pi) % TURN - np.pi
    beside, along = centre * np.sin(away), centre * np.cos(away)
    reach = tip**2 - beside**2
    depth = np.where((reach > 0.0) & (along > 0.0), along - np.sqrt(np.maximum(reach, 0.0)), np.inf)
    return depth.min(axis=1)


def test_corrected_path_leaves_the_form_and_the_form_itself_leaves_the_known_error():
    form = RADIUS + OVAL.deviation(EVEN, 0.0)
    corrected = TipPath(OVAL, RADIUS, TIP)
    assert_allclose(left_by(lambda at: corrected.deviation(at, 0.0), TIP), form, atol=2e-9)
    slope = (450e-6 * np.cos(2 * EVEN) + 180e-6 * np.cos(3 * EVEN + 1.0)) / form
    small = TIP / 8  # against the form's radius of curvature
    known = small * (np.sqrt(1.0 + slope**2) - 1.0)  # ρ·(1/cos β - 1)
    cut = form - left_by(lambda at: OVAL.deviation(at, 0.0), small)
    assert known.max() > 2e-6
    assert_allclose(cut, known, atol=0.04 * known.max())


STEEP = [
    "spindle_encoder.revolutions=8.0", "spindle_encoder.deviation_amplitude=[]",
    "spindle_encoder.deviation_frequency=[]", "tool.profile=harmonics", f"tool.part_radius={RADIUS}",
]  # fmt: skip


def turn(*changes):
    return harness.run(scenario.load(Path(__file__).parents[2] / "config" / "piston.yaml", [*STEEP, *changes]))


def test_cell_turns_the_form_with_the_corrected_path_and_leaves_the_known_error_without():
    plain, corrected, uncorrected = (
        turn(*how).part.profile[-1]
        for how in ([], [f"tool.tip_radius={TIP}"], [f"tool.tip_radius={TIP}", "tool.tip_correction=false"])
    )
    angle = np.arange(plain.size) * TURN / plain.size
    form = Harmonics(np.array([2.0]), np.array([225e-6]), np.zeros(1))
    missing = form.deviation(angle, 0.0) - TipPath(form, RADIUS, TIP).deviation(angle, 0.0)
    assert missing.min() < -8e-6
    assert_allclose(uncorrected, plain + missing, atol=0.1e-6)
    assert np.abs(corrected).max() < np.abs(plain).max() + 0.2e-6


def test_flank_rubs_where_the_form_falls_more_than_the_clearance():
    table = ProfileTable(Harmonics(np.array([2.0]), np.array([225e-6]), np.zeros(1)))
    fall = steepest_fall(table, RADIUS, 0.0)
    found = np.linspace(0.0, TURN, 100_001)
    slopes = -450e-6 * np.cos(2 * found) / (RADIUS + 225e-6 * np.sin(2 * found))
    assert fall.slope == pytest.approx(slopes.max(), rel=1e-5)
    turn(f"tool.clearance={fall.clearance + 1e-4}", "spindle_encoder.revolutions=1.0")
    assert_refused(
        lambda: turn(f"tool.clearance={fall.clearance - 1e-4}"), r"tool\.clearance = .* rad: the tool's flank would rub"
    )


def test_feed_along_a_taper_counts_in_the_fall():
    barrel = ProfileTable(Piston(0.0, 0.0, 30e-6, 0.06, 0.0))
    assert steepest_fall(barrel, 0.05, 0.0).slope == pytest.approx(0.0, abs=1e-12)
    assert steepest_fall(barrel, 0.05, 0.1e-3).slope == pytest.approx(
        30e-6 * (1 - (63 / 64) ** 2) / (0.06 / 64) * 0.1e-3 / TURN / 0.05, rel=1e-3
    )


LOBES = Harmonics(np.array([8.0]), np.array([225e-6]), np.zeros(1))
LOBED = ["tool.harmonic_order=[8]", "tool.harmonic_amplitude=[225.0e-6]"]


@refusals(
    (lambda: TipPath(OVAL, 0.0, TIP), "tip of 0.0004 m on a part of 0 m radius; allowed"),
    (lambda: TipPath(LOBES, RADIUS, TIP).deviation(EVEN, 0.0), "hollow with a radius of .* m does not get in; allowed"),
    (lambda: turn(*LOBED, f"tool.tip_radius={TIP}"), "tool.tip_radius: the form is hollow with a radius of"),
)
def test_what_cannot_be_is_refused(make, message):
    assert_refused(make, message)
