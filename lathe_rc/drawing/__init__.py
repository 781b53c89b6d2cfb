# SPDX-License-Identifier: Apache-2.0
"""Pictures and tables of plain arrays: what results show of themselves. Knows no cell."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
