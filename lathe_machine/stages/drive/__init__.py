# SPDX-License-Identifier: Apache-2.0
"""Drives of the tool: `drive` and `plant` are common to all; `loaded_drive` includes the cut."""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
