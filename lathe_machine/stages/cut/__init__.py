# SPDX-License-Identifier: Apache-2.0
"""The cut: force of the cutting process, and vibration of the floor."""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
