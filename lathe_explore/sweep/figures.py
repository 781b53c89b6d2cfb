# SPDX-License-Identifier: Apache-2.0
"""Figures of a sweep as Vega-Lite specifications, and their shared data sets.

Data sets: ``pair-I-J`` (I < J) has one row per pair of bins of two axes, ``one-I`` one row per bin of one axis, and
``bins-I`` the positions of the bins. In the rows, a and b are bin indices; n is the number of cells, and d the number
of cells with a goal value; m, s and l are the median, the smallest and the largest goal, and p and q its 5 and 95 %
quantiles.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lathe_explore.sweep.effects import Axis, Bins, Effect, Index, Samples, Yield, is_wide
from lathe_rc.drawing.charts import Rows, Spec, axis_scale, chart, number, quantity, rows, tip

GOOD_TO_BAD = ("#2f7fd0", "#9460b4", "#cf5a3c", "#d99a1b")  #: visible on white and on black
_LINE = "#2f8fae"
_MARKS = ("#2f7fd0", "#9460b4", "#cf5a3c")
_TALL, _FLAT = 360, 300  # [px]
_BAR = 46  # [px] per parameter
_POINTS = 400  # points of a yield curve
_SHARES = (0.95, 0.99)
_AXIS = {"tickCount": 5, "grid": False, "format": "~r"}  # axis of a parameter
_LEGEND: Spec = {"orient": "top", "direction": "horizontal", "gradientLength": 220, "titleLimit": 320}
_STATISTICS = {"m": "median", "s": "smallest", "l": "largest"}


@dataclass(frozen=True, eq=False)
class Goal:
    """Goal by which cells are ranked.

    Attributes:
        name: name of the column.
        label: name with the unit.
        unit: unit of the values; empty if there is none.
        values: goal values of the cells, shape (n,); NaN where there is none.
        above: whether large values are better than small ones.
    """

    name: str
    label: str
    unit: str
    values: Samples
    above: bool = False

    @property
    def log(self) -> bool:
        """Whether the axes of the goal are logarithmic."""
        return is_wide(self.values)

    @property
    def scale(self) -> Spec:
        """Vega-Lite scale of the goal's axis."""
        return axis_scale(log=self.log)

    @property
    def order(self) -> NDArray[np.int64]:
        """Indices of the cells with a goal value, best first; ties in cell order."""
        known = np.flatnonzero(np.isfinite(self.values))
        return known[np.argsort(-self.values[known] if self.above else self.values[known], kind="stable")]

    def told(self, value: float) -> str:
        """Format a value with its unit."""
        return f"{said(value)} {self.unit}".rstrip()


def said(value: float) -> str:
    """Format a number with four significant digits."""
    return f"{value:.4g}"


def effect_said(effect: Effect) -> tuple[str, str, str]:
    """Format the total effect, the share and the rank correlation of an effect; empty strings for missing values."""
    # Adding 0.0 turns -0.0 into 0.0: a value that rounds to 0 is shown without a sign.
    share = "" if effect.share is None else f"{round(effect.share, 3) + 0.0:.3f}"
    total = "" if effect.total is None else f"{round(effect.total, 3) + 0.0:.3f}"
    total += f" ± {effect.error:.3f}" if total and effect.error else ""
    return total, share, "" if effect.rank is None else f"{round(effect.rank, 2) + 0.0:+.2f}"


# --- data sets


def _grouped(group: Index, count: int, goal: Samples, quantiles: str, **bins: Index) -> Rows:
    """Return statistics of the goal in each group of cells; empty groups are omitted."""
    known = (group >= 0) & np.isfinite(goal)
    cells, done = (np.bincount(group[some], minlength=count) for some in (group >= 0, known))
    # One sort by group and goal gives all quantiles: group k has the places first[k] to first[k] + done[k] - 1.
    ordered = goal[known][np.lexsort((goal[known], group[known]))]
    ordered = ordered if ordered.size else np.array([np.nan])
    first = np.cumsum(done) - done
    found = {**bins, "n": cells, "d": done}
    for name, quantile in zip("mslpq", (0.5, 0.0, 1.0, 0.05, 0.95), strict=True):
        if name in quantiles:
            place = first + quantile * np.maximum(done - 1, 0)
            low, high = (np.minimum(end(place).astype(int), ordered.size - 1) for end in (np.floor, np.ceil))
            value = ordered[low] + (place - low) * (ordered[high] - ordered[low])
            found[name] = np.where(done > 0, value, np.nan)
    return rows(**{name: column[cells > 0] for name, column in found.items()})


def pair(first: Bins, second: Bins, goal: Samples) -> Rows:
    """Return the data set of a pair of axes: statistics of the goal in each pair of bins."""
    group = np.where((first.index < 0) | (second.index < 0), -1, first.index * second.count + second.index)
    a, b = np.divmod(np.arange(first.count * second.count), second.count)
    return _grouped(group, a.size, goal, "msl", a=a, b=b)


