# SPDX-License-Identifier: Apache-2.0
"""Export of bags to tables for other programs."""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
