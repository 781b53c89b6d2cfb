# SPDX-License-Identifier: Apache-2.0
"""A test of a cell with launch_testing: ``launch_test cell_launch_test.py``.

The nodes of a cell leave when its run has ended. launch_testing wants a process that lives as long as the tests, so it
gets one beside them. Each node that has completed its part returns 0.
"""

import tempfile
import unittest
from pathlib import Path

import launch_testing.actions
import launch_testing.asserts
import launch_testing.util
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

BAG = Path(tempfile.mkdtemp()) / "bag"
ARGUMENTS = {"bag": str(BAG), "spindle_encoder.revolutions": "5.0", "spindle_encoder.speed_factor": "0.0"}


def generate_test_description():
    file = PathJoinSubstitution([FindPackageShare("lathe_rc"), "launch", "cell.launch.py"])
    cell = IncludeLaunchDescription(PythonLaunchDescriptionSource(file), launch_arguments=ARGUMENTS.items())
    return LaunchDescription([cell, launch_testing.util.KeepAliveProc(), launch_testing.actions.ReadyToTest()])


class TestCell(unittest.TestCase):
    def test_the_run_ends_and_its_bag_is_complete(self, proc_output, proc_info):
        proc_output.assertWaitFor(
            "run ended: 282 blocks", process="spindle_encoder", strict_proc_matching=False, timeout=120
        )
        proc_info.assertWaitForShutdown("recorder", timeout=30)
        assert (BAG / "metadata.yaml").exists()


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    def test_every_node_returns_0(self, proc_info):
        for name in ("spindle_encoder", "learning_controller", "electrodynamic_actuator", "tool", "recorder"):
            launch_testing.asserts.assertExitCodes(proc_info, process=name)
