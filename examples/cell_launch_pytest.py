# SPDX-License-Identifier: Apache-2.0
"""A test of a cell with launch_pytest: ``pytest cell_launch_pytest.py``."""

import asyncio

import launch_pytest
import pytest
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

NODES = 5


@pytest.fixture
def ended():
    """Name and exit code of each process, as it ends."""
    return asyncio.Queue()


@launch_pytest.fixture
def cell(ended, tmp_path):
    file = PathJoinSubstitution([FindPackageShare("lathe_rc"), "launch", "cell.launch.py"])
    arguments = {"spindle_encoder.revolutions": "5.0", "spindle_encoder.speed_factor": "0.0", "bag": f"{tmp_path}/bag"}
    include = IncludeLaunchDescription(PythonLaunchDescriptionSource(file), launch_arguments=arguments.items())

    def note(event, _context):
        ended.put_nowait((event.process_name, event.returncode))

    return LaunchDescription([RegisterEventHandler(OnProcessExit(on_exit=note)), include])


@pytest.mark.launch(fixture=cell)
async def test_every_node_completes_its_part(ended, tmp_path):
    found = [await asyncio.wait_for(ended.get(), 120) for _ in range(NODES)]
    assert [code for _, code in found] == [0] * NODES, found
    assert (tmp_path / "bag" / "metadata.yaml").exists()
