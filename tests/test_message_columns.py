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

STORE = get_typestore(Stores.ROS2_JAZZY)
COMMANDS, STATES = "std_msgs/msg/Float64MultiArray", "sensor_msgs/msg/JointState"
COMMAND, RESPONSE = "command=/controller/commands.data[0]", "response=/joint_states.position[x]"
START, STEP = 1_700_000_000 * 10**9, 10**6  # [ns]


def record(path, *, keep=lambda _: True, joint=lambda _: "x", late=0, stamped=True):
    """Write commands by log time, and joint states of a drive of 300 rad/s and 0.8 with times in their headers."""
    types = STORE.types
    filtered = signal.butter(2, 100.0, fs=1000.0)
    command = signal.lfilter(*filtered, np.random.default_rng(2).normal(size=20_000)) * 1e-5
    _, position, _ = signal.lsim(([9e4], [1.0, 480.0, 9e4]), command, np.arange(20_000) * 1e-3)
    layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        states = bag.add_connection("/joint_states", STATES, typestore=STORE)
        commands = bag.add_connection("/controller/commands", COMMANDS, typestore=STORE)
        for k in range(20_000):
            stamp = START + k * STEP
            message = types[COMMANDS](layout, command[k : k + 1])
            bag.write(commands, stamp, STORE.serialize_cdr(message, COMMANDS))
            seconds, rest = divmod((stamp + late) * stamped, 10**9)
            header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](seconds, rest), "")
            both, zero = np.array([1.0, position[k]]), np.zeros(2)
            message = types[STATES](header, ["other", joint(k)], both, zero, zero)
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
    told = (
        "resampled every 1 ms over 20 s, linear between messages, in SI units: /controller/commands.data[0] by log time"
    )
    assert told in done.stderr
    assert "/joint_states.position[x] by header time (a delay between the two clocks is in the result)" in done.stderr


@pytest.mark.parametrize(
    ("changes", "columns", "message"),
    [
        ({}, [], "columns '/controller/commands.layout.data_offset', '/controller/commands.data[0]'"),
        ({}, [COMMAND, "response=/joint_states.position[z]"], "no such column"),
        ({"keep": lambda k: not 500 < k < 600}, [COMMAND, RESPONSE], "[x] for 0.1 s from 0.5 s on; allowed: up to 10"),
        (
            {"joint": lambda k: "x" if k < 9 else "y"},
            [COMMAND, RESPONSE],
            "has no position[x]; allowed: in every message",
        ),
        ({"late": 10**11}, [COMMAND, RESPONSE], "columns of different times"),
    ],
)
def test_what_cannot_be_resampled_is_refused_in_one_line(changes, columns, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "rc2", **changes)
    done = fit(tmp_path / "rc2", *columns)
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1), done.output
    assert message in done.stderr
    assert not (tmp_path / "drive.yaml").exists()


def test_without_header_times_those_of_the_log_are_used(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record(tmp_path / "rc2", stamped=False)
    done = fit(tmp_path / "rc2", COMMAND, RESPONSE)
    assert done.exit_code == 0, done.output
    assert "/joint_states.position[x] by log time; intervals differ by up to 0.1 ms" in done.stderr
