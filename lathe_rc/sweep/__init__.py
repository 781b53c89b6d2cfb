# SPDX-License-Identifier: Apache-2.0
"""Sweeps and tuning: many variations of a cell, computed by Dask, one row of a table each.

`space` says which cells, `row` what is kept of one, `folder` where the rows are, `workers` who computes them, `sweep`
puts them together; `tune` searches with them.
"""

__all__ = ["page"]
