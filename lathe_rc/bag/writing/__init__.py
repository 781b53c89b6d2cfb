# SPDX-License-Identifier: Apache-2.0
"""Bag writing: recorder output, message order and snapshots."""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
