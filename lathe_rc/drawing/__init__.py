# SPDX-License-Identifier: Apache-2.0
"""Figures and tables of plain arrays, for displaying results; independent of cells."""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
