# SPDX-License-Identifier: Apache-2.0
"""Figures of a report as Vega-Lite specifications; they can be enlarged on screen."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lathe_rc.analysis.metrology import Lay
from lathe_rc.drawing.charts import Rows, Spec, axis_scale, chart, number, quantity, rows, tip
from lathe_rc.judge.loops import LoopResult
from lathe_rc.messages import Samples
from lathe_rc.view.report_form import FormByRevolution, Revolution
from lathe_rc.view.report_gather import Gathered
from lathe_rc.view.report_host import Host
from lathe_rc.view.report_series import Envelope

_FIELDS = 40_000  # total number of fields in all maps of a page
_ACROSS = 256  # fields of a map per revolution
_LINEAR = 8.0  # parameter of the symmetric logarithm: larger values give the remaining error more colours
_SQUARE = 460  # [px] size of the largest polar figure
_INSIDE = 1.2  # radius of the desired form in a polar figure, relative to the largest deviation
_POINTS = 720  # points of a polar figure
_OTHERS = 4  # largest number of controllers with plotted cycles
LAST, FIRST = 0, 1  #: indices of the page's colours
_BEST, _GREY, _COLOURS = 2, 5, 6  # further ones, and their number
_LONGEST_LABEL = 60  # characters
_LONGEST_LENGTH = 1e3  # largest drawn length [m]
_MOST_VALUE = 1e12  # largest value of other signals
_FLOOR = 1e-3  # smallest form error that a figure resolves [µm]
_ALMOST = 1e-9  # relative difference above which two numbers count as different

#: Dragging selects the range to enlarge.
BOX: Spec = {"name": "box", "select": {"type": "interval", "translate": False, "zoom": False, "clear": False}}
LEGEND: Spec = {"orient": "top", "title": None, "labelLimit": 260, "symbolOpacity": 1, "symbolStrokeWidth": 3}
LEGEND["columnPadding"] = 24  # a reader's font may be wider than the font used for the layout
_GRADIENT: Spec = {
    "type": "gradient",
    "orient": "top",
    "direction": "horizontal",
    "gradientLength": 260,
    "columns": 0,
    "columnPadding": 3,
    "titleLimit": 300,
}


def _plain(text: str) -> str:
    """Return a string from a bag as a label: printable ASCII, truncated."""
    return "".join(letter if letter.isprintable() and letter.isascii() else "?" for letter in text[:_LONGEST_LABEL])


def um(length: Samples) -> Samples:
    """Return lengths [m] in µm, clipped to ±1 km, since a bag may hold arbitrary values."""
    cut: Samples = np.clip(np.nan_to_num(length), -_LONGEST_LENGTH, _LONGEST_LENGTH) * 1e6
    return cut


def _clipped(values: Samples) -> Samples:
    """Return the values of other signals, clipped to a plausible range."""
    cut: Samples = np.clip(values, -_MOST_VALUE, _MOST_VALUE)
    return cut


def figure(height: int, *, usermeta: Mapping[str, Any] | None = None, **parts: Any) -> Spec:
    """Return a specification whose figure can be enlarged; ``height`` in px."""
    return chart(height, usermeta={"box": True, **(usermeta or {})}, **parts)


def rectangles(x: Spec, y: Spec, y2: Spec, colour: Spec, tooltip: Rows) -> Spec:
    """Return mark and encoding of rectangles from u to u2 horizontally and from y to y2 vertically."""
    encoding = {"x": x, "x2": {"field": "u2"}, "y": y, "y2": y2, "color": colour, "tooltip": tooltip}
    if colour["type"] == "quantitative":  # no gaps between the fields of a map
        encoding["stroke"] = {key: value for key, value in colour.items() if key != "legend"}
    return {"mark": {"type": "rect", "clip": True, "strokeWidth": 1.2}, "encoding": encoding}


def colours(places: Mapping[str, int], symbol: str = "stroke", *, legend: bool) -> Spec:
    """Return a colour encoding by label, with the page's colours at the given indices."""
    domain = [f"_{place}" for place in range(_COLOURS)]
    for label, place in places.items():
        domain[place] = label
    named = {**LEGEND, "symbolType": symbol, "values": list(places)} if legend else None
    return {"field": "l", "type": "nominal", "scale": {"domain": domain}, "legend": named}


# --- maps


