# SPDX-License-Identifier: Apache-2.0
"""Tables for other programs from bags."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
