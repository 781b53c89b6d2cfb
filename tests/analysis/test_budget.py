# SPDX-License-Identifier: Apache-2.0
"""The parts of a form error add up, each is what it says, and interactions of causes are not hidden."""

import json
import re

import numpy as np
import pytest
from cells import scenario
from click.testing import CliRunner
from numpy.testing import assert_allclose

import lathe_rc
from lathe_rc import harness
from lathe_rc.analysis.budget import Decomposition
from lathe_rc.analysis.tolerance import LAST
from lathe_rc.cell.wiring import Cell
from lathe_rc.cli import main
from lathe_rc.judge import budget as budgets

PRODUCTS = ["direct_compensation", "lead_lag", "series", "supervised_two_channel", "two_channel", "two_coarse"]
ANGLE = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)[None]
WAVES = {"a": 3.0 * np.sin(ANGLE), "b": 2.0 * np.sin(2 * ANGLE), "c": np.sin(3 * ANGLE)}


def decomposed(needs, signal):
    """The budget of what ``signal`` makes of the causes that act."""
    made = Decomposition(needs)
    return made.split({acting: signal(acting) for acting in made.alone() | made.together()}, {})


def shares(found):
    return {part.name: part.share for part in (*found.causes, *found.pairs, found.rest, found.interactions)}


# --- the arithmetic


def test_what_adds_up_has_its_power_and_no_interactions():
    found = decomposed(
        dict.fromkeys("abc", ""), lambda acting: sum((WAVES[cause] for cause in acting), 0.1 + 0 * ANGLE)
    )
    power = 4.5 + 2.0 + 0.5 + 0.01
    expected = {"a": 4.5, "b": 2.0, "c": 0.5, "rest": 0.01, "interactions": 0.0}
    told = shares(found)
    assert_allclose([told[name] for name in expected], [value / power for value in expected.values()], atol=1e-12)
    assert_allclose([part.rms for part in found.causes], np.sqrt([4.5, 2.0, 0.5]))
    assert found.explained == pytest.approx(1.0)


def test_what_two_causes_do_only_together_is_named_by_both():
    found = decomposed(
        dict.fromkeys("abc", ""),
        lambda acting: sum((WAVES[cause] for cause in acting), 0.1 + np.cos(7 * ANGLE) * ({"a", "c"} <= acting)),
    )
    told = shares(found)
    assert told["interactions"] == pytest.approx(told["a with c"]) == pytest.approx(0.5 / 7.51)
    assert told["a with b"] == pytest.approx(0.0, abs=1e-12)
    assert [part.name for part in found.rows] == ["a", "b", "c", "rest", "interactions", "a with c"]
    assert found.explained == pytest.approx(1.0)


def test_what_three_causes_do_only_together_is_not_explained():
    found = decomposed(
        dict.fromkeys("abc", ""), lambda acting: WAVES["a"] * ("a" in acting) + np.cos(7 * ANGLE) * (len(acting) == 3)
    )
    assert 1.0 - found.explained == pytest.approx(found.interactions.share) == pytest.approx(0.5 / 5.0)


def test_a_cause_that_needs_another_is_seen_on_top_of_it():
    """And what acts with both of them belongs to the one that makes the difference."""
    found = decomposed(
        {"a": "", "b": "a", "c": ""},
        lambda acting: (
            sum((WAVES[cause] for cause in acting), 0 * ANGLE)
            + np.cos(7 * ANGLE) * ({"a", "c"} <= acting)
            + np.cos(8 * ANGLE) * ({"a", "b", "c"} == acting)
        ),
    )
    told = shares(found)
    assert "a with b" not in told
    assert_allclose([told[name] for name in ("a", "b", "c", "a with c", "b with c")], np.array([9, 4, 1, 1, 1]) / 16)
    assert found.explained == pytest.approx(1.0)


def test_a_part_that_makes_the_error_smaller_counts_against_it():
    found = decomposed({"a": "", "b": ""}, lambda acting: 3.0 * ("a" in acting) - ("b" in acting) + 0 * ANGLE)
    assert (found.causes[0].share, found.causes[1].share) == (1.5, -0.5)


