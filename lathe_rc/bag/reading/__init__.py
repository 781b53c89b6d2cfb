# SPDX-License-Identifier: Apache-2.0
"""Reading of bags from any recorder, in chunks."""

__all__: list[str] = []  # everything here may change: see lathe_rc/__init__.pyi
