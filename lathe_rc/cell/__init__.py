# SPDX-License-Identifier: Apache-2.0
"""The frame of the stages: messages, parameter tables, wiring, the offline engine. Knows no ROS."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
