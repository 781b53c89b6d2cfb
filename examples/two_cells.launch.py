# SPDX-License-Identifier: Apache-2.0
"""Two cells in one ROS domain, each in its own namespace: ``ros2 launch two_cells.launch.py``."""

from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import PushRosNamespace
from launch_ros.substitutions import FindPackageShare

FILE = PathJoinSubstitution([FindPackageShare("lathe_rc"), "launch", "cell.launch.py"])


def cell(bag, **arguments):
    arguments |= {"bag": bag, "spindle_encoder.revolutions": "3.0", "spindle_encoder.speed_factor": "0.0"}
    include = IncludeLaunchDescription(PythonLaunchDescriptionSource(FILE), launch_arguments=arguments.items())
    return GroupAction([PushRosNamespace("shop"), include])


def generate_launch_description():
    return LaunchDescription([cell("right_bag"), cell("left_bag", namespace="left")])
