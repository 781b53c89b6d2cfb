# SPDX-License-Identifier: Apache-2.0
"""Formulas: steady errors, stability margins, metrology."""

__all__ = [
    "coupled_loops",
    "hyperstability",
    "hysteresis_fit",
    "metrology",
    "periodic_example",
    "profile_csv",
    "reduced_order",
    "sampled_loop",
    "shaft",
]
