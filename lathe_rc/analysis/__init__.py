# SPDX-License-Identifier: Apache-2.0
"""Analysis of runs, loops and measurements.

The modules in ``__all__`` are public, all others may change. Form: `form_errors`, `metrology`, `profile_csv`,
`tolerance`, `budget`. Loops: `learning`, `pid_tuning`. Models from measurements: `drive_fit`, `hysteresis_fit`,
`reduced_order`. `shaft`: compliance of the part.
"""

__all__ = [
    "hysteresis_fit",
    "metrology",
    "profile_csv",
    "reduced_order",
    "shaft",
]
