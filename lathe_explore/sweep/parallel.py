# SPDX-License-Identifier: Apache-2.0
"""Parallel coordinates as a Vega specification: one line per cell, and one axis with a brush per parameter.

The axes are stacked vertically, so that their names are legible on a narrow screen.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray

from lathe_explore.sweep.effects import Axis, Samples
from lathe_explore.sweep.figures import GOOD_TO_BAD, Goal, said
from lathe_rc.drawing.charts import Column, Rows, Spec, number, rows

_GAP = 74  # [px] from axis to axis
_SIDE = 26  # [px] beside the axes, for the labels at their ends
_TOP, _BOTTOM = 62, 26  # [px] above the first axis and below the last
_REACH = 13  # [px] above and below an axis where a brush starts
_MOST, _BEST = 400, 50  # lines in total, and lines of the best cells
_TICKS = 5
_DECADES = 2.5  # length in decades up to which a logarithmic axis has ticks within its decades


@dataclass(frozen=True, eq=False)
class ParallelFigure:
    """Parallel-coordinates figure, and the number of cells in it.

    Attributes:
        spec: Vega specification.
        lines: number of plotted cells.
        cells: number of cells with a value on every axis.
    """

    spec: Spec
    lines: int
    cells: int


def chosen(axes: Sequence[Axis], goal: Goal) -> tuple[NDArray[np.int64], int]:
    """Return the indices of the cells to plot, best last and thus on top, and the number of plottable cells.

    If there are too many cells, the best ones and a random selection of the others are plotted.
    """
    whole = np.all([np.isfinite(axis.values) for axis in axes], axis=0)
    order = goal.order
    order = order[whole[order]]
    if order.size <= _MOST:
        return order[::-1], order.size
    # The seed is fixed so that the same rows give the same page.
    lot = np.random.default_rng(0).choice(order.size - _BEST, _MOST - _BEST, replace=False) + _BEST
    return order[np.concatenate([np.arange(_BEST), np.sort(lot)])][::-1], order.size


def _scaled(axis: Axis) -> tuple[Samples, float, float]:
    """Return the values in the scale of the axis, and the ends of the axis."""
    values = np.log10(axis.values) if axis.log else axis.values
    known = values[np.isfinite(values)]
    low, high = float(known.min()), float(known.max())
    if axis.texts:
        low, high = -0.5, len(axis.texts) - 0.5
    return values, low, high if high > low else low + 1.0


def _ticks(axis: Axis, low: float, high: float) -> list[tuple[float, str]]:
    """Return the ticks of an axis: positions from 0 to 1, and labels."""
    if axis.texts:
        return [((place - low) / (high - low), text) for place, text in enumerate(axis.texts)]
    few = axis.distinct
    if few.size > _TICKS:
        ends = (10.0**low, 10.0**high) if axis.log else (low, high)
        decades = high - low if axis.log else 0.0
        some = (1.0, 2.0, 5.0) if decades < _DECADES else (1.0,)
        locator = LogLocator(subs=some, numticks=2 * _TICKS) if decades > 1.0 else MaxNLocator(_TICKS)
        few = np.array([tick for tick in locator.tick_values(*ends) if ends[0] <= tick <= ends[1]])
    places = np.log10(few) if axis.log else few
    return [((float(place) - low) / (high - low), said(value)) for place, value in zip(places, few, strict=True)]


def _brush(place: int) -> Spec:
    """Return the Vega signal for the brushed interval of an axis, from 0 to 1; null for the entire axis.

    The signal uses events of the view near the axis, because a touch starts without a pointer movement over a mark.
    """
    at, held = "clamp(x() / width, 0, 1)", f"brush_{place}"
    near = [f"abs(y() - {place * _GAP}) <= {_REACH}"]
    down: Spec = {"source": "view", "type": "pointerdown", "filter": near}
    up: Spec = {"source": "window", "type": "pointerup"}
    move: Spec = {"source": "window", "type": "pointermove", "consume": True, "between": [down, up]}
    click: Spec = {"source": "view", "type": "click", "filter": near}
    return {
        "name": held,
        "value": None,
        "on": [
            {"events": down, "update": f"[{at}, {at}]"},
            {"events": move, "update": f"[{held}[0], {at}]"},
            {"events": click, "update": f"{held} && {held}[0] == {held}[1] ? null : {held}"},
        ],
    }


def _mark(kind: str, *, style: str = "", data: str = "", interactive: bool = False, **channels: object) -> Spec:
    """Return a Vega mark with the given channels.

    A string that begins with = is an expression, a mapping is passed on to Vega, and other values are constants.
    """
    encoded = {
        name: value
        if isinstance(value, dict)
        else {"signal": value[1:]}
        if isinstance(value, str) and value.startswith("=")
        else {"value": value}
        for name, value in channels.items()
    }
    found: Spec = {"type": kind, "interactive": interactive, "encode": {"update": encoded}}
    return found | ({"style": style} if style else {}) | ({"from": {"data": data}} if data else {})


def _axis(place: int, axis: Axis, ticks: int) -> list[Spec]:
    """Return the Vega marks of an axis."""
    height, held, data = place * _GAP, f"brush_{place}", f"ticks_{place}"
    across = "=datum.u * width"
    label: dict[str, Any] = {"x": across, "y": height + 17, "align": "center", "text": {"field": "t"}}
    label["limit"] = f"=(width + {2 * _SIDE}) / {max(ticks, 1)} - 4"
    name: dict[str, Any] = {"x": 4 - _SIDE, "y": height - 17, "text": {"value": axis.label}}
    reach: dict[str, Any] = {"y": height - _REACH, "height": 2 * _REACH}
    low, high = (f"={held} ? {end}({held}[0], {held}[1]) * width : 0" for end in ("min", "max"))
    return [
        _mark("rule", style="edge", x=0, x2="=width", y=height),
        _mark("rule", style="edge", data=data, x=across, y=height - 4, y2=height + 4),
        *(_mark("text", style=style, data=data, **label) for style in ("halo", "guide-label")),
        *(_mark("text", style=style, **name) for style in ("halo", "guide-title")),
        _mark("rect", x=low, x2=high, **reach, fill="#888888", fillOpacity=0.4),
        _mark(
            "rect", interactive=True, x=-_SIDE, x2=f"=width + {_SIDE}", **reach, fill="transparent", cursor="ew-resize"
        ),
    ]


def parallel(axes: Sequence[Axis], goal: Goal, numbers: NDArray[np.int64]) -> ParallelFigure:
    """Return the parallel coordinates of parameters and goals.

    Args:
        axes: axes from top to bottom.
        goal: goal that sets the colour of the lines.
        numbers: numbers of the cells, shape (n,).
    """
    cells, known = chosen(axes, goal)
    count = len(cells)
    columns: dict[str, Column] = {"c": numbers[cells], "g": goal.values[cells]}
    ticks: list[Rows] = []
    texts = []
    for place, axis in enumerate(axes):
        values, low, high = _scaled(axis)
        columns[f"u{place}"] = (values[cells] - low) / (high - low)
        texts.append([axis.texts[int(value)] if axis.texts else said(value) for value in axis.values[cells].tolist()])
        places, labels = zip(*_ticks(axis, low, high), strict=True)
        ticks.append(rows(u=np.array(places), t=list(labels)))
    lines = [{**row, "v": list(text)} for row, text in zip(rows(**columns), zip(*texts, strict=True), strict=True)]
    inside = " && ".join(f"(!brush_{place} || inrange(datum.u{place}, brush_{place}))" for place in range(len(axes)))
    points = " + 'L' + ".join(f"datum.u{place} * width + ',{place * _GAP}'" for place in range(len(axes)))
    opacity = number(min(0.8, max(0.3, 30.0 / max(count, 1))))
    told = ", ".join(f"{json.dumps(axis.label)}: datum.v[{place}]" for place, axis in enumerate(axes))
    colours = list(reversed(GOOD_TO_BAD) if goal.above else GOOD_TO_BAD)
    line = _mark(
        "path",
        data="cells",
        interactive=True,
        path=f"='M' + {points}",
        stroke={"scale": "colour", "field": "g"},
        strokeWidth=1.3,
        strokeOpacity=f"={inside} ? {opacity} : 0.03",
        tooltip=f"={{'cell': datum.c, {told}}}",
    )
    kept = f"=(length(data('inside')) ? data('inside')[0].count : 0) + ' of {count} lines inside the brushes'"
    spec = {
        "$schema": "https://vega.github.io/schema/vega/v6.json",
        "width": 640 - 2 * _SIDE,
        "height": (len(axes) - 1) * _GAP,
        "padding": {"left": _SIDE, "right": _SIDE, "top": _TOP, "bottom": _BOTTOM},
        "autosize": "none",
        "data": [
            {"name": "cells", "values": lines},
            {
                "name": "inside",
                "source": "cells",
                "transform": [{"type": "filter", "expr": inside}, {"type": "aggregate"}],
            },
            *({"name": f"ticks_{place}", "values": each} for place, each in enumerate(ticks)),
        ],
        "signals": [_brush(place) for place in range(len(axes))],
        "scales": [{"name": "colour", **goal.scale, "domain": {"data": "cells", "field": "g"}, "range": colours}],
        "marks": [
            line,
            *(mark for place, axis in enumerate(axes) for mark in _axis(place, axis, len(ticks[place]))),
            _mark("text", style="guide-label", x=4 - _SIDE, y=20 - _TOP, text=kept),
        ],
    }
    return ParallelFigure(spec, count, known)
