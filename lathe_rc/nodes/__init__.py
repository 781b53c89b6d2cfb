# SPDX-License-Identifier: Apache-2.0
"""The stages as ROS 2 nodes. The only package that imports rclpy."""
