# SPDX-License-Identifier: Apache-2.0
"""Reading bags of any maker, piece by piece."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
