# SPDX-License-Identifier: Apache-2.0
"""The figures of a sweep as specifications of Vega-Lite, and the data sets that they share.

Data sets: ``pair-I-J`` (I < J) has a row for each pair of bins of two axes, ``one-I`` for each bin of one, ``bins-I``
says where the bins are. In the rows, a and b are bins; n cells of which d have a goal; m, s and l are the median, the
smallest and the largest goal, p and q its 5 and 95 % points.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lathe_rc.sweep.effects import Axis, Bins, Effect, Index, Samples, Yield, is_wide

Spec = dict[str, Any]
Rows = list[dict[str, Any]]

SCHEMA = "https://vega.github.io/schema/vega-lite/v6.json"
FIT = {"type": "fit-x", "contains": "padding"}
GOOD_TO_BAD = ("#2f7fd0", "#9460b4", "#cf5a3c", "#d99a1b")  #: seen on white and on black
_MAP = "viridis"
_LINE = "#2f8fae"
_MARKS = ("#2f7fd0", "#9460b4", "#cf5a3c")
_TALL, _FLAT = 360, 300  # [px]
_BAR = 46  # [px] a parameter
_DIGITS = 5  # of the numbers that a page carries
_POINTS = 400  # of a yield curve
_SHARES = (0.95, 0.99)
_AXIS = {"tickCount": 5, "grid": False, "format": "~r"}  # of a parameter
_SHOWN = {"m": "median", "s": "smallest", "l": "largest"}


@dataclass(frozen=True, eq=False)
class Goal:
    """A goal by which the cells are judged.

    Attributes:
        name: of its column.
        label: with the unit.
        unit: of the values; empty: none.
        values: of the cells, shape (n,); NaN where there is none.
        above: it is to be large, not small.
    """

    name: str
    label: str
    unit: str
    values: Samples
    above: bool = False

    @property
    def log(self) -> bool:
        """Whether its axes are logarithmic."""
        return is_wide(self.values)

    @property
    def scale(self) -> Spec:
        """Of an axis."""
        return scale(log=self.log)

    @property
    def order(self) -> NDArray[np.int64]:
        """Cells that have a goal, the best first; equal ones as they were asked for."""
        known = np.flatnonzero(np.isfinite(self.values))
        return known[np.argsort(-self.values[known] if self.above else self.values[known], kind="stable")]


def scale(*, log: bool) -> Spec:
    """Of an axis or of colours, from the smallest to the largest value."""
    return {"type": "log", "nice": False} if log else {"type": "linear", "nice": False, "zero": False}


def number(value: float) -> float | None:
    """As it goes into a page: short, and None for what is none."""
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None


def said(value: float) -> str:
    """A number for people."""
    return f"{value:.4g}"


def effect_said(effect: Effect) -> tuple[str, str]:
    """Share and rank correlation for people, without the sign of what is rounded to 0; empty: there is none."""
    share = "" if effect.share is None else f"{round(effect.share, 3) + 0.0:.3f}"
    return share, "" if effect.rank is None else f"{round(effect.rank, 2) + 0.0:+.2f}"


def _grouped(group: Index, count: int, goal: Samples) -> dict[str, Samples]:
    """The results of the cells of each group, by column."""
    inside = group >= 0
    known = inside & np.isfinite(goal)
    done = np.bincount(group[known], minlength=count)
    ordered = goal[known][np.lexsort((goal[known], group[known]))]
    first = np.cumsum(done) - done
    found = {"n": np.bincount(group[inside], minlength=count).astype(np.float64), "d": done.astype(np.float64)}
    for name, quantile in (("m", 0.5), ("s", 0.0), ("l", 1.0), ("p", 0.05), ("q", 0.95)):
        place = first + quantile * np.maximum(done - 1, 0)
        low = np.minimum(np.floor(place).astype(np.int64), max(ordered.size - 1, 0))
        high = np.minimum(np.ceil(place).astype(np.int64), max(ordered.size - 1, 0))
        if ordered.size:
            value = ordered[low] + (place - low) * (ordered[high] - ordered[low])
        else:
            value = np.full(count, np.nan)
        found[name] = np.where(done > 0, value, np.nan)
    return found


def _rows(columns: Mapping[str, Samples], kept: NDArray[np.bool_]) -> Rows:
    places = np.flatnonzero(kept)
    whole = ("a", "b", "n", "d")
    return [
        {name: int(column[place]) if name in whole else number(column[place]) for name, column in columns.items()}
        for place in places
    ]


def pair(first: Bins, second: Bins, goal: Samples) -> Rows:
    """The data set of two axes."""
    group = np.where((first.index < 0) | (second.index < 0), -1, first.index * second.count + second.index)
    found = _grouped(group, first.count * second.count, goal)
    place = np.arange(first.count * second.count)
    a, b = (place // second.count).astype(np.float64), (place % second.count).astype(np.float64)
    columns = {"a": a, "b": b, **{name: found[name] for name in ("n", "d", *_SHOWN)}}
    return _rows(columns, found["n"] > 0)


def one(place: Bins, goal: Samples) -> Rows:
    """The data set of one axis."""
    found = _grouped(place.index, place.count, goal)
    return _rows({"a": np.arange(place.count, dtype=np.float64), **found}, found["n"] > 0)


def places(axis: Axis, found: Bins) -> Rows:
    """Where the bins of an axis are, and what they are called."""
    rows: Rows = []
    for place, (low, mid, high) in enumerate(zip(found.low, found.mid, found.high, strict=True)):
        if axis.texts:
            rows.append({"i": place, "t": axis.texts[place]})
            continue
        single = found.count == axis.distinct.size
        told = said(mid) if single else f"{said(low)} to {said(high)}"
        rows.append({"i": place, "t": told, "x": number(mid), "x0": number(low), "x1": number(high)})
    return rows


def _looked_up(bin_: str, place: int, axis: Axis, prefix: str) -> Spec:
    fields = ["t"] if axis.texts else ["t", "x", "x0", "x1"]
    source = {"data": {"name": f"bins-{place}"}, "key": "i", "fields": fields}
    return {"lookup": bin_, "from": source, "as": [f"{prefix}{field}" for field in fields]}


def _domain(axis: Axis, found: Bins) -> Spec:
    ends = [number(float(found.low[0])), number(float(found.high[-1]))]
    return {**scale(log=axis.log), "domain": ends}


def _span(channel: str, axis: Axis, found: Bins, prefix: str) -> Spec:
    """Encoding of a bin from its low to its high end."""
    if axis.texts:
        return {channel: _named(axis, prefix)}
    ends = {"field": f"{prefix}x0", "type": "quantitative", "title": axis.label, "scale": _domain(axis, found)}
    return {channel: {**ends, "axis": _AXIS}, f"{channel}2": {"field": f"{prefix}x1"}}


def _named(axis: Axis, prefix: str) -> Spec:
    return {"field": f"{prefix}t", "type": "nominal", "title": axis.label, "sort": list(axis.texts)}


def _shown(what: str) -> Spec:
    choice = {"input": "select", "options": list(_SHOWN), "labels": list(_SHOWN.values()), "name": f"{what} "}
    return {"name": "shown", "value": "m", "bind": choice}


def _tip(pairs: Sequence[tuple[str, str, str]]) -> Rows:
    return [
        {"field": field, "type": kind, "title": title, **({"format": ".4~g"} if field == "v" else {})}
        for field, kind, title in pairs
    ]


def heat_map(axes: Sequence[tuple[Axis, Bins]], across: int, up: int, goal: Goal) -> Spec:
    """The goal over two parameters; grey where cells have none."""
    (x, x_bins), (y, y_bins) = axes[across], axes[up]
    low, high = sorted((across, up))
    bin_of = {low: "a", high: "b"}
    counts = [("n", "quantitative", "cells"), ("d", "quantitative", "with a result")]
    tip = _tip([("v", "quantitative", goal.label), ("xt", "nominal", x.label), ("yt", "nominal", y.label), *counts])
    where = {**_span("x", x, x_bins, "x"), **_span("y", y, y_bins, "y"), "tooltip": tip}
    legend = {"orient": "top", "direction": "horizontal", "gradientLength": 220, "titleLimit": 320, "format": "~r"}
    colour = {"field": "v", "type": "quantitative", "title": goal.label, "legend": legend}
    colour["scale"] = {**goal.scale, "scheme": _MAP, "reverse": goal.above}
    return {
        "$schema": SCHEMA,
        "width": 640,
        "height": _TALL,
        "autosize": FIT,
        "data": {"name": f"pair-{low}-{high}"},
        "params": [_shown("of the cells of a field:")],
        "transform": [
            _looked_up(bin_of[across], across, x, "x"),
            _looked_up(bin_of[up], up, y, "y"),
            {"calculate": "datum[shown]", "as": "v"},
        ],
        "layer": [
            {"transform": [{"filter": "datum.d == 0"}], "mark": {"type": "rect", "color": "#8886"}, "encoding": where},
            {"transform": [{"filter": "datum.d > 0"}], "mark": "rect", "encoding": {**where, "color": colour}},
        ],
    }


def lines(axes: Sequence[tuple[Axis, Bins]], across: int, third: int | None, goal: Goal) -> Spec:
    """The goal over one parameter: a line for each value of another one, or the median with a band."""
    x, x_bins = axes[across]
    place: Spec = {"field": "xx", "type": "quantitative", "title": x.label, "scale": _domain(x, x_bins)}
    place["axis"] = _AXIS
    place = _named(x, "x") if x.texts else place
    common: Spec = {"$schema": SCHEMA, "width": 640, "height": _FLAT, "autosize": FIT}
    up = {"type": "quantitative", "title": goal.label, "scale": goal.scale, "axis": {"format": "~r", "tickCount": 6}}
    tip = [("v", "quantitative", goal.label), ("xt", "nominal", x.label)]
    tip += [("n", "quantitative", "cells"), ("d", "quantitative", "with a result")]
    if third is None:
        found = _looked_up("a", across, x, "x")
        band = {"x": place, "y": {**up, "field": "p"}, "y2": {"field": "q"}}
        return common | {
            "data": {"name": f"one-{across}"},
            "transform": [found, {"filter": "datum.d > 0"}, {"calculate": "datum.m", "as": "v"}],
            "layer": [
                {"mark": {"type": "errorbar" if x.texts else "area", "color": _LINE, "opacity": 0.3}, "encoding": band},
                {
                    "mark": {"type": "line", "color": _LINE, "point": {"color": _LINE}},
                    "encoding": {"x": place, "y": {**up, "field": "v"}, "tooltip": _tip(tip)},
                },
            ],
        }
    z, _ = axes[third]
    low, high = sorted((across, third))
    bin_of = {low: "a", high: "b"}
    legend = {"orient": "top", "direction": "horizontal", "titleLimit": 320, "gradientLength": 220, "format": "~r"}
    colour: Spec = {"title": z.label, "legend": legend}
    if z.texts:
        del legend["format"]
        legend["columns"] = 3
        colour |= {"field": "zt", "type": "nominal", "sort": list(z.texts), "scale": {"scheme": "tableau10"}}
    else:
        colour |= {"field": "zx", "type": "quantitative", "scale": {**scale(log=z.log), "range": list(GOOD_TO_BAD)}}
    return common | {
        "data": {"name": f"pair-{low}-{high}"},
        "params": [_shown("of the cells of a point:")],
        "transform": [
            _looked_up(bin_of[across], across, x, "x"),
            _looked_up(bin_of[third], third, z, "z"),
            {"calculate": "datum[shown]", "as": "v"},
            {"filter": "datum.d > 0"},
        ],
        "mark": {"type": "line", "point": {"size": 18}, "strokeWidth": 1.6},
        "encoding": {
            "x": place,
            "y": {**up, "field": "v"},
            "color": colour,
            "detail": {"field": "zt"},
            "tooltip": _tip([*tip, ("zt", "nominal", z.label)]),
        },
    }


def sensitivity(names: Sequence[str], effects: Sequence[Effect]) -> Spec:
    """Bars: what each parameter explains of the goal's variance."""
    rows: Rows = []
    for name, effect in zip(names, effects, strict=True):
        share, rank = effect_said(effect)
        told = f"{share or 'none'}, rank {rank}" if rank else share or "none"
        rows.append({"p": name, "s": number(effect.share or 0.0), "t": f"{name}: {told}"})
    left = min(0.0, *(row["s"] for row in rows))
    across: Spec = {"field": "s", "type": "quantitative", "title": "share of the goal's variance (first order)"}
    across |= {"scale": {"domain": [left, max(1.0, *(row["s"] for row in rows))], "nice": False}}
    up = {"field": "p", "type": "nominal", "sort": None, "axis": None}
    return {
        "$schema": SCHEMA,
        "width": 640,
        "height": _BAR * len(rows),
        "autosize": FIT,
        "data": {"values": rows},
        "encoding": {"y": up},
        "layer": [
            {"mark": {"type": "bar", "color": _LINE, "height": 12, "yOffset": 10}, "encoding": {"x": across}},
            {
                "mark": {"type": "text", "align": "left", "yOffset": -8},
                "encoding": {"x": {"value": 2}, "text": {"field": "t"}},
            },
        ],
    }


