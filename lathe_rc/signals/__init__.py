# SPDX-License-Identifier: Apache-2.0
"""Inputs of the cell: spindle speed laws, encoder, part profiles."""

__all__ = ["deviation_law", "part_profile", "speed"]
