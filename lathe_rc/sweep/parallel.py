# SPDX-License-Identifier: Apache-2.0
"""Parallel coordinates as a specification of Vega: a line for each cell, an axis for each parameter, brushes on all.

The axes lie one above the other, so that their names can be read on a narrow screen.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray

from lathe_rc.sweep.effects import Axis, Samples
from lathe_rc.sweep.figures import GOOD_TO_BAD, Goal, said
from lathe_rc.view.charts import Rows, Spec, number

_SCHEMA = "https://vega.github.io/schema/vega/v6.json"
_GAP = 74  # [px] from axis to axis
_SIDE = 26  # [px] beside the axes, for the labels at their ends
_TOP, _BOTTOM = 62, 26  # [px] above the first axis and below the last
_REACH = 13  # [px] above and below an axis where it can be brushed
_MOST, _BEST = 400, 50  # lines, and the best among them
_TICKS = 5
_DECADES = 2.5  # up to which a logarithmic axis has ticks between them


@dataclass(frozen=True, eq=False)
class Drawn:
    """The figure, and how many cells are in it.

    Attributes:
        spec: of Vega.
        lines: cells that are drawn.
        cells: that could be.
    """

    spec: Spec
    lines: int
    cells: int


def chosen(axes: Sequence[Axis], goal: Goal) -> tuple[NDArray[np.int64], int]:
    """Cells that are drawn, the best last, so that they lie on top; and how many could be.

    Where there are too many, these are the best ones, and the others by lot.
    """
    whole = np.all([np.isfinite(axis.values) for axis in axes], axis=0)
    order = goal.order
    order = order[whole[order]]
    if order.size <= _MOST:
        return order[::-1], order.size
    lot = np.random.default_rng(0).choice(order.size - _BEST, _MOST - _BEST, replace=False) + _BEST
    return order[np.concatenate([np.arange(_BEST), np.sort(lot)])][::-1], order.size


def _scaled(axis: Axis) -> tuple[Samples, float, float]:
    """Values as they lie on the axis, and its ends."""
    values = np.log10(axis.values) if axis.log else axis.values
    known = values[np.isfinite(values)]
    low, high = float(known.min()), float(known.max())
    if axis.texts:
        low, high = -0.5, len(axis.texts) - 0.5
    return values, low, high if high > low else low + 1.0


def _ticks(axis: Axis, low: float, high: float) -> list[tuple[float, str]]:
    """Places on the axis from 0 to 1, and their labels."""
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
    """The part of an axis that is brushed, from 0 to 1; null: all of it.

    The events are those of the view at the axis, not of a mark: a finger comes down without having moved over one.
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


def _axis(place: int, axis: Axis, ticks: int) -> list[Spec]:
    """The marks of an axis."""
    height, held = place * _GAP, f"brush_{place}"
    quiet: Spec = {"interactive": False}
    across = {"signal": "datum.u * width"}
    line = {"x": {"value": 0}, "x2": {"signal": "width"}, "y": {"value": height}}
    tick = {"x": across, "y": {"value": height - 4}, "y2": {"value": height + 4}}
    text = {"x": across, "y": {"value": height + 17}, "align": {"value": "center"}, "text": {"field": "t"}}
    text["limit"] = {"signal": f"(width + {2 * _SIDE}) / {max(ticks, 1)} - 4"}
    name = {"x": {"value": 4 - _SIDE}, "y": {"value": height - 17}, "text": {"value": axis.label}}
    band = {
        "x": {"signal": f"{held} ? min({held}[0], {held}[1]) * width : 0"},
        "x2": {"signal": f"{held} ? max({held}[0], {held}[1]) * width : 0"},
        "y": {"value": height - _REACH},
        "height": {"value": 2 * _REACH},
        "fill": {"value": "#888888"},
        "fillOpacity": {"value": 0.4},
    }
    hit = {
        "x": {"value": -_SIDE},
        "x2": {"signal": f"width + {_SIDE}"},
        "y": {"value": height - _REACH},
        "height": {"value": 2 * _REACH},
        "fill": {"value": "transparent"},
        "cursor": {"value": "ew-resize"},
    }
    data = {"from": {"data": f"ticks_{place}"}, **quiet}
    return [
        {"type": "rule", "style": "edge", **quiet, "encode": {"update": line}},
        {"type": "rule", "style": "edge", **data, "encode": {"update": tick}},
        *({"type": "text", "style": style, **data, "encode": {"update": text}} for style in ("halo", "guide-label")),
        *({"type": "text", "style": style, **quiet, "encode": {"update": name}} for style in ("halo", "guide-title")),
        {"type": "rect", **quiet, "encode": {"update": band}},
        {"type": "rect", "encode": {"update": hit}},
    ]


