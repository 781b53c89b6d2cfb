# SPDX-License-Identifier: Apache-2.0
"""Command modules of ``lathe``, each named like its command."""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
