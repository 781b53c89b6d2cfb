# SPDX-License-Identifier: Apache-2.0
"""Analysis of runs, loops and measurements. The modules in ``__all__`` are public; all others may change.

Form: `metrology`, `profile_csv`, `tolerance`, `budget`. Loops: `loop_errors`; `cycle_factors` of any learning law, on a
`resonance_grid`. Responses of drives: `frequency_response`, `measured_drive`.
"""

__all__ = ["metrology", "profile_csv"]
