# SPDX-License-Identifier: Apache-2.0
"""The commands of ``lathe`` that have a file of their own, each named as its file."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
