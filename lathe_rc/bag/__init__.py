# SPDX-License-Identifier: Apache-2.0
"""Bags: write, read, check, recover."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
