# SPDX-License-Identifier: Apache-2.0
"""Sources of time and angle: emulated spindle, spindle loaded by the cut, and a real encoder."""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
