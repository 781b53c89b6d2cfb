# SPDX-License-Identifier: Apache-2.0
"""Sweeps and tuning: many variations of a cell, computed by Dask, with one table row per cell.

`space` defines the cells, `row` the row of a cell, and `folder` the storage of the rows. `workers` computes the cells,
`sweep` combines these modules, and `tune` runs a search with them.
"""

__all__ = ["page"]

# Constants that the command line lists. They are here because the modules that use them take seconds to import.
NUMBERS = (
    "tool.max_error",
    "tool.rms_error",
    "tool.first_max_error",
    "tool.first_rms_error",
    "tool.in_tolerance_from",
    "margin",
    "drive_margin",
)  #: columns of a row that can be a goal of a tuning or a page
OF_LEARNING = ("margin", "drive_margin")  #: those of a cell that learns; the others need a tool
LOOP_FIGURES = (
    "max_error",
    "rms_error",
    "in_tolerance_from",
    "steady_error",
    "steady_deviation",
    "overshoot",
    "settling",
    "reversal_error",
    "saturated",
    "anti_windup",
    "diverges",
)  #: of a force or position controller
SAMPLERS = ("tpe", "cmaes", "nsga2")  #: of a tuning
BATCH = 8  #: trials that are asked for at a time
