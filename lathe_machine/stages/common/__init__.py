# SPDX-License-Identifier: Apache-2.0
"""Building blocks that stages of several families use."""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