def one(place: Bins, goal: Samples) -> Rows:
    """Return the data set of one axis: statistics of the goal in each bin."""
    return _grouped(place.index, place.count, goal, "mslpq", a=np.arange(place.count))


def places(axis: Axis, found: Bins) -> Rows:
    """Return the positions and names of an axis's bins."""
    index = np.arange(found.count)
    if axis.texts:
        return rows(i=index, t=list(axis.texts[: found.count]))
    if found.count == axis.distinct.size:
        names = [said(middle) for middle in found.mid]
    else:
        names = [f"{said(low)} to {said(high)}" for low, high in zip(found.low, found.high, strict=True)]
    return rows(i=index, t=names, x=found.mid, x0=found.low, x1=found.high)


# --- maps and lines


def _looked_up(place: int, axis: Axis, prefix: str, others: Sequence[int] = ()) -> Spec:
    """Return the Vega-Lite transform that looks up the bin positions of an axis.

    A data set of two axes lists their bins in the order of the axes: this axis's bin is ``a``, or ``b`` if one of the
    ``others`` precedes the axis.
    """
    fields = ["t"] if axis.texts else ["t", "x", "x0", "x1"]
    source = {"data": {"name": f"bins-{place}"}, "key": "i", "fields": fields}
    bin_ = "a" if all(place < other for other in others) else "b"
    return {"lookup": bin_, "from": source, "as": [f"{prefix}{field}" for field in fields]}


def _named(axis: Axis, prefix: str) -> Spec:
    return {"field": f"{prefix}t", "type": "nominal", "title": axis.label, "sort": list(axis.texts)}


def _along(axis: Axis, found: Bins, field: str) -> Spec:
    """Return the encoding of a numeric field on an axis from the first to the last bin."""
    ends = [float(found.low[0]), float(found.high[-1])]
    return quantity(field, axis.label, scale=axis_scale(log=axis.log, ends=ends), axis=_AXIS)


def _span(channel: str, axis: Axis, found: Bins) -> Spec:
    """Return the encoding of a bin from its lower to its upper end."""
    if axis.texts:
        return {channel: _named(axis, channel)}
    return {channel: _along(axis, found, f"{channel}x0"), f"{channel}2": {"field": f"{channel}x1"}}


def _tip(goal: Goal, **names: Axis) -> Rows:
    nominal = [{"field": field, "type": "nominal", "title": axis.label} for field, axis in names.items()]
    return [*tip(v=goal.label), *nominal, quantity("n", "cells"), quantity("d", "with a result")]


def _choice(what: str) -> Spec:
    """Return the control for selecting a statistic of several cells."""
    choice = {"input": "select", "options": list(_STATISTICS), "labels": list(_STATISTICS.values()), "name": f"{what} "}
    return {"name": "shown", "value": "m", "bind": choice}


_CHOSEN = {"calculate": "datum[shown]", "as": "v"}


def heat_map(axes: Sequence[tuple[Axis, Bins]], across: int, up: int, goal: Goal) -> Spec:
    """Return the heat map of the goal over two parameters; bins without a goal value are grey."""
    (x, x_bins), (y, y_bins) = axes[across], axes[up]
    where = {**_span("x", x, x_bins), **_span("y", y, y_bins), "tooltip": _tip(goal, xt=x, yt=y)}
    scale = {**goal.scale, "scheme": "viridis", "reverse": goal.above}
    colour = quantity("v", goal.label, legend={**_LEGEND, "format": "~r"}, scale=scale)
    return chart(
        _TALL,
        data={"name": f"pair-{min(across, up)}-{max(across, up)}"},
        params=[_choice("of the cells of a field:")],
        transform=[_looked_up(across, x, "x", [up]), _looked_up(up, y, "y", [across]), _CHOSEN],
        layer=[
            {"transform": [{"filter": "datum.d == 0"}], "mark": {"type": "rect", "color": "#8886"}, "encoding": where},
            {"transform": [{"filter": "datum.d > 0"}], "mark": "rect", "encoding": {**where, "color": colour}},
        ],
    )


