# SPDX-License-Identifier: Apache-2.0
"""Blocks of samples between nodes: ports, messages as arrays and as bytes, delays."""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
