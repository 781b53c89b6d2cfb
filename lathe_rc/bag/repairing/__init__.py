# SPDX-License-Identifier: Apache-2.0
"""Recovery of truncated or damaged bags."""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
