# SPDX-License-Identifier: Apache-2.0
"""Judgement of a run: part and loops against their tolerances, learning loops, and causes of the error."""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
