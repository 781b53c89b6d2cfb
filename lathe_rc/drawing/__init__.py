# SPDX-License-Identifier: Apache-2.0
"""Figures and tables of plain arrays, for the display of results; independent of cells."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
