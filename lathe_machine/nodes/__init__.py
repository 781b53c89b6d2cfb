# SPDX-License-Identifier: Apache-2.0
"""Nodes of members that a stage alone cannot be: the time master with a real encoder. Imports rclpy."""

__all__: list[str] = []  # all of it may change: see lathe_machine/__init__.pyi
