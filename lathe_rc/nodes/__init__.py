# SPDX-License-Identifier: Apache-2.0
"""ROS 2 nodes of the stages. The only package that imports rclpy."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
