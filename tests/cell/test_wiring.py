# SPDX-License-Identifier: Apache-2.0
"""The wired cell, and what it refuses before anything moves."""

from math import pi

import pytest
from cells import NODES, announced, run, scenario
from machines import line_of

from lathe_rc import allowed_code, harness, messages
from lathe_rc.blocks.ports import Input, Output
from lathe_rc.cell.parameters import NodeParameters
from lathe_rc.cell.scenario import load
from lathe_rc.cell.stage import Stage
from lathe_rc.cell.wiring import Cell, Unknown
from lathe_rc.errors import InputError


class Repeater(Stage):
    """A stage that commands what it is commanded."""

    Parameters = NodeParameters

    def __init__(self, name, parameters):
        super().__init__(name, parameters)
        self.declare(
            inputs=[Input("command_in", messages.COMMAND, ("position",))],
            outputs=[Output("command_out", messages.COMMAND)],
        )

    def process(self, first, inputs, outputs):
        outputs[0]["position"][:] = inputs[0]["position"]
        return []


REPEATER = "test_wiring:Repeater"


@pytest.fixture(autouse=True, scope="module")
def allowed(program):
    allowed_code.allow("test_wiring")


def refusal(shared=None, **nodes):
    """The one line with which a cell is refused."""
    return line_of(lambda: harness.run(scenario(shared, **nodes)))


# --- topics


def test_stages_stand_in_the_order_of_the_forward_edges():
    backwards = dict(reversed(scenario().nodes.items()))
    assert tuple(Cell(backwards).stages) == NODES


@pytest.mark.parametrize(
    ("node", "values", "told"),
    [
        ("second_drive", {"stage": "electrodynamic_actuator"}, "coarse/state is published by electrodynamic_actuator "),
        ("other", {"stage": "spindle_encoder", "revolutions": 3.0, "remap": ["encoder:=other"]},
         "2 time masters in the scenario; allowed: 1, a spindle_encoder or encoder_device or loaded_spindle"),
    ],
)  # fmt: skip
def test_a_node_too_many_is_refused(node, values, told):
    assert refusal(**{node: values}).startswith(told)


def test_loop_without_a_delay_is_refused():
    there = {"stage": REPEATER, "remap": ["command_in:=back", "command_out:=there"]}
    back = {"stage": REPEATER, "remap": ["command_in:=there", "command_out:=back"]}
    told = refusal(there=there, back=back)
    assert told.endswith("a loop without a feedback delay cannot start")
    assert "there -> back" in told or "back -> there" in told


def test_stage_may_be_put_between_two_others():
    between = {"stage": REPEATER, "remap": ["command_in:=coarse/command", "command_out:=coarse/checked"]}
    learns = {"stop_ratio": 2.0}  # nobody knows what is between
    behind = {"remap": ["coarse/command:=coarse/checked"]}
    with_it = run(learning_controller=learns, between=between, electrodynamic_actuator=behind)
    without = run()
    assert with_it.digest["/coarse/checked"] == without.digest["/coarse/command"]
    assert with_it.digest["/tool"] == without.digest["/tool"]


def test_renamed_topic_changes_nothing_else():
    renamed = ["coarse/state:=carriage"]
    names = ("electrodynamic_actuator", "learning_controller", "tool")
    result = run(**{name: {"remap": renamed} for name in names})
    assert result.digest["/carriage"] == run().digest["/coarse/state"]


# --- checks


def test_block_as_long_as_the_feedback_s_delay_runs():
    assert run({"block_size": 2048}).digest == run({"block_size": 1}).digest


ORDER, AMPLITUDE, NOMINAL = 4, 100e-6, 1000 * pi / 30
WAVE = {"harmonic_order": [ORDER], "harmonic_amplitude": [AMPLITUDE]}


