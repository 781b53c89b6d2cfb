# SPDX-License-Identifier: Apache-2.0
"""Nodes of others, in plain rclpy, take part in a cell beside ours: those of examples/, and what they may say wrong."""

import contextlib
import math
import re
import subprocess
import sys
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cells import scenario

pytest.importorskip("rclpy")


from lathe_rc import harness, messages
from lathe_rc.analysis.form_errors import form_errors
from lathe_rc.bag import reader
from lathe_rc.bag.check import check
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stages.electrodynamic_actuator import ElectrodynamicActuatorParameters
from lathe_rc.cell.wiring import Unknown
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes import graph
from lathe_rc.protocol import Announcement

EXAMPLES = Path(__file__).parents[1] / "examples"
PROGRAMS = {
    "learning_controller": (EXAMPLES / "controller.py",),
    "electrodynamic_actuator": (EXAMPLES / "drive.py",),
    "listener": (EXAMPLES / "listener.py",),
}
DELAY = 3200
MISSING = "not checked: the parameters of electrodynamic_actuator are not known here: whether"
CONVERGES = f"{MISSING} learning_controller converges with electrodynamic_actuator"
SAID = {
    "learning_controller": ["/learning_controller, stage 'my_learning', is known by its topics alone"],
    "electrodynamic_actuator": [
        "/electrodynamic_actuator, stage 'my_drive', is known by its topics alone",
        f"{MISSING} electrodynamic_actuator can follow the profile of tool",
    ],
    "listener": ["/listener, stage 'my_listener', is known by its topics alone"],
}


@contextlib.contextmanager
def cell(domain, bag, foreign, together, **nodes):
    """The processes of the smallest whole cell, some of whose members are programs of examples/, and these."""
    whole = harness.with_recorder(scenario(**nodes), bag, keep=True)
    master = whole.nodes["spindle_encoder"]
    members = list(dict.fromkeys([*master.members, *foreign]))
    ours = {name: table for name, table in whole.nodes.items() if name not in foreign}
    ours["spindle_encoder"] = master.model_copy(update={"members": members})
    with contextlib.ExitStack() as stack:
        groups = Scenario("test", ours).processes([together])
        processes = stack.enter_context(harness.Processes(Scenario("test", ours), groups, domain=domain))
        theirs = {}
        for name in foreign:
            command = [sys.executable, *PROGRAMS[name], "--ros-args", "-p", "run_id:=test"]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
            theirs[name] = stack.enter_context(process)
            stack.callback(process.kill)
        yield processes, theirs


def controlled(recording):
    """The command that examples/controller.py gives for what the bag says that it has read."""
    encoder, error = recording.dense["/encoder"], recording.dense["/tool"]["measured_error"]

    def points(angle):
        return (angle / math.tau * 1000).astype(int) % 1000

    zeros = np.zeros(DELAY)
    past, late = points(np.concatenate([zeros, encoder["angle"]])), np.concatenate([zeros, error])
    ahead, memory, command = (
        points(encoder["angle"] + 1.425e-3 * encoder["speed"]),
        np.zeros(1000),
        np.empty(error.size),
    )
    for n in range(error.size):
        if n and past[n] != past[n - 1]:
            memory[past[n]] += 0.3 * late[n]
        command[n] = memory[ahead[n]]
    return command


def driven(recording):
    """The position that examples/drive.py reaches for the command in the bag."""
    line, x, v, position = deque([0.0] * 23), 0.0, 0.0, []
    for wanted in recording.dense["/coarse/command"]["position"].tolist():
        line.append(wanted)
        v += 15_625e-9 * (1038.0**2 * (line.popleft() - x) - 2.0 * 0.804 * 1038.0 * v)
        x += 15_625e-9 * v
        position.append(x)
    return position


def test_the_examples_use_nothing_of_lathe_rc_but_its_messages():
    """They run without the Python package lathe_rc, and each fits on a screen or two."""
    for path in set(EXAMPLES.glob("*.py")) - set(EXAMPLES.glob("*_launch_*.py")):
        text = path.read_text(encoding="utf-8")
        used = {name.partition(".")[0] for name in re.findall(r"^(?:from|import) (\S+)", text, re.MULTILINE)}
        assert used - sys.stdlib_module_names <= {"rclpy", "lathe_rc_msgs", "std_msgs", "cell_member"}, path
        assert len(text.splitlines()) < (100 if path.name == "cell_member.py" else 80), path


BOTH = ["learning_controller", "electrodynamic_actuator"]


