# SPDX-License-Identifier: Apache-2.0
"""Command modules of ``lathe`` that lathe_export adds, each named like its command."""

__all__: list[str] = []
