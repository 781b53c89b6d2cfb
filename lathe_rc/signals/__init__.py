# SPDX-License-Identifier: Apache-2.0
"""Signals of any cell. The modules in ``__all__`` are public; all others may change.

`speed` of the spindle and its `tachogram`; `noise`; `form_errors` of revolutions and `zones` of a part. Measured data:
`table`, `measurement_file` with `instrument_files`, and their `quantities`. Checks of arrays: `checks`.
"""

__all__ = ["speed"]
