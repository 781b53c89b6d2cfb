# SPDX-License-Identifier: Apache-2.0
"""Angle of an encoder between two counts, from the time of its last edge.

A time stamp s of the last edge is rounded down to the clock Δ, so that the edge was passed between s and s + Δ. At a
time t the spindle has then turned, since the edge, by at least

    r·(t - s - Δ)  counts,   from 0 to below 1,

and by at most r·Δ more. The rate r [counts/s] is that between the last two edges read. A counter that is read m times a
sample is the same encoder with Δ = sample/m, since an edge lies between two readings.
"""

from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.jit import inlined

STAMP, COUNT, RATE = range(3)  #: indices of `EdgeTable.last`
_BELOW = 1.0 - 1e-6  # largest part of a count since its edge: the angle does not reach the next count before its edge


class EdgeTable(NamedTuple):
    """Edges of an encoder for kernels.

    Attributes:
        clock: resolution Δ of the time stamps [s]; 0: there are none.
        last: time stamp [s] and count of the last edge, and the rate [counts/s], shape (3,).
    """

    clock: float
    last: Array


def edge_table(clock: float, stamp: float, count: float, rate: float) -> EdgeTable:
    """Create a table from the resolution of the time stamps and the last edge before the first reading."""
    return EdgeTable(clock, np.array([stamp, count, rate]))


@inlined
def pass_edge(edges: EdgeTable, stamp: float, count: float) -> None:
    """Store the edge of a count above the last one, with its time stamp [s]."""
    last = edges.last
    if stamp > last[STAMP]:  # two edges within a tick have no rate
        last[RATE] = (count - last[COUNT]) / (stamp - last[STAMP])
    last[STAMP], last[COUNT] = stamp, count


@inlined
def passed(edges: EdgeTable, time: float) -> float:
    """Return the least part of a count passed from the last edge to a time [s], from 0 to below 1."""
    last = edges.last
    return float(min(max(last[RATE] * (time - last[STAMP] - edges.clock), 0.0), _BELOW))
