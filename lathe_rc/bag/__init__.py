# SPDX-License-Identifier: Apache-2.0
"""Writing, reading, checking and recovering ROS 2 bags."""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