# --- runs

SENSORS = ("spindle_encoder.counts_per_revolution=100000", "electrodynamic_actuator.noise_rms=20e-9")
SWING = {"deviation_amplitude": [0.1], "deviation_frequency": [10.7]}
COARSE = ("spindle_encoder.counts_per_revolution=5000", "learning_controller.lead_law=constant_angle")
ADDING = [
    *((name, 60) for name in ("adaptive_inverse", "exact_invariance", "speed_deviation")),
    *((name, 25) for name in ("one_channel", "piston", "supervised", "vibration")),
    *((name, 25, *SENSORS) for name in ("piston", "vibration")),
    ("one_channel", 25, *COARSE),
]  #: scenarios, revolutions and overrides: what causes do adds up


def budget(name, revolutions, *overrides):
    return lathe_rc.budget(lathe_rc.load(name, [f"spindle_encoder.revolutions={revolutions}", *overrides]))


@pytest.mark.parametrize("given", ADDING, ids=lambda given: f"{given[0]}{len(given) - 2 or ''}")
def test_causes_explain_the_form_error_of_ten_scenarios_within_a_tenth(given):
    found = budget(*given)
    assert sum(part.share for part in (*found.causes, found.rest)) == pytest.approx(1.0, abs=0.1)
    assert found.rest.share < 0.02
    assert found.left_out == {}


@pytest.mark.parametrize("name", ["full_cell", *PRODUCTS])
def test_where_causes_multiply_pairs_of_them_explain_it(name):
    """Of channels that follow one another each takes off what the other leaves; the force follows the speed."""
    found = budget(name, 12 if name == "full_cell" else 25)
    assert found.explained == pytest.approx(1.0, abs=0.1)
    assert sum(part.share for part in (*found.causes, found.rest, found.interactions)) == pytest.approx(1.0)


def test_force_and_load_are_causes_where_drive_and_spindle_feel_them():
    """The force alone is learned, and so is the speed; what they do together is not."""
    found = budget("loaded_cutting", 25, "loaded_drive.coarse_slew_rate=1e5")
    assert {"speed", "force", "load", "limits"} < {part.name for part in found.causes}
    assert found.explained == pytest.approx(1.0, abs=0.1)
    assert "speed with force" in [pair.name for pair in found.pairs if pair.share > 0.01]
    assert list(found.left_out) == ["lead"]  # nobody knows the speed in advance


def test_it_speaks_of_the_form_error_of_the_last_revolutions():
    cell = scenario(spindle_encoder={"revolutions": 15.0, **SWING})
    errors, found = harness.run(cell).errors, lathe_rc.budget(cell)
    assert found.revolutions == LAST
    assert found.rms == pytest.approx(np.sqrt(np.mean(errors.rms[-LAST:] ** 2)), rel=1e-4)
    assert found.largest == pytest.approx(errors.largest[-LAST:].max(), rel=1e-3)


def test_the_part_of_q_is_the_steady_error_of_the_formula():
    """(1 - Q)/(γZ + 1 - Q) of each harmonic, which knows nothing of runs; see docs/learning.md."""
    orders, amplitude = [2, 5, 10], 10e-6
    form = {"harmonic_order": orders, "harmonic_amplitude": [amplitude] * 3}
    cell = scenario(spindle_encoder={"revolutions": 60.0}, tool=form, learning_controller={"q_time": 150e-6})
    wired = Cell(cell.nodes)
    stage = wired.stages["learning_controller"]
    ((drive, _),) = stage.learned(wired.stages.values())
    left = stage.loop(drive).steady_error(np.array(orders, dtype=float), cell.shared.nominal_speed)
    (q_floor,) = lathe_rc.budget(cell).causes
    assert q_floor.name == "Q floor"
    assert q_floor.rms == pytest.approx(amplitude * np.sqrt(np.sum(np.abs(left) ** 2) / 2), rel=1e-3)


