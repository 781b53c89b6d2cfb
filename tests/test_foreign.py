# SPDX-License-Identifier: Apache-2.0
"""Nodes of others, in plain rclpy, take part in a cell beside ours: those of examples/, and what they may say wrong."""

import contextlib
import math
import os
import re
import signal
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
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.stages.electrodynamic_actuator import ElectrodynamicActuatorParameters
from lathe_rc.cell.wiring import Unknown
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes import graph
from lathe_rc.protocol import Announcement

EXAMPLES = Path(__file__).parents[1] / "examples"
PROGRAMS = {"learning_controller": "controller.py", "electrodynamic_actuator": "drive.py", "listener": "listener.py"}
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
            command = [sys.executable, EXAMPLES / PROGRAMS[name], "--ros-args", "-p", "run_id:=test"]
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
    for path in EXAMPLES.glob("*.py"):
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


@pytest.mark.parametrize("killed", ["learning_controller", "tool"])
def test_a_cell_that_loses_one_of_ours_or_of_theirs_goes_to_its_safe_state(domain, tmp_path, killed):
    """The death of a foreign member is noticed, and a foreign member answers when one of ours has died."""
    endless = {"revolutions": 1000.0, "speed_factor": 1.0}
    foreign = ["learning_controller"]
    with cell(domain, tmp_path / "bag", foreign, ["electrodynamic_actuator", "recorder"], spindle_encoder=endless) as (
        processes,
        theirs,
    ):
        processes.wait_for("progress")
        (controller,) = theirs.values()
        os.kill(processes.pids.get(killed, controller.pid), signal.SIGKILL)
        with pytest.raises(LatheError, match=f"{killed} died: safe state from sample"):
            processes.wait_for_end()
        controller.communicate()
        assert controller.returncode == (1 if killed == "tool" else -signal.SIGKILL)


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