def cumulative(found: Yield, goal: Goal, tolerance: float | None) -> Spec:
    """Share of all cells whose goal keeps to a limit, with the points that 95 and 99 % keep to."""
    limits, shares = found.curve(_POINTS)
    rows = [{"x": number(limit), "y": number(share)} for limit, share in zip(limits, shares, strict=True)]
    unit = f" {goal.unit}" if goal.unit else ""
    marks: Rows = []
    for share, level in zip(_SHARES, (0.32, 0.2), strict=True):
        if (limit := found.point(share)) is not None:
            marks.append({"x": number(limit), "y": level, "t": f"{share:.0%}: {said(limit)}{unit}"})
    if tolerance is not None:
        told = f"tolerance {said(tolerance)}{unit}: {found.share(tolerance):.2%}"
        marks.append({"x": number(tolerance), "y": 0.08, "t": told})
    for mark, tint in zip(marks, _MARKS, strict=False):
        mark["c"] = tint
    known = [row["x"] for row in [*rows, *marks] if row["x"] is not None and (row["x"] > 0.0 or not goal.log)]
    middle = math.sqrt(min(known) * max(known)) if goal.log else (min(known) + max(known)) / 2.0
    across: Spec = {"field": "x", "type": "quantitative", "axis": {"tickCount": 6, "format": "~r"}}
    across["title"] = f"{'at least' if goal.above else 'at most'}: {goal.label}"
    across["scale"] = {**goal.scale, "domain": [min(known), max(known)]}
    up = {"field": "y", "type": "quantitative", "title": "share of all cells", "axis": {"format": ".0%"}}
    up["scale"] = {"domain": [0, 1]}
    tip = [
        {"field": "x", "type": "quantitative", "title": goal.label, "format": ".4~g"},
        {"field": "y", "type": "quantitative", "title": "share", "format": ".2%"},
    ]
    step = "step-before" if goal.above else "step-after"
    colour = {"field": "c", "type": "nominal", "scale": None}
    texts = [
        {
            "transform": [{"filter": f"datum.x {side} {middle}"}],
            "mark": {"type": "text", "align": align, "dx": dx},
            "encoding": {"x": across, "y": up, "text": {"field": "t"}, "color": colour},
        }
        for side, align, dx in (("<", "left", 5), (">=", "right", -5))
    ]
    marked = {"color": colour, "x": across}
    layer: Rows = [
        {"mark": {"type": "line", "interpolate": step, "color": _LINE}, "encoding": {"x": across, "y": up}},
        {"mark": {"type": "point", "opacity": 0, "size": 60}, "encoding": {"x": across, "y": up, "tooltip": tip}},
    ]
    if marks:
        rule = {"mark": {"type": "rule", "strokeDash": [4, 3]}, "encoding": marked}
        layer.append({"data": {"values": marks}, "layer": [rule, *texts]})
    return {
        "$schema": SCHEMA,
        "width": 640,
        "height": _FLAT,
        "autosize": FIT,
        "data": {"values": rows},
        "layer": layer,
    }
