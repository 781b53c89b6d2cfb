# SPDX-License-Identifier: Apache-2.0
"""Inputs of the cell. The modules in ``__all__`` are public, all others may change.

Spindle: `speed`, `deviation_law`, `tachogram`; `encoder` with `encoder_errors`, `counts` of a real one. Form:
`profile`, `part_profile`, `measured_profile`, `tip_path`, tabulated by `profile_table`. Disturbances: `noise`,
`vibration`, `allowance`, `example_002`. `table`: CSV files; `checks` of arrays.
"""

__all__ = ["deviation_law", "part_profile", "speed"]