def lines(axes: Sequence[tuple[Axis, Bins]], across: int, third: int | None, goal: Goal) -> Spec:
    """Return the line plot of the goal over one parameter.

    The plot has one line per value of a second parameter; without a second parameter, it shows the median with a band.
    """
    x, x_bins = axes[across]
    place = _named(x, "x") if x.texts else _along(x, x_bins, "xx")
    known = {"filter": "datum.d > 0"}

    def up(field: str) -> Spec:
        return quantity(field, goal.label, scale=goal.scale, axis={"format": "~r", "tickCount": 6})

    if third is None:
        band = {"x": place, "y": up("p"), "y2": {"field": "q"}}
        middle = {"x": place, "y": up("v"), "tooltip": _tip(goal, xt=x)}
        kind = "errorbar" if x.texts else "area"
        return chart(
            _FLAT,
            data={"name": f"one-{across}"},
            transform=[_looked_up(across, x, "x"), known, {"calculate": "datum.m", "as": "v"}],
            layer=[
                {"mark": {"type": kind, "color": _LINE, "opacity": 0.3}, "encoding": band},
                {"mark": {"type": "line", "color": _LINE, "point": {"color": _LINE}}, "encoding": middle},
            ],
        )
    z, _ = axes[third]
    if z.texts:
        colour = {**_named(z, "z"), "legend": {**_LEGEND, "columns": 3}, "scale": {"scheme": "tableau10"}}
    else:
        scale = {**axis_scale(log=z.log), "range": list(GOOD_TO_BAD)}
        colour = quantity("zx", z.label, legend={**_LEGEND, "format": "~r"}, scale=scale)
    return chart(
        _FLAT,
        data={"name": f"pair-{min(across, third)}-{max(across, third)}"},
        params=[_choice("of the cells of a point:")],
        transform=[_looked_up(across, x, "x", [third]), _looked_up(third, z, "z", [across]), _CHOSEN, known],
        mark={"type": "line", "point": {"size": 18}, "strokeWidth": 1.6},
        encoding={
            "x": place,
            "y": up("v"),
            "color": colour,
            "detail": {"field": "zt"},
            "tooltip": _tip(goal, xt=x, zt=z),
        },
    )


# --- bars and curves


def sensitivity(names: Sequence[str], effects: Sequence[Effect]) -> Spec:
    """Return the bar chart of the total effects, or without these of the shares that parameters explain alone."""
    texts, is_total = [], any(effect.total is not None for effect in effects)
    for name, effect in zip(names, effects, strict=True):
        total, share, rank = effect_said(effect)
        texts.append(f"{name}: {(total if is_total else share) or 'none'}" + (f", rank {rank}" if rank else ""))
    shares = [(effect.total if is_total else effect.share) or 0.0 for effect in effects]
    scale = {"domain": [min(0.0, *shares), max(1.0, *shares)], "nice": False}
    across = quantity(
        "s", f"share of the goal's variance ({'total effect' if is_total else 'first order'})", scale=scale
    )
    text = {"x": {"value": 2}, "text": {"field": "t"}}
    return chart(
        _BAR * len(texts),
        data={"values": rows(p=list(names), s=shares, t=texts)},
        encoding={"y": {"field": "p", "type": "nominal", "sort": None, "axis": None}},
        layer=[
            {"mark": {"type": "bar", "color": _LINE, "height": 12, "yOffset": 10}, "encoding": {"x": across}},
            {"mark": {"type": "text", "align": "left", "yOffset": -8}, "encoding": text},
        ],
    )


def cumulative(found: Yield, goal: Goal, tolerance: float | None) -> Spec:
    """Return the cumulative curve of the cells within a limit, and the limits that 95 and 99 % of the cells meet."""
    limits, shares = found.curve(_POINTS)
    points = [(found.point(share), f"{share:.0%}", level) for share, level in zip(_SHARES, (0.32, 0.2), strict=True)]
    marks = [(limit, level, f"{name}: {goal.told(limit)}") for limit, name, level in points if limit is not None]
    if tolerance is not None:
        marks.append((tolerance, 0.08, f"tolerance {goal.told(tolerance)}: {found.share(tolerance):.2%}"))
    marked: Rows = [
        {"x": number(x), "y": y, "t": text, "c": tint} for (x, y, text), tint in zip(marks, _MARKS, strict=False)
    ]
    known = [value for value in (*limits.tolist(), *(x for x, *_ in marks)) if value > 0.0 or not goal.log]
    low, high = min(known), max(known)
    middle = math.sqrt(low * high) if goal.log else (low + high) / 2.0
    title = f"{'at least' if goal.above else 'at most'}: {goal.label}"
    across = quantity(
        "x", title, scale=axis_scale(log=goal.log, ends=(low, high)), axis={"tickCount": 6, "format": "~r"}
    )
    up = quantity("y", "share of all cells", axis={"format": ".0%"}, scale={"domain": [0, 1]})
    colour = {"field": "c", "type": "nominal", "scale": None}

    def layer(encoding: Spec, kind: str, **mark: Any) -> Spec:
        return {"mark": {"type": kind, **mark}, "encoding": {"x": across, **encoding}}

    tooltip = [*tip(x=goal.label), quantity("y", "share", format=".2%")]
    layers: Rows = [
        layer({"y": up}, "line", interpolate="step-before" if goal.above else "step-after", color=_LINE),
        layer({"y": up, "tooltip": tooltip}, "point", opacity=0, size=60),
    ]
    if marked:
        texts = [
            {"transform": [{"filter": f"datum.x {side} {middle}"}]}
            | layer({"y": up, "text": {"field": "t"}, "color": colour}, "text", align=align, dx=dx)
            for side, align, dx in (("<", "left", 5), (">=", "right", -5))
        ]
        layers.append(
            {"data": {"values": marked}, "layer": [layer({"color": colour}, "rule", strokeDash=[4, 3]), *texts]}
        )
    return chart(_FLAT, data={"values": rows(x=limits, y=shares)}, layer=layers)
