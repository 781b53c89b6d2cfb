# SPDX-License-Identifier: Apache-2.0
"""From measurements to a cell: models of measured drives, learning laws for them, and corrected forms."""

__all__: list[str] = []  # no stable API
