# SPDX-License-Identifier: Apache-2.0
"""Grounds against the best cell of a sweep: it lies at the end of an axis, or cells beside it are worse in other ways.

An optimum at the end of an axis is one of the range, not of the machine: a better value may lie beyond it. A stability
margin that is much smaller than those of the cells beside it, or a cell beside it without a result, means that the best
cell lies close to the limit of stability.
"""

from dataclasses import dataclass

import numpy as np

from lathe_explore.sweep.effects import Axis, Index
from lathe_explore.sweep.figures import said
from lathe_explore.sweep.page_data import PageData
from lathe_explore.sweep.row import DONE

_END = 0.05  # share of an axis, from each end, that counts as its end
_SMALL = 0.5  # margin of the best cell over the largest beside it, below which the margin is small
_OUTCOMES = 3  # cells without a result that are named


@dataclass(frozen=True)
class Surroundings:
    """Place of the best cell among the others.

    Attributes:
        sentences: ends of axes at which it lies, its stability margin and those beside it, failures beside it.
        sound: whether none of these speaks against it.
    """

    sentences: list[str]
    sound: bool


def surroundings(seen: PageData) -> Surroundings:
    """Return the place of the best cell; without a cell that has a goal value, no sentences."""
    if not seen.goal.order.size:
        return Surroundings([], sound=False)
    best = int(seen.goal.order[0])
    free = [axis for axis in seen.axes if not axis.tied and not axis.texts]
    beside = _beside(free, [axis for axis in seen.axes if axis.texts], best)
    ends = [end for axis in free if (end := _end(axis, best))]
    told = [f"The best cell lies at the end of {', '.join(ends)}: a better one may lie beyond."] if ends else []
    margin, small = _margin(seen, best, beside)
    statuses = seen.table.column("status").to_pylist()
    without = [f"cell {seen.cells[place]} ({statuses[place]})" for place in beside if statuses[place] != DONE]
    more = f" and {len(without) - _OUTCOMES} more" if len(without) > _OUTCOMES else ""
    failures = [f"Beside it without a result: {', '.join(without[:_OUTCOMES])}{more}."] if without else []
    return Surroundings([*told, *margin, *failures], sound=not (ends or small or without))


def _end(axis: Axis, best: int) -> str:
    """Return an axis with its value in the best cell, if this is at an end of the axis; else an empty text."""
    low, high = float(axis.distinct[0]), float(axis.distinct[-1])
    value = float(axis.values[best])
    low_, high_, value_ = np.log([low, high, value]) if axis.log else (low, high, value)
    share = (value_ - low_) / (high_ - low_)
    which = "smallest" if value == low else "largest" if value == high else ""
    if not which and _END < share < 1.0 - _END:
        return ""
    return f"{axis.name} ({said(value)}{f', the {which}' if which else f', of {said(low)} to {said(high)}'})"


def _beside(free: list[Axis], texts: list[Axis], best: int) -> Index:
    """Return the cells beside the best: one value further on one axis, or the nearest ones if there are none."""
    if not free:
        return np.empty(0, np.int64)
    same = np.all([axis.values == axis.values[best] for axis in texts], axis=0) if texts else True
    ranks = np.stack([np.searchsorted(axis.distinct, axis.values).astype(np.float64) for axis in free])
    steps = np.abs(ranks - ranks[:, [best]])
    found = np.flatnonzero((steps.sum(axis=0) == 1.0) & same)
    if found.size:
        return found
    share = steps / np.array([[max(axis.distinct.size - 1, 1)] for axis in free])
    distance = np.where(same & (np.arange(steps.shape[1]) != best), np.square(share).sum(axis=0), np.inf)
    nearest = np.argsort(distance, kind="stable")[: 2 * len(free)]
    return nearest[np.isfinite(distance[nearest])]


def _margin(seen: PageData, best: int, beside: Index) -> tuple[list[str], bool]:
    """Return a sentence about the stability margin of the best cell, if it has one, and whether it is small."""
    margins = next((goal.values for goal in seen.goals if goal.name == "margin"), None)
    if margins is None or not np.isfinite(margins[best]):
        return [], False
    others = margins[beside][np.isfinite(margins[beside])]
    told = f"Its stability margin is {said(float(margins[best]))}"
    if not others.size:
        return [f"{told}; no cell beside it has one to compare."], False
    low, high = said(float(others.min())), said(float(others.max()))
    return [f"{told}, beside {low if low == high else f'{low} to {high}'}."], margins[best] < _SMALL * others.max()
