# SPDX-License-Identifier: Apache-2.0
"""Input signals of the cell. The modules in ``__all__`` are public; all others may change.

Spindle: `speed`, `deviation_law`, `tachogram`; `encoder` with `encoder_errors`; `counts` of a real encoder. Form:
`profile`, `part_profile`, `measured_profile` and `tip_path`, tabulated by `profile_table`. Disturbances: `noise`,
`vibration`, `allowance` and `example_002`. CSV files: `table`. Checks of arrays: `checks`.
"""

__all__ = ["deviation_law", "part_profile", "speed"]
