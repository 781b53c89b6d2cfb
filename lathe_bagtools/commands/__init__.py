# SPDX-License-Identifier: Apache-2.0
"""Command modules of ``lathe`` that lathe_bagtools adds, each named like its command."""

__all__: list[str] = []
