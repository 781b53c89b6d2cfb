# SPDX-License-Identifier: Apache-2.0
"""Start every node of a scenario, the recorder included: ``ros2 launch lathe_rc cell.launch.py``.

``scenario`` names the ROS 2 parameter file, ``bag`` the folder to record to, ``namespace`` that of the nodes. The run
ends when its last block has been recorded; without a number of revolutions it goes on until Ctrl-C. A node that fails
ends the others.
"""

import atexit
import tempfile
from pathlib import Path

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from lathe_rc import harness, resources
from lathe_rc.bag.writer import refuse_existing
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cell.recorder import RecorderParameters
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.namespace import absolute, checked


def generate_launch_description() -> LaunchDescription:
    """Describe the launch; `ros2 launch` calls it."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "scenario",
                default_value=str(resources.find(Path("piston.yaml"))),
                description="ROS 2 parameter file of the cell",
            ),
            DeclareLaunchArgument(
                "bag",
                default_value="",
                description="folder to record to, which must not exist; empty: the scenario's, or bag_ and the run id",
            ),
            DeclareLaunchArgument(
                "namespace", default_value="/", description="of the nodes; two cells in one domain need one each"
            ),
            OpaqueFunction(function=nodes),
        ]
    )


def nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Make the nodes of the scenario that the launch arguments name.

    Raises:
        InputError: the scenario cannot work, or the bag's folder exists.
    """
    path = resources.find(Path(LaunchConfiguration("scenario").perform(context)))
    scenario = scenarios.load(path)
    Cell(scenario.nodes).check()
    namespace = checked(LaunchConfiguration("namespace").perform(context))
    bag = place(scenario, LaunchConfiguration("bag").perform(context))
    refuse_existing(bag)
    complete = harness.with_recorder(scenario, bag, keep=True)
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", prefix="lathe_", suffix=".yaml", delete=False) as file:
        file.write(complete.to_yaml())
    atexit.register(Path(file.name).unlink, missing_ok=True)
    return [
        Node(
            package="lathe_rc",
            executable="container",
            namespace=namespace,
            arguments=[f"{name}:{complete.kind(name)}" for name in group],
            parameters=[file.name],
            ros_arguments=["--enclave", absolute(namespace, group[0])],
            output="screen",
            on_exit=end_with,
        )
        for group in complete.processes()
    ]


def place(scenario: Scenario, argument: str) -> Path:
    """Choose the bag's folder: the launch argument, the scenario's own, or one named after the run."""
    recorders = [table for table in scenario.nodes.values() if isinstance(table, RecorderParameters)]
    return Path(argument or next((table.bag for table in recorders if table.bag), f"bag_{scenario.shared.run_id}"))


def end_with(event: ProcessExited, _context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """End the cell when one of its nodes has failed; those that are done leave one by one.

    When one was killed the time master brings the cell to its safe state, and then fails itself.
    """
    if event.returncode <= 0:
        return []
    return [Shutdown(reason=f"{event.process_name} ended with exit code {event.returncode}")]
