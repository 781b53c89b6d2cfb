# SPDX-License-Identifier: Apache-2.0
"""Reading of bags of any maker, in chunks."""

__all__: list[str] = []  # all of it may change: see lathe_rc/__init__.pyi
