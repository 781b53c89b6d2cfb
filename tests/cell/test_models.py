# SPDX-License-Identifier: Apache-2.0
"""Models of drives: given once, with the drive, unless they shall differ."""

from pathlib import Path

import pytest
from machines import line_of

from lathe_rc.cell import scenario
from lathe_rc.cell.scenario import load

CONFIG = Path(__file__).parents[2] / "config"
DRIVE = {"natural_frequency": 900.0, "damping": 0.7, "delay": 0.5e-3}


def model(of, node="learning_controller"):
    table = of.nodes[node]
    return {name: getattr(table, f"model_{name}") for name in DRIVE}


def sets(node, prefix=""):
    return [f"{node}.{prefix}{name}={value!r}" for name, value in DRIVE.items()]


@pytest.mark.parametrize(
    ("name", "drive", "controller"),
    [
        ("piston", "electrodynamic_actuator.", "learning_controller"),
        ("two_coarse", "fine_actuator.", "fine_controller"),  # by the topic of its command, not by its kind
        ("series", "series_drive.coarse_", "learning_controller"),
        ("loaded_cutting", "loaded_drive.coarse_", "learning_controller"),
    ],
)
def test_a_drive_moves_its_model(name, drive, controller):
    changes = [f"{drive}{quantity}={value!r}" for quantity, value in DRIVE.items()]
    before, after = load(CONFIG / f"{name}.yaml"), load(CONFIG / f"{name}.yaml", changes)
    assert model(after, controller) == DRIVE
    others = before.nodes.keys() - {controller, drive.partition(".")[0]}
    same = {node: table.model_copy(update={"run_id": ""}) for node, table in after.nodes.items() if node in others}
    assert same == {node: before.nodes[node].model_copy(update={"run_id": ""}) for node in others}


def test_a_piezo_drive_has_no_delay(tmp_path):
    lines = (CONFIG / "two_channel.yaml").read_text().replace("profiles/", f"{CONFIG}/profiles/").splitlines()
    path = tmp_path / "cell.yaml"
    path.write_text("\n".join(line for line in lines if "model_" not in line))
    assert load(path) == load(path, ["fine_controller.model_delay=0.0"])
    found = load(path, ["piezo_actuator.damping=0.1"])
    assert model(found, "fine_controller") == {"natural_frequency": 14600.0, "damping": 0.1, "delay": 0.0}


def test_what_is_given_of_a_model_stays():
    """To give one of its numbers is an error of the model that is wanted; the others are the drive's still."""
    wanted = "learning_controller.model_natural_frequency=1038.0"
    found = load(CONFIG / "piston.yaml", [*sets("electrodynamic_actuator"), wanted])
    assert model(found) == {**DRIVE, "natural_frequency": 1038.0}


def test_values_that_are_varied_move_the_model_as_in_the_file():
    piston, changed = load(CONFIG / "piston.yaml"), {"electrodynamic_actuator.natural_frequency": 900.0}
    varied = piston.varied(changed)
    assert model(varied)["natural_frequency"] == 900.0
    assert varied == load(CONFIG / "piston.yaml", sets("electrodynamic_actuator")[:1])
    assert varied.varied({"electrodynamic_actuator.natural_frequency": 1038.0}) == piston
    kept = piston.varied({"learning_controller.model_natural_frequency": 1038.0})
    assert model(kept.varied(changed)) == model(piston)


def test_the_written_file_holds_the_numbers(tmp_path):
    """Nodes and bags get it: what the drive is changed to afterwards does not change the model any more."""
    path = tmp_path / "whole.yaml"
    path.write_text(load(CONFIG / "piston.yaml", sets("electrodynamic_actuator")).to_yaml())
    assert model(load(path, ["electrodynamic_actuator.natural_frequency=1500.0"])) == DRIVE


def test_a_model_that_two_drives_cannot_both_have_is_to_be_given(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text(
        (CONFIG / "piston.yaml").read_text().replace("profiles/", f"{CONFIG}/profiles/")
        + "/second: {ros__parameters: {stage: electrodynamic_actuator, natural_frequency: 900.0}}"
    )
    refused = line_of(lambda: load(path))
    assert refused == (
        "learning_controller.model_natural_frequency is not given, and the drives that learning_controller commands "
        "differ: electrodynamic_actuator has 1038.0, second 900.0; allowed: to give it"
    )


def test_a_slide_moves_the_link_and_the_decoupler():
    """The link of paper 003 has its gain and lag; the decoupler its transfer function, both halves or neither."""
    slide = ["feed_drive.sampled_gain=5.0", "feed_drive.sampled_lag=0.1"]
    link = load(CONFIG / "approach.yaml", slide).nodes["position_controller"]
    assert (link.link_gain, link.link_lag) == (5.0, 0.1)
    cell = CONFIG / "full_cell.yaml"
    found = load(cell, ["cross.velocity_gain=5.0e-3"]).nodes["decoupler"]
    assert (found.w2_numerator, found.w2_denominator) == ([5.0e-3], [0.045, 1.0, 0.0])
    half = load(cell, ["decoupler.w2_numerator=[4.38e-3]"]).nodes["decoupler"]
    assert half.w2_denominator == []


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.yaml")), ids=lambda path: path.stem)
def test_no_scenario_of_ours_is_another_by_that(path):
    """All that they leave out has been the drives' anyway; W2 of the decoupler is the one of its preset.

    Form and encoder, which some laws ask for, have no default that could be a cell's.
    """
    whole, resolved = scenario.load(path, complete=True), load(path)
    for node, table in resolved.nodes.items():
        same = table.model_copy(update={"run_id": whole.nodes[node].run_id})
        if resolved.kind(node) == "decoupler":
            same = same.model_copy(update={"w2_numerator": [], "w2_denominator": []})
            assert table.channels(node) == whole.nodes[node].channels(node)
        asked = {name: getattr(whole.nodes[node], name) for names in table.asks for name in names}
        assert same.model_copy(update=asked) == whole.nodes[node]


def test_an_empty_model_that_is_given_follows_no_drive(tmp_path):
    oval = load("oval3000")
    assert oval.nodes["controller"].model_denominator == []
    assert oval.with_node("controller", oval.nodes["controller"].model_copy()).nodes == oval.nodes
    (file := tmp_path / "oval.yaml").write_text(oval.to_yaml(given=True), encoding="utf-8")
    assert load(file).nodes["controller"].model_denominator == []
    assert oval.varied({"loaded_drive.coarse_gain": 0.9}).nodes["controller"].model_denominator == []