@pytest.mark.parametrize(
    ("foreign", "together"),
    [
        (["electrodynamic_actuator"], ["tool", "recorder"]),
        ([*BOTH, "listener"], ["spindle_encoder", "tool"]),
    ],
)
def test_nodes_in_plain_rclpy_take_part_in_a_cell(domain, tmp_path, foreign, together):
    """The programs of examples/, alone and together, take part for 1000 blocks, and do what their law says."""
    long = {"revolutions": 17.0}
    with cell(domain, tmp_path / "bag", foreign, together, spindle_encoder=long) as (processes, theirs):
        told = processes.wait_for_end()
        assert told["complete"]["blocks"] >= 1000
        said = {name: process.communicate()[0] for name, process in theirs.items()}
        assert {name: process.returncode for name, process in theirs.items()} == dict.fromkeys(foreign, 0), said
        log = "\n".join(processes._log("spindle_encoder"))
        assert [line for name in foreign for line in SAID[name] if line not in log] == []
        assert (CONVERGES in log) == (foreign == ["electrodynamic_actuator"])
    recording = reader.read_bag(tmp_path / "bag")
    errors = recording.dense["/tool"]["error"]
    by_revolution = form_errors(recording.dense["/encoder"]["angle_true"], errors).rms
    assert by_revolution[-1] < 0.05 * by_revolution[0]
    if "learning_controller" in foreign:
        assert np.array_equal(recording.dense["/coarse/command"]["position"], controlled(recording))
    if "electrodynamic_actuator" in foreign:
        assert recording.dense["/coarse/state"]["position"].tolist() == driven(recording)
    if "listener" in foreign:
        squares = 0.0
        for error in errors.tolist():
            squares += error * error
        assert said["listener"] == f"{errors.size} samples, form error {math.sqrt(squares / errors.size)} m RMS\n"


ENDLESS = {"revolutions": 1000.0, "speed_factor": 1.0}


def test_the_death_of_a_foreign_member_makes_the_cell_safe(domain, tmp_path):
    foreign, together = ["learning_controller"], ["electrodynamic_actuator", "recorder"]
    with cell(domain, tmp_path / "bag", foreign, together, spindle_encoder=ENDLESS) as (processes, theirs):
        processes.wait_for("progress")
        theirs["learning_controller"].kill()
        with pytest.raises(LatheError, match="learning_controller died: safe state from sample"):
            processes.wait_for_end()


#: The example controller, which after some revolutions gives a command that is not finite.
SPOILED = """
import math, sys
sys.path.insert(0, sys.argv.pop(1))
from controller import Controller, run

class Spoiled(Controller):
    def learn(self, place, error):
        super().learn(place, math.nan if self.so_far.blocks > 200 else error)

run(Spoiled)
"""


def test_a_command_that_is_not_finite_loses_its_reader_and_not_the_container(domain, tmp_path, monkeypatch):
    """A drive that shares its process with the tool fails by name, the others go on to the safe state.

    The foreign member answers that it cannot go on without the drive.
    """
    monkeypatch.setitem(PROGRAMS, "learning_controller", ("-c", SPOILED, EXAMPLES))
    foreign, together = ["learning_controller"], ["electrodynamic_actuator", "tool", "recorder"]
    with cell(domain, tmp_path / "bag", foreign, together, spindle_encoder=ENDLESS) as (processes, theirs):
        nan = (
            r"electrodynamic_actuator failed: /coarse/command: /learning_controller sends position = nan at sample \d+"
        )
        with pytest.raises(LatheError, match=rf"{nan}; allowed: finite numbers: safe state from sample \d+ on"):
            processes.wait_for_end()
        theirs["learning_controller"].communicate()
        assert theirs["learning_controller"].returncode == 1
    wrong = check(tmp_path / "bag").wrong
    assert [line for line in wrong if not line.startswith("/coarse/command: ")] == []


KNOWN = ElectrodynamicActuatorParameters(damping=0.5)
DRIVE = "electrodynamic_actuator"


@pytest.mark.parametrize(
    ("stage", "parameters", "why"),
    [
        (DRIVE, KNOWN.model_dump_json(), None),
        (DRIVE, KNOWN.model_dump_json(exclude={"damping"}), "its parameters do not say damping"),
        (DRIVE, "{}", "its parameters do not say sample_rate and [0-9]+ others"),
        ("my_drive", KNOWN.model_dump_json(), "there is no such stage here"),
        ("", "{}", "there is no such stage here"),
        ("nobody.has:Drive", "{}", "stage 'nobody.has:Drive': code that no installed package offers; allowed: .*"),
        ("os:getpid", "{}", "stage 'os:getpid': code that no installed package offers; allowed: .*"),
    ],
)
def test_a_member_is_known_if_its_stage_and_all_its_parameters_are(stage, parameters, why):
    """A member is checked if its stage and all its parameters are known, else known by its topics alone.

    Of others the topics count; why nobody knows them is said once.
    """
    topics = {"publishes": ("/coarse/state", "/drive/events"), "types": (messages.STATE, messages.EVENT)}
    member = Announcement("", "/drive", stage, parameters=parameters, sparse=(False, True), **topics)
    member = replace(member, subscribes=("/coarse/command",))
    said = []
    found = graph.announced({"/drive": member}, ["/drive"], "/", lambda *words: said.append(words))
    unknown = Unknown({"coarse/state": messages.STATE}, {"drive/events": messages.EVENT}, frozenset({"coarse/command"}))
    known = {"drive": KNOWN.model_copy(update={"stage": DRIVE})}
    assert found == ((known, {}) if why is None else ({}, {"drive": unknown}))
    if why is None:
        assert not said
    else:
        assert said[0][:2] == ("/drive", stage)
        assert re.fullmatch(why, said[0][2])


def test_a_parameter_that_cannot_be_is_refused_with_the_name_of_its_member():
    wrong = Announcement("", "/drive", DRIVE, parameters=KNOWN.model_copy(update={"damping": -1.0}).model_dump_json())
    with pytest.raises(InputError, match=r"^/drive.damping = -1.0; allowed: a finite number above 0"):
        graph.announced({"/drive": wrong}, ["/drive"], "/", print)