def parallel(axes: Sequence[Axis], goal: Goal, numbers: NDArray[np.int64]) -> Drawn:
    """Parallel coordinates of parameters and goals.

    Args:
        axes: from the first to the last.
        goal: colours the lines.
        numbers: of the cells, shape (n,).
    """
    cells, known = chosen(axes, goal)
    scaled = [_scaled(axis) for axis in axes]
    rows: Rows = []
    for cell in cells:
        row: dict[str, Any] = {"c": int(numbers[cell]), "g": number(float(goal.values[cell])), "v": []}
        for place, (axis, (values, low, high)) in enumerate(zip(axes, scaled, strict=True)):
            row[f"u{place}"] = number((float(values[cell]) - low) / (high - low))
            row["v"].append(axis.texts[int(axis.values[cell])] if axis.texts else said(float(axis.values[cell])))
        rows.append(row)
    ticks = [_ticks(axis, low, high) for axis, (_, low, high) in zip(axes, scaled, strict=True)]
    inside = " && ".join(f"(!brush_{place} || inrange(datum.u{place}, brush_{place}))" for place in range(len(axes)))
    points = " + 'L' + ".join(f"datum.u{place} * width + ',{place * _GAP}'" for place in range(len(axes)))
    opacity = number(min(0.8, max(0.3, 30.0 / max(len(rows), 1))))
    told = ", ".join(f"{json.dumps(axis.label)}: datum.v[{place}]" for place, axis in enumerate(axes))
    line = {
        "path": {"signal": f"'M' + {points}"},
        "stroke": {"scale": "colour", "field": "g"},
        "strokeWidth": {"value": 1.3},
        "strokeOpacity": {"signal": f"{inside} ? {opacity} : 0.03"},
        "tooltip": {"signal": f"{{'cell': datum.c, {told}}}"},
    }
    of = f"of {len(rows)} lines inside the brushes"
    count = {
        "x": {"value": 4 - _SIDE},
        "y": {"value": 20 - _TOP},
        "text": {"signal": f"(length(data('inside')) ? data('inside')[0].count : 0) + ' {of}'"},
    }
    return Drawn(
        {
            "$schema": _SCHEMA,
            "width": 640 - 2 * _SIDE,
            "height": (len(axes) - 1) * _GAP,
            "padding": {"left": _SIDE, "right": _SIDE, "top": _TOP, "bottom": _BOTTOM},
            "autosize": "none",
            "data": [
                {"name": "cells", "values": rows},
                {
                    "name": "inside",
                    "source": "cells",
                    "transform": [{"type": "filter", "expr": inside}, {"type": "aggregate"}],
                },
                *(
                    {"name": f"ticks_{place}", "values": [{"u": number(u), "t": text} for u, text in each]}
                    for place, each in enumerate(ticks)
                ),
            ],
            "signals": [_brush(place) for place in range(len(axes))],
            "scales": [
                {
                    "name": "colour",
                    **goal.scale,
                    "domain": {"data": "cells", "field": "g"},
                    "range": list(reversed(GOOD_TO_BAD) if goal.above else GOOD_TO_BAD),
                }
            ],
            "marks": [
                {"type": "path", "from": {"data": "cells"}, "encode": {"update": line}},
                *(
                    mark
                    for place, (axis, each) in enumerate(zip(axes, ticks, strict=True))
                    for mark in _axis(place, axis, len(each))
                ),
                {"type": "text", "style": "guide-label", "interactive": False, "encode": {"update": count}},
            ],
        },
        len(rows),
        known,
    )
