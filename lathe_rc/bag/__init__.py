# SPDX-License-Identifier: Apache-2.0
"""ROS 2 bags: write, read, check, recover."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
