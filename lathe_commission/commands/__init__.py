# SPDX-License-Identifier: Apache-2.0
"""Command modules of ``lathe`` that lathe_commission adds, each named like its command."""

__all__: list[str] = []
