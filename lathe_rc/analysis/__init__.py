# SPDX-License-Identifier: Apache-2.0
"""Formulas: steady errors, stability margins, metrology."""

__all__ = [
    "hysteresis_fit",
    "metrology",
    "profile_csv",
    "reduced_order",
    "shaft",
]