def colour_range(map_rows: Samples) -> tuple[float, float]:
    """Return the largest magnitude of a map, and that of its quietest quarter as the limit of the linear colours [µm].

    With these limits, the first cycles, the remaining error and faults are all visible.
    """
    each = np.sort(np.abs(map_rows).max(axis=1))
    largest = max(float(each[-1]), _FLOOR)
    return largest, min(max(float(each[(len(each) - 1) // 4]), largest * 1e-4), largest)


def _map(fields: Samples, across: Spec, up: Spec, colour: Spec) -> Spec:
    """Return a heat map with one field per number; ``across`` and ``up`` give start, step and axis per direction."""
    # The page holds one number per field; positions, which Vega computes, would make the page 5 times as large.
    place = "(datum.k - 1)"
    drawn = rectangles(
        quantity("u", "spindle angle [°]", scale=axis_scale(ends=(0, 360)), axis=across["axis"]),
        quantity("v", up["title"], scale=up["scale"], axis={"grid": False}),
        {"field": "v2"},
        colour,
        tip(u="spindle angle [°]", v=up["title"], data=colour["title"]),
    )
    return figure(
        340,
        params=[BOX],
        data={"values": [number(value) for value in fields.ravel().tolist()]},
        transform=[
            {"window": [{"op": "row_number", "as": "k"}]},
            {"calculate": f"{across['start']} + {place} % {fields.shape[1]} * {across['step']}", "as": "u"},
            {"calculate": f"datum.u + {across['step']}", "as": "u2"},
            {"calculate": f"{up['start']} + floor({place} / {fields.shape[1]}) * {up['step']}", "as": "v"},
            {"calculate": f"min(datum.v + {up['step']}, {up['end']})", "as": "v2"},
        ],
        usermeta={"renderer": "canvas"},
        **drawn,
    )


def _across(step: float, ticks: int) -> Spec:
    return {"start": 0, "step": step, "axis": {"values": list(range(0, 361, ticks)), "grid": False}}


def _downsample(fields: Samples, most: int) -> tuple[Samples, int]:
    """Return at most ``most`` means of neighbouring rows, and the number of rows in each mean."""
    group = -(-len(fields) // most)
    starts = np.arange(0, len(fields), group)
    counts = np.minimum(starts + group, len(fields)) - starts
    return np.add.reduceat(fields, starts) / counts[:, None], group


def diverging(title: str, largest: float, linear: float) -> Spec:
    """Return the colours of a signed map (field ``data``), see `colour_range`."""
    ticks = [largest, linear] if largest > 3 * linear else [largest]
    values = [*(-tick for tick in ticks), 0.0, *reversed(ticks)]
    scale = {"type": "symlog", "constant": linear / _LINEAR, "domain": [-largest, largest], "range": "diverging"}
    return quantity("data", title, scale=scale, legend={**_GRADIENT, "values": values, "format": ".3~g"})


def form_map(form: FormByRevolution, maps: int) -> Spec:
    """Return a map of the radius deviation by revolution and angle; ``maps``: number of maps in the page."""
    fields = um(form.map.rows())
    largest, linear = colour_range(fields)
    fields = fields.reshape(len(fields), _ACROSS, -1).mean(axis=-1)
    fields, group = _downsample(fields, max(2, _FIELDS // _ACROSS // maps))
    end = form.map.size + 0.5
    up = {"title": "revolution", "start": 0.5, "step": group * form.map.group, "end": end}
    up["scale"] = {**axis_scale(ends=(0.5, end)), "reverse": True}
    return _map(fields, _across(360 / _ACROSS, 45), up, diverging("radius deviation [µm]", largest, linear))


def along(surface: Lay) -> list[Spec]:
    """Return a map of the surface along the part over angle and height, and one trace along the height."""
    deviation = um(surface.surface)  # by angle and height
    place = np.clip(surface.height, -_LONGEST_LENGTH, _LONGEST_LENGTH) * 1e3
    low, high = float(place[0]), float(place[-1])
    step = (high - low) / (place.size - 1) if place.size > 1 else 1.0
    fields, group = _downsample(deviation.T, 128)
    fields, wide = _downsample(fields.T, _ACROSS)
    up = {"title": "height [mm]", "start": low - step / 2, "step": step * group, "end": high + step / 2}
    up["scale"] = axis_scale(ends=sorted((low - step / 2, high + step / 2)))
    colour = quantity("data", "radius deviation [µm]", scale={"scheme": "viridis"}, legend=_GRADIENT)
    line = figure(
        240,
        data={"values": rows(u=place, v=deviation[0])},
        params=[BOX],
        mark={"type": "line", "clip": True, "strokeWidth": 1.4},
        encoding={
            "x": quantity("u", "height [mm]", scale=axis_scale()),
            "y": quantity("v", "radius deviation at 0° [µm]", scale=axis_scale()),
            "tooltip": tip(u="height [mm]", v="deviation [µm]"),
        },
    )
    return [_map(fields.T, _across(360 / len(deviation) * wide, 90), up, colour), line]


# --- revolutions


def polar(form: FormByRevolution) -> list[Spec]:
    """Return polar plots of the radius deviation of the first and the last revolution, each with its own scale."""
    return [_polar(each, colour) for each, colour in ((form.first, FIRST), (form.last, LAST)) if each]


def _polar(revolution: Revolution, colour: int) -> Spec:
    profile = um(revolution.profile)
    deviation = profile[:: max(1, profile.size // _POINTS)]
    deviation = np.append(deviation, deviation[0])
    size = max(float(np.abs(profile).max()), _FLOOR)
    numbers = revolution.numbers

    def at(radius: Samples | float, angle: Samples | float, **more: Any) -> Rows:
        """Return points at a radius and angle, in units where the largest deviation is 1."""
        return rows(u=radius * np.cos(angle), v=radius * np.sin(angle), **more)

    angle, turn, eighths = (np.linspace(0.0, 2.0 * np.pi, points) for points in (deviation.size, 181, 9))
    rings = {f"{side * size:.3g}": _INSIDE + side for side in (-1.0, 0.0, 1.0)}
    ticks = [*list(rings)[:2], f"{size:.3g} µm"]
    texts = at(np.array(list(rings.values())), 1.17, t=ticks)
    texts += at(2.42, eighths[:8], t=[f"{degrees:.0f}°" for degrees in np.rad2deg(eighths[:8])])
    form = at(_INSIDE + deviation / size, angle, l="form", k=np.arange(angle.size), a=np.rad2deg(angle), d=deviation)
    circles = [
        row
        for name, radius in rings.items()
        for row in at(np.full(turn.size, radius), turn, l=name, k=np.arange(turn.size))
    ]
    where = {"scale": axis_scale(ends=(-2.55, 2.55)), "axis": None}
    dash = {"domain": list(rings), "range": [[1, 3], [4, 3], [1, 3]]}
    line = {"type": "line", "clip": True}
    return figure(
        _SQUARE,
        title=f"revolution {numbers['revolution']}: {numbers['rms']:.3g} µm RMS",
        encoding={"x": quantity("u", "", **where), "y": quantity("v", "", **where)},
        layer=[
            {
                "params": [BOX],
                "data": {"values": circles},
                "mark": {**line, "color": "#888", "strokeWidth": 1},
                "encoding": {
                    "order": {"field": "k"},
                    "detail": {"field": "l"},
                    "strokeDash": {"field": "l", "type": "nominal", "legend": None, "scale": dash},
                },
            },
            {
                "data": {"values": form},
                "mark": {**line, "strokeWidth": 1.6},
                "encoding": {
                    "order": {"field": "k"},
                    "color": colours({"form": colour}, legend=False),
                    "tooltip": tip(a="angle [°]", d="deviation [µm]"),
                },
            },
            {
                "data": {"values": texts},
                "mark": {"type": "text", "clip": True, "fontSize": 10},
                "encoding": {"text": {"field": "t"}},
            },
        ],
        usermeta={"square": _SQUARE},
    )


def shown_revolutions(form: FormByRevolution) -> list[tuple[str, Revolution]]:
    """Return the first, best and last revolution with their labels, without repetitions."""
    shown: dict[int, tuple[str, Revolution]] = {}
    for name, revolution in (("first", form.first), ("best", form.best), ("last", form.last)):
        if revolution:
            number_ = revolution.numbers["revolution"]
            shown[number_] = f"{shown[number_][0]}, {name}" if number_ in shown else name, revolution
    return list(shown.values())


def spectrum_range(form: FormByRevolution) -> tuple[float, float]:
    """Return a range of amplitudes [µm] with three decades for each shown revolution; (0, 0) without amplitudes."""
    tops = [float(um(revolution.amplitude[1:]).max()) for _, revolution in shown_revolutions(form)]
    tops = [top for top in tops if top > 0.0]
    return (min(min(tops) * 1e-3, max(tops) * 1e-6), max(tops) * 2.0) if tops else (0.0, 0.0)


def spectrum(form: FormByRevolution) -> Spec:
    """Return a bar chart of the amplitude by undulations per revolution."""
    places = {"first": FIRST, "best": _BEST, "last": LAST}
    shown = {f"{name} revolution ({each.numbers['revolution']})": each for name, each in shown_revolutions(form)}
    low, high = spectrum_range(form)
    bars: Rows = []
    width = 0.8 / len(shown)
    for k, (label, revolution) in enumerate(shown.items()):
        value = np.maximum(um(revolution.amplitude[1:]), low or _FLOOR)
        order = np.arange(1, value.size + 1)
        left = order - 0.4 + k * width
        bars += rows(n=order, u=left, u2=left + width, v=value, l=label)
    indices = {label: places[label.partition(" revolution")[0].split(", ")[-1]] for label in shown}
    ends = (low, high) if high else ()
    drawn = rectangles(
        quantity("u", "undulations per revolution", scale=axis_scale(ends=(0.4, 50.6)), axis={"grid": False}),
        quantity("v", "amplitude [µm]", scale=axis_scale(log=bool(high), ends=ends)),
        {"datum": number(low)},
        colours(indices, "square", legend=True),
        tip(n="undulations per revolution", v="amplitude [µm]"),
    )
    return figure(260, params=[BOX], data={"values": bars}, **drawn)


# --- curves


_Drawn = Mapping[str, tuple[Envelope, int, bool]]  # by name: series, index of its colour, whether it is drawn as dots
_Scaled = Callable[[Samples], Samples]


def _lines(
    curves: _Drawn,
    scaled: tuple[_Scaled, _Scaled],
    titles: tuple[str, str],
    *,
    height: int,
    log: bool,
    limit: float = 0.0,
    unit: str = "µm",
) -> Spec:
    """Return a plot of named lines, with a band where a point stands for several values; a limit is drawn dashed.

    Values that a logarithmic axis cannot show are omitted.

    Args:
        curves: curves by name (see `_Drawn`).
        scaled: functions that convert positions and values to the units of the axes.
        titles: titles of the axes.
        height: height of the plot [px].
        log: whether the values have a logarithmic axis.
        limit: value of the limit line; 0: no limit.
        unit: unit of the limit.
    """
    across, up = titles
    data: Rows = []
    for label, (series, _, dots) in curves.items():
        place, low, high = (
            scale(each) for scale, each in zip((scaled[0], scaled[1], scaled[1]), series.curve(), strict=True)
        )
        kept = (low > 0.0) | (not log)
        data += rows(u=place[kept], a=low[kept], b=high[kept], l=label, dot=dots)
    tooltip = tip(u=across, a="lowest", b="highest")
    line = {"type": "line", "clip": True, "strokeWidth": 1.4, "point": {"size": 12} if len(data) <= 400 else False}
    layer: Rows = [
        {
            "params": [BOX],
            "transform": [{"filter": "!datum.dot"}],
            "mark": {"type": "area", "opacity": 0.35, "clip": True},
            "encoding": {"y": quantity("a", up), "y2": {"field": "b"}},
        },
    ]
    point = {"type": "point", "filled": True, "size": 16, "clip": True}
    for drawn, mark in (("!datum.dot", line), *([("datum.dot", point)] if any(row["dot"] for row in data) else [])):
        encoding = {"y": {"field": "m"}, "tooltip": tooltip}
        layer.append({"transform": [{"filter": drawn}], "mark": mark, "encoding": encoding})
    if limit > 0.0:
        layer += limit_line(limit, f"tolerance {limit:.4g} {unit}")
    values = [row[end] for row in data for end in "ab" if row[end] is not None]
    least, most = min(values, default=0.0), max(values, default=1.0)
    ends: tuple[float, ...] = ()
    if almost_equal(least, most):  # an axis from one number to the same would have a single tick
        margin = 0.5 * (abs(least) or 1.0)
        ends = (least - margin, most + margin)
    axis = {"format": ".4~g", "tickCount": 5}
    places = {label: colour for label, (_, colour, _) in curves.items()}
    return figure(
        height,
        data={"values": data},
        transform=[{"calculate": "sqrt(datum.a * datum.b)" if log else "(datum.a + datum.b) / 2", "as": "m"}],
        encoding={
            "x": quantity("u", across, scale=axis_scale(), axis={"grid": False, "format": "~r", "tickCount": 12}),
            "y": {"type": "quantitative", "title": up, "scale": axis_scale(log=log, ends=ends), "axis": axis},
            "color": colours(places, legend=len(places) > 1),
        },
        layer=layer,
    )


def limit_line(value: float, text: str, dy: int = -6) -> Rows:
    """Return layers of a dashed line across a figure, with its text ``dy`` px below the right end."""
    data = {"values": [{"v": number(value), "t": text}]}
    where = {"y": {"field": "v"}, "color": {"value": "#888"}}
    rule = {"type": "rule", "strokeDash": [6, 4], "clip": True}
    written = {"type": "text", "align": "right", "dy": dy, "clip": True, "fontSize": 11}
    end = {"value": "width"}
    return [
        {"data": data, "mark": rule, "encoding": {"x": {"value": 0}, "x2": end, **where}},
        {"data": data, "mark": written, "encoding": {"x": end, "text": {"field": "t"}, **where}},
    ]


def convergence(form: FormByRevolution | None, cycles: Mapping[str, Envelope]) -> Spec:
    """Return a plot of the form error by revolution, and of the controllers' named cycle reports [m]."""
    own = {"form error, RMS": (form.rms, LAST), "form error, largest": (form.largest, _GREY)} if form else {}
    drawn = {label: (series, colour, False) for label, (series, colour) in own.items() if series.size}
    for colour, (name, series) in enumerate(list(cycles.items())[:_OTHERS], start=1):
        drawn[_plain(name)] = series, colour, True
    limit = form.tolerances.tolerance * 1e6 if form and not form.tolerances.zones else 0.0
    titles = "revolution or cycle", "error [µm]"
    return _lines(drawn, (lambda place: place + 1, um), titles, height=280, log=True, limit=limit)


def servo_error(result: LoopResult) -> Spec:
    """Return a plot of the error of a force or position loop by revolution."""
    quantity_, errors = result.loop.quantity, result.found.errors
    rms, largest = Envelope(), Envelope()
    rms.add(errors.rms)
    largest.add(errors.largest)
    return _lines(
        {"RMS": (rms, LAST, False), "largest": (largest, _GREY, False)},
        (lambda place: place + 1 + result.before, lambda values: _clipped(values) * quantity_.scale),
        ("revolution", f"{quantity_.error} [{quantity_.unit}]"),
        height=240,
        log=True,
        limit=result.loop.tolerance * quantity_.scale,
        unit=quantity_.unit,
    )


def almost_equal(low: float, high: float) -> bool:
    """Return True if two numbers differ by no more than rounding errors."""
    return high - low <= _ALMOST * max(abs(low), abs(high))


def against_time(gathered: Gathered, signals: Mapping[str, Envelope], unit: str, scale: float) -> Spec:
    """Return a plot of signals over simulated time, with their extremes as a band.

    Args:
        gathered: data of the bag, with the sampling step.
        signals: envelopes by name.
        unit: quantity and unit of the axis.
        scale: factor from the signals' unit to the axis unit.
    """
    drawn = {_plain(name): (series, colour, False) for colour, (name, series) in enumerate(signals.items())}
    scaled = gathered.at, lambda values: _clipped(values) * scale
    return _lines(drawn, scaled, ("time since sample 0 [s]", unit), height=220, log=False)


# --- histograms


def _histogram(name: str, counts: Samples, edges: Samples, axes: tuple[str, str], colour: int, *, log: bool) -> Spec:
    """Return a histogram from counts, shape (bins,), bin edges, shape (bins + 1,), and axis titles."""
    across, up = axes
    scale = axis_scale(log=log, ends=(edges[0], edges[-1]))
    data = rows(u=edges[:-1], u2=edges[1:], v=counts.astype(int), l=name)
    drawn = rectangles(
        quantity("u", across, scale=scale, axis={"grid": False, "format": "~r"}),
        quantity("v", up, scale={"zero": True}),
        {"value": "height"},
        colours({name: colour}, legend=False),
        tip(u="from", u2="to", v=up),
    )
    return figure(220, params=[BOX], title=name, data={"values": data}, **drawn)


def timing(host: Host, step: float) -> list[Spec]:
    """Return histograms of the pace, and of block lateness and latency if available; ``step`` in s."""
    pace = _clipped(np.array(host.pace)) * step
    low, high = (float(pace.min()), float(pace.max())) if pace.size else (0.0, 1.0)
    if almost_equal(low, high):  # such paces need a range that can be divided into bins
        low, high = low - 0.5 * (1.0 + abs(low) * _ALMOST), high + 0.5 * (1.0 + abs(high) * _ALMOST)
    counts, edges = np.histogram(pace, bins=min(30, max(5, pace.size // 3)), range=(low, high))
    found = [_histogram("pace", counts, edges, ("simulated by wall time [s/s]", "reports"), _GREY, log=False)]
    for name, across, durations, colour in (
        ("lateness", "let go after it was due [ms]", host.lateness, _BEST),
        ("latency", "until completed by all [ms]", host.latency, LAST),
    ):
        counts = np.sum([each.counts for each in durations.values()], axis=0)
        if counts.any():
            used = np.flatnonzero(counts)
            edges = 2.0 ** np.arange(used[0] - 1, used[-1] + 1) * 1e-3
            found.append(_histogram(name, counts[used[0] : used[-1] + 1], edges, (across, "blocks"), colour, log=True))
    return found
