# SPDX-License-Identifier: Apache-2.0
"""Slides of the feed, with force and position loops."""

__all__: list[str] = []  # no public names, see lathe_rc/__init__.pyi
