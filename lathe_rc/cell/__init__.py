# SPDX-License-Identifier: Apache-2.0
"""Framework for stages: messages, parameter tables, wiring and the offline engine, independent of ROS."""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
