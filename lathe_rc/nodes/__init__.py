# SPDX-License-Identifier: Apache-2.0
"""The stages as ROS 2 nodes. The only package that imports rclpy."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
