# SPDX-License-Identifier: Apache-2.0
"""Measurements in messages of any type: a bag of ros2_control, with commands and joint states."""

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy import signal

from lathe_rc.cli import main
from lathe_rc.commands import measured

STORE = get_typestore(Stores.ROS2_JAZZY)
COMMANDS, STATES = "std_msgs/msg/Float64MultiArray", "sensor_msgs/msg/JointState"
COMMAND, RESPONSE = "command=/controller/commands.data[0]", "response=/joint_states.position[x]"
START, STEP = 1_700_000_000 * 10**9, 10**6  # [ns]


def record(path, *, keep=lambda _: True, joint=lambda _: "x", late=0, stamped=True, back=0, samples=20_000):
    """Write commands by log time, and joint states of a drive of 300 rad/s and 0.8 with times in their headers.

    The joint turns at 100 rad/s from 1 s on; its header times go back by ``back`` [ns] at 1 s.
    """
    types = STORE.types
    filtered = signal.butter(2, 100.0, fs=1000.0)
    command = signal.lfilter(*filtered, np.random.default_rng(2).normal(size=samples)) * 1e-5
    _, position, _ = signal.lsim(([9e4], [1.0, 480.0, 9e4]), command, np.arange(samples) * 1e-3)
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        states = bag.add_connection("/joint_states", STATES, typestore=STORE)
        commands = bag.add_connection("/controller/commands", COMMANDS, typestore=STORE)
        for k in range(samples):
            stamp = START + k * STEP
            message = types[COMMANDS](layout, command[k : k + 1])
            bag.write(commands, stamp, STORE.serialize_cdr(message, COMMANDS))
            seconds, rest = divmod((stamp + late - back * (k >= 1000)) * stamped, 10**9)
            header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](seconds, rest), "")
            both, zero = np.array([1.0, position[k]]), np.zeros(2)
            turning = np.array([0.0, min(100.0, k * 0.1)])
            message = types[STATES](header, ["other", joint(k)], both, turning, zero)
            if keep(k):  # the log is late, and not evenly
                bag.write(states, stamp + 300_000 + 50_000 * (k % 3), STORE.serialize_cdr(message, STATES))


def fit(bag, *columns):
    words = [word for column in columns for word in ("--column", column)]
    return CliRunner().invoke(main, ["fit", "drive", str(bag), *words, "-o", str(bag.parent / "drive.yaml")])


def test_a_drive_is_identified_from_commands_and_joint_states(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "rc2")
    done = fit(tmp_path / "rc2", COMMAND, RESPONSE)
    assert done.exit_code == 0, done.output
    found = yaml.safe_load((tmp_path / "drive.yaml").read_text())["/electrodynamic_actuator"]["ros__parameters"]
    assert found["natural_frequency"] == pytest.approx(300.0, rel=2e-3)
    assert found["damping"] == pytest.approx(0.8, rel=5e-3)
    assert abs(found["delay"]) < 3e-6
    assert "resampled every 1 ms over 20 s, linear between messages, in SI units: " in done.stderr
    assert "/controller/commands.data[0] by log time every 1 ms (uneven by up to 0 ms), " in done.stderr
    assert "/joint_states.position[x] by header time every 1 ms (uneven by up to 0 ms) (a delay between" in done.stderr


@pytest.mark.parametrize(
    ("changes", "columns", "message"),
    [
        ({}, [], "'/controller/commands.data[0]', '/joint_states.position[0, 1, other, x]', '/joint_states.velocity[0"),
        ({}, [], "or frequency with magnitude and phase (--column QUANTITY=COLUMN[:UNIT] for each)"),
        ({}, [COMMAND, "response=/joint_states.position[z]"], "no such column"),
        ({"keep": lambda k: not 500 < k < 600}, [COMMAND, RESPONSE], "[x] for 0.1 s from 0.5 s on; allowed: up to 10"),
        ({"joint": lambda k: "x" if k < 9 else "y"}, [COMMAND, RESPONSE], "has no position[x]; allowed: in every "),
        ({"late": 10**11}, [COMMAND, RESPONSE], "by one clock (--column time=log)"),
        ({"back": 10**9}, [COMMAND, RESPONSE], "the header time of message 1001 is -0.999 s after the one before"),
        ({"keep": lambda k: k < 1}, [COMMAND, RESPONSE], "/joint_states: 1 messages; allowed: two or more"),
    ],
)
def test_what_cannot_be_resampled_is_refused_in_one_line(changes, columns, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "rc2", samples=2000, **changes)
    done = fit(tmp_path / "rc2", *columns)
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1), done.output
    assert message in done.stderr
    assert not (tmp_path / "drive.yaml").exists()


@pytest.mark.parametrize(("changes", "more"), [({"stamped": False}, []), ({"late": 10**11}, ["time=log"])])
def test_without_header_times_or_if_asked_for_those_of_the_log_are_used(changes, more, tmp_path, capsys):
    record(tmp_path / "rc2", samples=2000, **changes)
    found = measured.opened(tmp_path / "rc2", [COMMAND, RESPONSE, *more])
    assert found.clock(None, "command", "response").step == pytest.approx(1e-3, rel=1e-4)
    assert "position[x] by log time every 1.00003 ms (uneven by up to 0.1 ms)\n" in capsys.readouterr().err


def test_slower_and_later_messages_are_resampled_and_said(tmp_path, capsys):
    """The slower column gives the interval; the warning says from which frequency on the faster one is aliased."""
    record(tmp_path / "rc2", samples=2000, keep=lambda k: k % 4 == 0 and k >= 1000)
    found = measured.opened(tmp_path / "rc2", [COMMAND, "response=/joint_states.velocity[x]"])
    command, response = found.read("command", "response")
    assert found.clock(None, "command", "response").step == pytest.approx(4e-3)
    assert command.size == response.size == 250
    assert np.all(response == 100.0)
    told = capsys.readouterr().err
    assert "resampled every 4 ms over 0.996 s" in told
    assert "every 1 ms (uneven by up to 0 ms, without the first 1 s and the last 0.003 s)" in told
    assert "/controller/commands.data[0] is resampled to 4 ms: its content above 125 Hz" in told


def test_a_tachogram_is_made_of_the_velocity_of_a_joint(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "rc2", samples=2000)
    speed = ["--column", "speed=/joint_states.velocity[x]", "-o", "speed.csv", "--tolerance", "0.001"]
    done = CliRunner().invoke(main, ["bag", "tachogram", "rc2", *speed])
    assert done.exit_code == 0, done.output
    rows = np.loadtxt("speed.csv", delimiter=",", skiprows=2)
    rpm = 100.0 * 30.0 / np.pi
    assert rows == pytest.approx(np.array([[0.0, 0.0], [1.0, rpm], [1.999, rpm]]), abs=1e-9)


def test_a_tachogram_without_a_column_is_refused_with_those_of_the_bag(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "rc2", samples=2000)
    for words, told in (
        ([], "'/joint_states.effort[0, 1, other, x]'; allowed: an encoder, or speed (--column"),
        (["--column", "speed=/joint_states.position[x]"], "from -"),
        (["--column", "speed=/joint_states.velocity[x]", "--topic", "/a"], "--topic /a beside --column"),
    ):
        done = CliRunner().invoke(main, ["bag", "tachogram", "rc2", *words])
        assert done.exit_code == 2, done.output
        assert told in done.stderr
    assert not (tmp_path / "rc2-tachogram.csv").exists()
