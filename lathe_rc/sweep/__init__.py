# SPDX-License-Identifier: Apache-2.0
"""Sweeps and tuning: many variations of a cell, computed by Dask, one row of a table each.

`space` says which cells, `row` what is kept of one, `folder` where the rows are, `workers` computes them, `sweep`
puts them together; `tune` searches with them.
"""

__all__ = ["page"]

# Names and numbers that the command line lists, here because the modules behind them take seconds to import.
NUMBERS = (
    "tool.max_error",
    "tool.rms_error",
    "tool.first_max_error",
    "tool.first_rms_error",
    "tool.in_tolerance_from",
    "margin",
)  #: columns of a row that goals and pages can be made of
STATISTICS = ("max", "rms", "mean", "peak_to_valley")  #: of a signal in the last revolution
SAMPLERS = ("tpe", "cmaes", "nsga2")  #: of a tuning
BATCH = 8  #: trials that are asked for at once