@pytest.mark.parametrize(
    ("limit", "asked", "shown"),
    [
        ("stroke", AMPLITUDE, "stroke 100 µm; allowed: 99 µm"),
        ("max_velocity", AMPLITUDE * ORDER * NOMINAL, "velocity 0.04189 m/s; allowed: 0.04147 m/s"),
        ("max_acceleration", AMPLITUDE * (ORDER * NOMINAL) ** 2, "acceleration 17.55 m/s^2; allowed: 17.37 m/s^2"),
    ],
)
def test_profile_that_the_drive_cannot_follow_is_refused_with_the_figures(limit, asked, shown):
    run(tool=WAVE, electrodynamic_actuator={limit: 1.01 * asked})
    told = refusal(tool=WAVE, electrodynamic_actuator={limit: 0.99 * asked})
    assert told.startswith("tool.profile: electrodynamic_actuator cannot follow it at 104.7 rad/s: ")
    assert shown in told


def test_profile_is_judged_at_the_highest_speed():
    swing = {"deviation_amplitude": [0.1], "deviation_frequency": [10.7], "revolutions": 10.0}
    drive = {"max_velocity": 1.05 * AMPLITUDE * ORDER * NOMINAL}
    run(tool=WAVE, electrodynamic_actuator=drive)
    assert "at 115.2 rad/s: velocity 0.04608 m/s" in refusal(
        tool=WAVE, electrodynamic_actuator=drive, spindle_encoder=swing
    )


# --- members that nobody here knows


LEFT_OPEN = "the parameters of {} are not known here: "
CONVERGES = "whether learning_controller converges with electrodynamic_actuator"
FOLLOWS = "whether electrodynamic_actuator can follow the profile of tool"
REACHES = "whether {} gets beyond supervisor.clear_position"


@pytest.mark.parametrize(
    ("file", "unknown", "left_open"),
    [
        ("piston", "learning_controller", []),
        ("piston", "electrodynamic_actuator", [CONVERGES, FOLLOWS]),
        ("supervised", "electrodynamic_actuator", [CONVERGES, FOLLOWS, REACHES.format("electrodynamic_actuator")]),
        ("supervised", "learning_controller", [REACHES.format("learning_controller")]),
        ("vibration", "profile", ["whether a drive can follow what tool reads"]),
    ],
)
def test_of_a_member_that_nobody_knows_its_topics_count_and_what_is_not_checked_is_said(file, unknown, left_open):
    cell = announced(load(file), unknown)
    cell.check()
    assert sorted(cell.unchecked) == sorted(LEFT_OPEN.format(unknown) + each for each in left_open)


def test_a_listener_that_nobody_knows_is_no_drive_of_a_controller():
    """A recorder reads the command as a drive does, and publishes no samples."""
    nodes = load("piston").nodes
    cell = Cell(nodes, {"recorder": Unknown({}, {}, frozenset({"coarse/command"}))})
    cell.check()
    assert cell.unchecked == []


def test_what_does_not_depend_on_members_that_nobody_knows_is_checked():
    slow = scenario({"nominal_rpm": 3000.0}, learning_controller={"feedback_delay": 3200})
    with pytest.raises(InputError, match=r"^learning_controller.feedback_delay = 3200 samples: "):
        announced(slow, "electrodynamic_actuator").check()


def test_a_topic_that_a_member_that_nobody_knows_publishes_as_another_type_or_with_another_is_refused():
    nodes = scenario().nodes
    drive = {name: table for name, table in nodes.items() if name != "electrodynamic_actuator"}
    with pytest.raises(InputError, match=r"reads coarse/state as .*ActuatorState, but other publishes .*ToolBlock$"):
        Cell(drive, {"other": Unknown({"coarse/state": messages.TOOL}, {}, frozenset())})
    with pytest.raises(InputError, match=r"^coarse/state is published by electrodynamic_actuator and other; remap one"):
        Cell(nodes, {"other": Unknown({"coarse/state": messages.STATE}, {}, frozenset())})
