# SPDX-License-Identifier: Apache-2.0
"""A cell at work, seen and commanded: panel in the browser, learning loops with settings to drag, and Rerun."""

__all__: list[str] = []  # no stable API