def test_the_part_of_the_lead_is_the_slope_times_the_angle_that_it_misses():
    """A constant lead angle misses φ(t+T0) - φ(t) - T0·Ω0 of the oval a·sin 2φ, at a frozen memory."""
    lead_time, oval, frequency = 2e-3, 225e-6, 10.7
    law = {"lead_law": "constant_angle", "lead_time": lead_time, "q_time": 130e-6}
    given = {**law, "events": ["revolution 15: freeze"]}
    swing = {"deviation_amplitude": [0.05], "deviation_frequency": [frequency], "deviation_start": 15 * 0.06}
    cell = scenario(spindle_encoder={"revolutions": 40.0, **swing}, learning_controller=given)
    parts = {part.name: part.rms for part in lathe_rc.budget(cell).causes}
    missed = 0.05 * cell.shared.nominal_speed * lead_time / np.sqrt(2)
    assert parts["lead"] == pytest.approx(2 * oval / np.sqrt(2) * missed, rel=0.1)


def test_what_is_switched_off_is_what_the_cause_says():
    """Each by the parameters that make it; what the scenario has not is no cause."""
    cell = scenario(
        spindle_encoder={"counts_per_revolution": 20_000, **SWING},
        electrodynamic_actuator={"noise_rms": 1e-8, "resolution": 1e-8, "command_velocity": 0.5},
        learning_controller={"correction": "second_order_inverse", "lead_time": 0.4e-3, "model_damping": 0.7},
        tool={"feed": 1e-4},
        vibration={"line_amplitude": [1e-6], "line_frequency": [300.0]},
    )
    found, left_out = budgets.causes(cell, np.array([1.0e-3, 1.2e-3]))
    off = {name: dict(cause.off) for name, cause in found.items()}
    assert left_out == {}
    assert off.pop("Q floor")["learning_controller.q_filter"] == "fir"
    assert off.pop("lead") == {
        "learning_controller.lead_law": "exact_preview",
        "learning_controller.deviation_amplitude": [0.1],
        "learning_controller.deviation_frequency": [10.7],
    }
    assert off == {
        "model": {"learning_controller.model_damping": 0.804},
        "speed": {"spindle_encoder.deviation_amplitude": [], "spindle_encoder.deviation_frequency": []},
        "feed": {"tool.feed": 0.0, "tool.start_height": pytest.approx(1.1e-3)},
        "vibration": {"vibration.random_rms": 0.0, "vibration.line_amplitude": [], "vibration.line_frequency": []},
        "noise": {"electrodynamic_actuator.noise_rms": 0.0},
        "quantisation": {"spindle_encoder.counts_per_revolution": 0, "electrodynamic_actuator.resolution": 0.0},
        "limits": {"electrodynamic_actuator.command_velocity": 0.0},
    }


def test_a_q_that_cannot_be_flat_is_left_out_and_said_to_be():
    unstable = {"lead_time": 4e-3, "learning_gain": 1.9, "q_time": 800e-6, "allow_unstable": True}
    found = lathe_rc.budget(scenario(spindle_encoder={"revolutions": 12.0}, learning_controller=unstable))
    assert found.left_out == {"Q floor": "learning_controller converges with no flat Q"}
    assert found.causes == []
    assert found.rest.share == pytest.approx(1.0)
    assert re.fullmatch(r"form error diverges from revolution \d+ on: .*; the shares are of what .*", found.warning)


def test_the_command_and_a_run_tell_the_same():
    length = ("piston", "--revolutions", "12")
    told = json.loads(CliRunner().invoke(main, ["budget", *length, "--json"]).stdout)
    assert told.pop("scenario") == "piston"
    assert told == budget("piston", 12.0).summary()
    assert json.loads(CliRunner().invoke(main, ["run", *length, "--budget", "--json"]).stdout)["budget"] == told
    table = CliRunner().invoke(main, ["budget", *length]).stdout
    for name in (*(part["cause"] for part in told["causes"]), "rest", "interactions", "form error, 10 revolutions"):
        assert name in table
