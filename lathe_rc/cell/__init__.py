# SPDX-License-Identifier: Apache-2.0
"""Framework of the stages: messages, parameter tables, wiring, and the offline engine, independent of ROS."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
