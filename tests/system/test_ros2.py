# SPDX-License-Identifier: Apache-2.0
"""The real ``ros2`` command line, launch and launch_testing, where there is a ROS 2 whose index has lathe_rc.

Its Python need not have what lathe_rc needs. ROS 2 that is sourced has all of it; beside the wheels, pip installs the
public sources of ros2cli, launch and launch_ros.
"""

import json
import os
import re
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.cell.beside import BESIDE
from lathe_rc.cell.scenario import TABLES, load
from lathe_rc.harness import launch_plan

ROS2 = shutil.which("ros2")
FILE = Path(__file__).parents[2] / "config" / "piston.yaml"

pytestmark = [pytest.mark.system, pytest.mark.skipif(ROS2 is None, reason="no ros2 on the PATH")]


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch, domain):
    """An empty folder, and a ROS domain of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
    return tmp_path


def ros2(*words, code=0):
    """Output of a command of ros2 on both streams; ``code``: None for any."""
    done = subprocess.run([ROS2, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    assert code is None or done.returncode == code, done.stdout
    return done.stdout


def test_the_executables_are_found_by_ros2():
    """``ros2 pkg executables`` lists every node, also after an installation by pip."""
    listed = {line.split()[1] for line in ros2("pkg", "executables", "lathe_rc").splitlines()}
    assert {*TABLES.own, *BESIDE, "container", launch_plan.__name__.rpartition(".")[2]} <= listed
    assert "usage: ros2 run lathe_rc tool" in ros2("run", "lathe_rc", "tool", "--help")


def test_an_argument_that_there_is_not_is_refused():
    assert "no launch argument 'revolutions'" in ros2(
        "launch", "lathe_rc", "cell.launch.py", "revolutions:=5.0", code=1
    )


def test_two_included_cells_are_in_the_namespaces_that_are_pushed_and_end():
    said = ros2("launch", str(Path(__file__).parents[2] / "examples" / "two_cells.launch.py"))
    assert said.count("process has finished cleanly") == 10
    for bag, namespace in (("right_bag", "/shop"), ("left_bag", "/shop/left")):
        recording = reader.read_bag(Path(bag))
        assert all(topic.startswith(f"{namespace}/") for topic in recording.dense)


def signalled(line, number, *, group, pids):
    """Exit code and output of a launch of an endless cell, signalled at a line; ``group``: as Ctrl-C does."""
    command = [ROS2, "launch", "lathe_rc", "cell.launch.py", "bag:=bag", "spindle_encoder.revolutions:=0.0"]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    ) as launch:
        said = ""
        for text in launch.stdout:
            said += text
            pids |= {
                name: int(pid) for name, pid in re.findall(r"\[(\w+)-\d\]: process started with pid \[(\d+)\]", text)
            }
            if re.search(line, text):
                line = "(?!)"
                os.killpg(launch.pid, number) if group else os.kill(pids["tool"], number)
        return launch.wait(), said


def test_ctrl_c_ends_an_endless_cell_with_a_whole_bag_and_no_error():
    code, said = signalled("begins with", signal.SIGINT, group=True, pids={})
    assert code == 0
    assert said.count("process has finished cleanly") == 5
    assert not re.search("ERROR|Traceback|died", said)
    assert reader.read_bag(Path("bag")).digests() == json.loads(Path("bag", "digests.json").read_text())["digest"]


@pytest.mark.parametrize("line", [r"tool-\d]: process started", r"tool]: unconfigured"])
def test_a_member_that_a_signal_ends_before_the_run_ends_the_others(line):
    code, said = signalled(line, signal.SIGTERM, group=False, pids={})
    assert code == 1
    assert re.search(r"tool-\d (was killed by SIGTERM|ended with exit code 143)", said)


DICTIONARY = """
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    values = {{"feed": 0.3e-3}}
    return LaunchDescription([Node(package="lathe_rc", executable="tool", parameters=["{file}", values])])
"""


def test_a_dictionary_of_a_launch_file_does_not_lose_silently():
    Path("dictionary.launch.py").write_text(DICTIONARY.format(file=FILE))
    said = ros2("launch", "dictionary.launch.py")
    assert re.search(
        r"lathe: feed = 0.0003 of \S+ does not reach /tool, which has 0.0001 of an earlier file; write", said
    )


def test_parameters_are_set_in_a_run_that_is_simulated_again():
    """``ros2 param set`` changes gain and pace in a run; the same event gives the same digests."""
    slow = ("spindle_encoder.revolutions:=12.0", "spindle_encoder.speed_factor:=0.005")
    with subprocess.Popen(
        [ROS2, "launch", "lathe_rc", "cell.launch.py", "bag:=bag", *slow], stdout=subprocess.PIPE, text=True
    ) as launch:
        try:
            while "begins with" not in launch.stdout.readline():
                pass
            ours, said = "/learning_controller", ""
            while "successful: from revolution 1 on, as an event on" not in said:  # not before its first block
                said = ros2("param", "set", ours, "learning_gain", "0.5", code=None)
            assert "Setting parameter failed: " in ros2("param", "set", ours, "gain", "0.5", code=None)
            assert "is read-only: " in ros2("param", "set", ours, "feedback_delay", "64", code=None)
            assert "Double value is: 0.5" in ros2("param", "get", ours, "learning_gain")
            assert "successful: from block" in ros2("param", "set", "/spindle_encoder", "speed_factor", "0.0")
            rest = launch.stdout.read()
            assert launch.wait() == 0, rest
            assert " blocks late; the schedule slipped by " in rest
        finally:
            launch.send_signal(signal.SIGINT)
            ros2("daemon", "stop")
    recording = reader.read_bag(Path("bag"))
    said = recording.sparse["/learning_controller/events"].values
    assert said["action"] == ["set learning_gain 0.5"]
    event = f"sample {said['sample_index'][0]}: set learning_gain 0.5"
    sets = ["spindle_encoder.revolutions=12.0", f"learning_controller.events=['{event}']"]
    assert recording.digests() == harness.run(load(FILE, sets)).digest


def test_the_example_for_launch_pytest_passes(place):
    python = os.environ.get("ROS2_PYTHON", "/usr/bin/python3")  # the one that ros2 runs
    if subprocess.run([python, "-c", "import launch_pytest"], capture_output=True, check=False).returncode:
        pytest.skip(f"{python} has no launch_pytest")
    shutil.copy(Path(__file__).parents[2] / "examples" / "cell_launch_pytest.py", "test_cell.py")
    command = [python, "-m", "pytest", "-p", "no:cacheprovider", "test_cell.py"]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.skipif(shutil.which("launch_test") is None, reason="no launch_test on the PATH")
def test_the_example_for_launch_testing_passes():
    example = Path(__file__).parents[2] / "examples" / "cell_launch_test.py"
    done = subprocess.run(
        ["launch_test", example],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        env=os.environ,
    )
    assert done.returncode == 0, done.stdout
