# SPDX-License-Identifier: Apache-2.0
"""Signals of the machine. The modules in ``__all__`` are public; all others may change.

Spindle: `deviation_law`; `encoder` with `encoder_errors`; `counts` of a real encoder, with `edge_time`. Form:
`profile`, `part_profile`, `measured_profile` and `tip_path`, tabulated by `profile_table`. Disturbances: `vibration`,
`allowance`, `error_motion` and `example_002`.
"""

__all__ = ["deviation_law", "part_profile"]
