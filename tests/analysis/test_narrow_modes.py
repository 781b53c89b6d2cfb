# SPDX-License-Identifier: Apache-2.0
"""Margins with resonances that are narrower than the grids on which they are computed."""

from functools import partial

import numpy as np
import pytest
from cells import config, scenario

from lathe_machine.analysis import feedback
from lathe_rc import harness
from lathe_rc.analysis.cycle_factors import smallest_errors
from lathe_rc.analysis.resonance_grid import with_images
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError
from lathe_rc.judge.loop_curves import loop_curves

TURN = 2.0 * np.pi
LAWS = {
    "lead": {"learning_gain": 0.7},
    "observer": {"stage": "disturbance_controller", "identify": False, "observer_bandwidth": 2000.0},
    "compound": {
        "stage": "compound_controller",
        "proportional": 1.9,
        "integral": 28.0,
        "derivative": 1.4e-4,
        "derivative_bandwidth": 19e3,
    },
}


def checked(law, modes, nominal_rpm=1000.0):
    """The only loop of a cell whose drive has modes of some frequencies [Hz], dampings and participations."""
    names = ("mode_frequency", "mode_damping", "mode_participation")
    drive = dict(zip(names, (list(map(float, each)) for each in zip(*modes, strict=True)), strict=True))
    drive["mode_frequency"] = [TURN * hertz for hertz in drive["mode_frequency"]]
    controller = {"allow_unstable": True, "stop_ratio": 0.0, "feedback_delay": 16, **law}
    shared = {"block_size": 16, "nominal_rpm": nominal_rpm}
    cell = Cell(scenario(shared, learning_controller=controller, electrodynamic_actuator=drive).nodes)
    cell.check()
    return cell


def brute_force(cell, modes):
    """Stability margin, if there is one, and drive margin on a grid that resolves each mode, without any search."""
    (loop,) = cell.loops["learning_controller"]
    (speed,), (drive,) = set(loop.speeds), loop.responses
    stage, top = loop.stage, np.pi * 64_000
    if stage.factors(drive, np.ones(1), speed) is not None:
        top = stage.highest_waves(speed) * speed
    around = [TURN * hertz * (1.0 + zeta * np.sinh(np.linspace(-10.0, 10.0, 4001))) for hertz, zeta, _ in modes]
    frequency = np.unique(np.concatenate((np.linspace(0.0, top, 20_001), np.geomspace(0.1, top, 20_001), *around)))
    frequency = frequency[(frequency > 1e-3) & (frequency <= top)]
    if stage.factors(drive, np.ones(1), speed) is None:
        own, fed = stage.characteristic(drive, frequency, speed)
        turn = np.angle((own + fed)[1:] / (own + fed)[:-1]).sum()
        return None, feedback.smallest_errors(own, fed).min() if abs(turn) < 0.5 * np.pi else 0.0
    waves = frequency / speed
    margin = 1.0 - np.abs(stage.factors(drive, waves, speed)).max()
    return margin, smallest_errors(partial(stage.scaled_factors, drive, speed), waves).min()


@pytest.mark.parametrize("law", LAWS)
def test_margins_with_narrow_modes_are_those_of_brute_force(law):
    """Of 18 random drives with one to three modes of dampings down to 1e-5, within 1 %."""
    rng = np.random.default_rng(list(LAWS).index(law))
    for _ in range(6):
        count = int(rng.integers(1, 4))
        zeta = 10.0 ** rng.uniform(-5.0, -2.0, count)
        parts = rng.choice([-1.0, 1.0], count) * 2.0 * zeta * 10.0 ** rng.uniform(-2.0, 0.0, count)
        modes = list(zip(rng.uniform(200.0, 4000.0, count), zeta, parts, strict=True))
        cell = checked(LAWS[law], modes, float(rng.choice([1000.0, 3000.0])))
        stability, drive = brute_force(cell, modes)
        assert cell.drive_margins["learning_controller"].error == pytest.approx(drive, rel=0.01, abs=1e-9), modes
        if stability is not None:
            assert 1.0 - cell.factors["learning_controller"] == pytest.approx(stability, rel=0.01), modes


@pytest.mark.parametrize(("hertz", "part"), [(912.5, 1.5e-4), (912.5, 4e-4), (1222.0, 4e-4), (1245.0, 2e-4)])
def test_stability_and_drive_margin_agree_whether_a_narrow_mode_is_stable(hertz, part):
    """One is 0 where the other is not positive; their place is the mode, which the curve of the loop shows."""
    cell = checked({}, [(hertz, 5e-4, part)])
    stability, margin = 1.0 - cell.factors["learning_controller"], cell.drive_margins["learning_controller"]
    assert (stability > 0.0) == (margin.error > 0.0)
    (curve,) = loop_curves(cell)
    assert np.abs(curve.factor).max() == pytest.approx(1.0 - stability, rel=3e-3)
    assert curve.error.min() == pytest.approx(margin.error, rel=0.03, abs=1e-9)


def test_a_loop_above_1_within_a_resonance_is_refused_although_a_run_at_one_speed_is_quiet():
    """A resonance far narrower than a wave: its phase does not close over the cycle at this speed, but at others."""
    mode = [f"electrodynamic_actuator.mode_{name}" for name in ("frequency", "damping", "participation")]
    drive = [f"{name}=[{value}]" for name, value in zip(mode, (TURN * 912.5, 5e-4, 2e-4), strict=True)]
    constant = ["spindle_encoder.deviation_amplitude=[0.0]", "spindle_encoder.revolutions=120"]
    with pytest.raises(InputError, match=r"sup\|Q - Z\| = 1\.027 at 57"):
        Cell(config("piston", *drive, *constant).nodes).check()
    allowed = "learning_controller.allow_unstable=true"
    errors = harness.run(config("piston", *drive, *constant, allowed)).errors
    assert errors.largest[-1] < 1.01 * errors.largest[20]


def test_images_of_a_pole_by_sampling_are_up_to_the_highest_frequency():
    found = with_images(np.array([-1.0 + 3j]), TURN / 10.0, 28.0)
    assert sorted(found.imag) == pytest.approx([3.0, 7.0, 13.0, 17.0, 23.0, 27.0])
    assert (found.real == -1.0).all()
