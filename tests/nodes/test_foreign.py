# SPDX-License-Identifier: Apache-2.0
"""Nodes of others take part in a cell beside ours: those of examples/, and what they may say wrong."""

import contextlib
import math
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cells import scenario

pytest.importorskip("rclpy")

from ament_index_python.packages import get_package_prefix, get_packages_with_prefixes

from lathe_machine.stages.drive.electrodynamic_actuator import ElectrodynamicActuatorParameters
from lathe_rc import harness, messages
from lathe_rc.bag import reader
from lathe_rc.bag.check import check
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Unknown
from lathe_rc.errors import InputError, LatheError
from lathe_rc.nodes import graph
from lathe_rc.protocol import Announcement
from lathe_rc.signals.form_errors import form_errors

EXAMPLES = Path(__file__).parents[2] / "examples"
PROGRAMS = {
    "learning_controller": (sys.executable, EXAMPLES / "controller.py"),
    "electrodynamic_actuator": (sys.executable, EXAMPLES / "drive.py"),
    "listener": (sys.executable, EXAMPLES / "listener.py"),
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
            command = [*PROGRAMS[name], "--ros-args", "-p", "run_id:=test"]
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
    for path in set(EXAMPLES.glob("*.py")) - set(EXAMPLES.glob("*launch*.py")):
        text = path.read_text(encoding="utf-8")
        used = {name.partition(".")[0] for name in re.findall(r"^(?:from|import) (\S+)", text, re.MULTILINE)}
        assert used - sys.stdlib_module_names <= {"rclpy", "lathe_rc_msgs", "std_msgs", "cell_member"}, path
        assert len(text.splitlines()) < (100 if path.name == "cell_member.py" else 80), path


BOTH = ["learning_controller", "electrodynamic_actuator"]


@pytest.mark.parametrize(
    ("foreign", "together"),
    [
        pytest.param(["electrodynamic_actuator"], ["tool", "recorder"], marks=pytest.mark.system),
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


@pytest.mark.system
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


def test_a_command_that_is_not_finite_loses_its_sender_and_not_its_reader(domain, tmp_path, monkeypatch):
    """The foreign member is named, and the drive goes to its safe position, as the bag says, without the command."""
    monkeypatch.setitem(PROGRAMS, "learning_controller", (sys.executable, "-c", SPOILED, EXAMPLES))
    foreign, together = ["learning_controller"], ["electrodynamic_actuator", "tool", "recorder"]
    with cell(domain, tmp_path / "bag", foreign, together, spindle_encoder=ENDLESS) as (processes, theirs):
        nan = (
            r"^/learning_controller is rejected by /(electrodynamic_actuator|recorder): /coarse/command: "
            r"/learning_controller sends position = nan at sample \d+"
        )
        with pytest.raises(LatheError, match=rf"{nan}; allowed: finite numbers: safe state from sample \d+ on"):
            processes.wait_for_end()
        theirs["learning_controller"].communicate()
        assert theirs["learning_controller"].returncode == 1
    assert not check(tmp_path / "bag").wrong
    recording = reader.read_bag(tmp_path / "bag", whole=True)
    assert recording.dense["/coarse/state"]["position"][-1] == pytest.approx(0.3e-3, abs=1e-6)


DRIVE = "electrodynamic_actuator"
#: What rclcpp needs and the wheels do not have, as repositories name it.
RCLCPP = ("rcl_interfaces/statistics_msgs", "libstatistics_collector", "rclcpp/rclcpp")
#: Libraries that the wheels' CMake files ask for, and that are inside the wheels under other names.
STALE = re.compile(r";/usr/lib64/libtinyxml2\.so|lttng-ust;")


def mended(wheels, place):
    """The CMake files of the wheels without the paths of the machine that built them."""
    (place / "lib").mkdir(parents=True)
    for name in ("include", "bin"):
        (place / name).symlink_to(wheels / name)
    for library in (wheels / "lib").glob("*.so*"):
        (place / "lib" / library.name).symlink_to(library)
    for name in ("fastrtps", "tracetools"):
        shutil.copytree(wheels / "share" / name, place / "share" / name)
    for file in place.glob("share/*/cmake/*.cmake"):
        file.write_text(STALE.sub("", file.read_text()))
    return place


@pytest.fixture(scope="module")
def cpp_drive(tmp_path_factory):
    """Command of the drive of examples/cpp, with the rclcpp of a sourced ROS 2 or built from RCLCPP_SOURCE."""
    place, environ = tmp_path_factory.mktemp("cpp"), dict(os.environ)
    environ["COLCON_HOME"] = str(place)  # the user's own defaults are for the user's own builds
    packages, needed = [EXAMPLES.parent / "msg_defs", EXAMPLES / "cpp"], []
    if "rclcpp" not in get_packages_with_prefixes():
        if "RCLCPP_SOURCE" not in os.environ:
            pytest.skip("no rclcpp: source a ROS 2 that has it, or set RCLCPP_SOURCE (CONTRIBUTING.md)")
        packages += [Path(os.environ["RCLCPP_SOURCE"], part).resolve() for part in RCLCPP]
        wheels = Path(get_package_prefix("rclpy"))
        environ["CMAKE_PREFIX_PATH"] = f"{mended(wheels, place / 'mended')}:{wheels}"
        # Libraries of the wheels need that of Python.
        folder, version = (sysconfig.get_config_var(name) for name in ("LIBDIR", "LDVERSION"))
        needed = [f"-DCMAKE_EXE_LINKER_FLAGS=-L{folder} -Wl,-rpath,{folder},--no-as-needed -lpython{version}"]
    # Fewer and larger compilations take less time; those of generated messages cannot be merged.
    (place / "larger.cmake").write_text("set(CMAKE_UNITY_BUILD ON)\nset(CMAKE_UNITY_BUILD_BATCH_SIZE 8)\n")
    needed += [f"-DCMAKE_PROJECT_rclcpp_INCLUDE={place / 'larger.cmake'}"]
    python = [f"-D{name}_EXECUTABLE={sys.executable}" for name in ("Python3", "PYTHON")]
    build = [
        *(sys.executable, "-m", "colcon", "--log-base", "log", "build", "--merge-install", "--executor", "sequential"),
        *("--base-paths", *packages),
        *("--cmake-args", "-GNinja", "-DBUILD_TESTING=OFF", *python, *needed),
    ]
    subprocess.run(build, cwd=place, env=environ, check=True)
    libraries = f"LD_LIBRARY_PATH={place / 'install' / 'lib'}:{environ.get('LD_LIBRARY_PATH', '')}"
    return "env", libraries, place / "install" / "lib" / "lathe_rc_cpp_example" / "drive"


@pytest.mark.system
@pytest.mark.timeout(3600)
def test_a_drive_in_rclcpp_gives_the_digests_of_ours(domain, tmp_path, monkeypatch, cpp_drive):
    """The drive of examples/cpp takes part for 1000 blocks, with the digests of the run offline."""
    monkeypatch.setitem(PROGRAMS, DRIVE, cpp_drive)
    long = {"revolutions": 17.0}
    with cell(domain, tmp_path / "bag", [DRIVE], ["tool", "recorder"], spindle_encoder=long) as (processes, theirs):
        assert processes.wait_for_end()["complete"]["blocks"] >= 1000
        assert theirs[DRIVE].wait() == 0
    ours = dict(harness.run(scenario(spindle_encoder=long)).digest)
    del ours[f"/{DRIVE}/joint_states"]  # which it does not publish
    assert reader.read_bag(tmp_path / "bag").digests() == ours


@pytest.mark.system
@pytest.mark.timeout(3600)
def test_a_drive_in_rclcpp_says_why_it_fails(domain, tmp_path, monkeypatch, cpp_drive):
    monkeypatch.setitem(PROGRAMS, DRIVE, cpp_drive)
    other = {"sample_rate": 62500}
    with cell(domain, tmp_path / "bag", [DRIVE], ["tool", "recorder"], shared=other) as (processes, theirs):
        with pytest.raises(LatheError, match=f"{DRIVE} failed: has the difference equation for sample_rate = 64000"):
            processes.wait_for_end()
        assert theirs[DRIVE].wait() == 1


KNOWN = ElectrodynamicActuatorParameters(damping=0.5)


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
