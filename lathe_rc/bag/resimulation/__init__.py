# SPDX-License-Identifier: Apache-2.0
"""Computing a recorded run again behind its spindle."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
