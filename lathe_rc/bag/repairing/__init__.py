# SPDX-License-Identifier: Apache-2.0
"""Making bags readable that were cut off or broken."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
