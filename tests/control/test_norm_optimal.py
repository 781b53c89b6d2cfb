# SPDX-License-Identifier: Apache-2.0
"""The norm-optimal law: its quadratic program, its limits on the command, and its factors."""

import numpy as np
import pytest
from cells import config

import lathe_rc
from lathe_machine.control.norm_optimal import nearest, waves
from lathe_rc.cell.parameters import SharedParameters
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.wiring import Cell

QUIET = ["nominal_rpm=3000.0", "spindle_encoder.deviation_amplitude=[]", "spindle_encoder.deviation_frequency=[]"]
QUIET += ["spindle_encoder.deviation_phase=[]", "tool.profile=harmonics", "tool.harmonic_order=[2,6]"]
QUIET += ["tool.harmonic_amplitude=[100e-6,10e-6]", "learning_controller.feedback_delay=64", "block_size=64"]
ACCELERATION = 200e-6 * (2 * 100 * np.pi) ** 2  # [m/s²] of the second harmonic alone, twice


def law(*settings, **changes):
    """The piston's cell at 3000 rpm with the law as its controller."""
    base = config("piston", *QUIET, *settings)
    before = base.nodes["learning_controller"]
    shared = {name: getattr(before, name) for name in SharedParameters.model_fields.keys() & before.model_fields_set}
    values = {"stage": "norm_optimal_controller", "feedback_delay": 64, **shared, **changes}
    made = TABLES["norm_optimal_controller"].read("learning_controller", values)
    return base.with_node("learning_controller", made)


@pytest.mark.parametrize(("unknowns", "limits"), [(3, 8), (25, 300)])
def test_the_nearest_point_satisfies_the_conditions_of_optimality(unknowns, limits):
    """Feasible, and the gradient is a nonnegative sum of the active rows (Karush, Kuhn, Tucker)."""
    random = np.random.default_rng(unknowns)
    rows, bounds = random.normal(size=(limits, unknowns)), random.uniform(0.1, 1.0, limits)
    weights, wanted = random.uniform(0.1, 3.0, unknowns), random.normal(size=unknowns)
    scale = 1e-4  # metres
    found = nearest(scale * wanted, weights, rows / scale, bounds) / scale
    slack = bounds - rows @ found
    assert slack.min() > -1e-9
    active = slack < 1e-9
    share, *_ = np.linalg.lstsq(rows[active].T, weights * (wanted - found), rcond=None)
    np.testing.assert_allclose(rows[active].T @ share, weights * (wanted - found), atol=1e-9)
    assert 0 < active.sum() <= unknowns
    assert share.min() > -1e-9
    np.testing.assert_array_equal(nearest(wanted, weights, rows, rows @ wanted + 0.1), wanted)


def test_derivatives_of_the_waves():
    angle, step = np.array([0.3, 2.0, 5.0]), 1e-5
    for order in (0, 1):
        numeric = (waves(angle + step, 5, order) - waves(angle - step, 5, order)) / (2.0 * step)
        np.testing.assert_allclose(waves(angle, 5, order + 1), numeric, atol=1e-7)


def test_the_command_stays_within_its_limits_and_errs_least_for_them():
    """Below the acceleration of the form the rest is spread over the angle; above it nothing is lost."""
    runs = {}
    for share in (0.0, 0.5, 5.0):
        scenario = law("spindle_encoder.revolutions=15", command_acceleration=share * ACCELERATION)
        runs[share] = lathe_rc.run(scenario).errors
    assert runs[0.0].largest[-5:].max() < 0.3e-6
    np.testing.assert_allclose(runs[5.0].rms, runs[0.0].rms)
    assert runs[0.5].rms[-1] > 10.0 * runs[0.0].rms[-1]


def test_the_factor_of_an_update_is_that_of_a_run():
    """A drive less damped than its model: the error of one harmonic from update to update."""
    scenario = law(
        "electrodynamic_actuator.damping=0.6", "tool.harmonic_order=[4]", "tool.harmonic_amplitude=[50e-6]",
        "spindle_encoder.revolutions=9", change_weight=0.3, model_damping=0.804, model_natural_frequency=1038.0,
        model_delay=0.36e-3,
    )  # fmt: skip
    cell = Cell(scenario.nodes)
    stage = cell.stages["learning_controller"]
    ((response, _),) = stage.learned(cell.stages.values())
    factor = abs(stage.factors(response, np.array([4.0]), 100.0 * np.pi)[0, 0])
    errors = lathe_rc.run(scenario).errors.rms
    assert errors[5] / errors[3] == pytest.approx(factor, rel=0.05)
    assert 0.1 < factor < 0.8
