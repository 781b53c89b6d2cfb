# SPDX-License-Identifier: Apache-2.0
"""Re-simulation of a recorded run with its recorded spindle."""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
