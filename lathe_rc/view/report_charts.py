# SPDX-License-Identifier: Apache-2.0
"""The figures of a report as they are drawn on a screen: the same numbers as `report_figures`, to be enlarged."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lathe_rc.analysis.metrology import Lay
from lathe_rc.messages import Samples
from lathe_rc.view.charts import FIT, SCHEMA, Rows, Spec
from lathe_rc.view.report_figures import (
    FLOOR,
    LONGEST_LENGTH,
    colour_range,
    histograms,
    limited,
    plain,
    shown_revolutions,
    spectrum_range,
    um,
)
from lathe_rc.view.report_form import Form, Revolution
from lathe_rc.view.report_gather import Gathered
from lathe_rc.view.report_host import Host
from lathe_rc.view.report_series import Envelope

_DIGITS = 4  # of the numbers that a page carries
_FIELDS = 40_000  # of all maps of a page
_ACROSS = 256  # fields of a map in a revolution
_LINEAR = 8.0  # of the symmetrical logarithm: so much of its colours are for what is left at the end
_SQUARE = 460  # [px] the largest polar figure
_INSIDE = 1.2  # radius of the desired form in a polar figure, by the largest deviation
_RMS, _LARGEST = "form error, RMS", "form error, largest"
_OTHERS = 4  # controllers whose cycles are drawn
_POINTS = 720  # of a polar figure
_LAST, _FIRST, _BEST, _GREY = 0, 1, 2, 5  # places in the page's colours

#: Dragging marks what is to be enlarged.
_BOX: Spec = {"name": "box", "select": {"type": "interval", "translate": False, "zoom": False, "clear": False}}
_META: Spec = {"box": True}


def _number(value: float) -> float | None:
    """As it goes into a page: short, and None for what is none."""
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None


def _quantity(field: str, title: str, **more: Any) -> Spec:
    return {"field": field, "type": "quantitative", "title": title, **more}


def _tip(**fields: str) -> Rows:
    return [
        {"field": field, "title": title, "format": ".4~g", "type": "quantitative"} for field, title in fields.items()
    ]


def _axis(kind: str = "linear", ends: Sequence[float] | None = None) -> Spec:
    found: Spec = {"type": kind, "nice": False, **({"zero": False} if kind == "linear" else {})}
    return found | ({"domain": [float(f"{end:.6g}") for end in ends]} if ends else {})


def _one(label: str, place: int) -> Spec:
    """The colour of marks that all have this label: the page's of a place."""
    domain = [*(f"_{k}" for k in range(place)), label]
    return {"field": "l", "type": "nominal", "scale": {"domain": domain}, "legend": None}


def _spec(height: int, **parts: Any) -> Spec:
    return {"$schema": SCHEMA, "width": 640, "height": height, "autosize": FIT, "usermeta": _META, **parts}


_LEGEND: Spec = {"orient": "top", "title": None, "labelLimit": 260, "symbolType": "stroke", "symbolOpacity": 1}
_LEGEND |= {"symbolStrokeWidth": 3}
_GRADIENT: Spec = {"orient": "top", "direction": "horizontal", "gradientLength": 260, "columns": 0, "titleLimit": 300}


def _map(rows: Samples, across: Spec, up: Spec, colour: Spec, meta: Spec) -> Spec:
    """A field for each number of ``rows``; across and up say where they begin, how large they are, and their titles."""
    columns = rows.shape[1]
    place = "(datum.k - 1)"
    return _spec(
        340,
        data={"values": [_number(value) for value in rows.ravel().tolist()]},
        transform=[
            {"window": [{"op": "row_number", "as": "k"}]},
            {"calculate": f"{across['start']} + {place} % {columns} * {across['step']}", "as": "u"},
            {"calculate": f"datum.u + {across['step']}", "as": "u2"},
            {"calculate": f"{up['start']} + floor({place} / {columns}) * {up['step']}", "as": "v"},
            {"calculate": f"min(datum.v + {up['step']}, {up['end']})", "as": "v2"},
        ],
        params=[_BOX],
        mark={"type": "rect", "clip": True, "strokeWidth": 1.2},
        encoding={
            "x": _quantity("u", across["title"], scale=across["scale"], axis=across.get("axis", {})),
            "x2": {"field": "u2"},
            "y": _quantity("v", up["title"], scale=up["scale"], axis={"grid": False}),
            "y2": {"field": "v2"},
            "color": colour,
            "stroke": {key: value for key, value in colour.items() if key != "legend"},
            "tooltip": _tip(u=across["title"], v=up["title"], data=colour["title"]),
        },
        usermeta={**_META, **meta},
    )


def _thinner(rows: Samples, most: int) -> tuple[Samples, int]:
    """Means of neighbours in each column, of so many rows that no more than ``most`` are left; and of how many."""
    group = -(-len(rows) // most)
    starts = np.arange(0, len(rows), group)
    counts = np.minimum(starts + group, len(rows)) - starts
    return np.add.reduceat(rows, starts) / counts[:, None], group


def form_map(form: Form, maps: int) -> Spec:
    """Radius deviation by revolution and angle; ``maps``: of the page."""
    rows = um(form.map.rows())
    largest, linear = colour_range(rows)
    rows = rows.reshape(len(rows), _ACROSS, -1).mean(axis=-1)
    rows, group = _thinner(rows, max(2, _FIELDS // _ACROSS // maps))
    end = form.map.size + 0.5
    across = {"title": "spindle angle [°]", "start": 0, "step": 360 / _ACROSS, "scale": _axis(ends=(0, 360))}
    across["axis"] = {"values": list(range(0, 361, 45)), "grid": False}
    up = {"title": "revolution", "start": 0.5, "step": group * form.map.group, "end": end}
    up["scale"] = {**_axis(ends=(0.5, end)), "reverse": True}
    ticks = [largest, linear] if largest > 3 * linear else [largest]
    values = [*(-tick for tick in ticks), 0.0, *reversed(ticks)]
    colour = _quantity("data", "radius deviation [µm]")
    colour["scale"] = {"type": "symlog", "constant": linear / _LINEAR, "domain": [-largest, largest]}
    colour["scale"]["range"] = "diverging"
    colour["legend"] = {**_GRADIENT, "values": values, "format": ".3~g"}
    return _map(rows, across, up, colour, {"renderer": "canvas"})


def along(surface: Lay) -> list[Spec]:
    """The surface along the part over angle and height, and one trace of it."""
    deviation = um(surface.surface)  # by angle and height
    place = np.clip(surface.height, -LONGEST_LENGTH, LONGEST_LENGTH) * 1e3
    low, high = float(place[0]), float(place[-1])
    step = (high - low) / (place.size - 1) if place.size > 1 else 1.0
    rows, group = _thinner(deviation.T, 128)
    rows, wide = _thinner(rows.T, _ACROSS)
    rows = rows.T
    ends = sorted((low - step / 2, high + step / 2))
    across = {"title": "spindle angle [°]", "start": 0, "step": 360 / len(deviation) * wide}
    across |= {"scale": _axis(ends=(0, 360)), "axis": {"values": list(range(0, 361, 90)), "grid": False}}
    up = {"title": "height [mm]", "start": low - step / 2, "step": step * group, "end": high + step / 2}
    up["scale"] = _axis(ends=ends)
    colour = _quantity("data", "radius deviation [µm]", scale={"scheme": "viridis"})
    colour["legend"] = _GRADIENT
    trace = [{"u": _number(x), "v": _number(y)} for x, y in zip(place.tolist(), deviation[0].tolist(), strict=True)]
    line = _spec(
        240,
        data={"values": trace},
        params=[_BOX],
        mark={"type": "line", "clip": True, "strokeWidth": 1.4},
        encoding={
            "x": _quantity("u", "height [mm]", scale=_axis()),
            "y": _quantity("v", "radius deviation at 0° [µm]", scale=_axis()),
            "tooltip": _tip(u="height [mm]", v="deviation [µm]"),
        },
    )
    return [_map(rows, across, up, colour, {"renderer": "canvas"}), line]


def polar(form: Form) -> list[Spec]:
    """Radius deviation of the first and the last revolution, each in its own scale."""
    assert form.first, "there is no revolution"
    assert form.last, "there is no revolution"
    return [_polar(form.first, _FIRST), _polar(form.last, _LAST)]


def _polar(revolution: Revolution, colour: int) -> Spec:
    profile = um(revolution.profile)
    deviation = profile[:: max(1, profile.size // _POINTS)]
    deviation = np.append(deviation, deviation[0])
    size = max(float(np.abs(profile).max()), FLOOR)
    angle = np.linspace(0.0, 2.0 * np.pi, deviation.size)
    number, rms = revolution.numbers["revolution"], revolution.numbers["rms"]

    def turned(deviation: Samples, angle: Samples, line: str) -> Rows:
        radius = _INSIDE + deviation / size  # 1: of the largest deviation
        return [
            {"l": line, "k": k, "u": _number(x), "v": _number(y)}
            for k, (x, y) in enumerate(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True))
        ]

    round_ = np.linspace(0.0, 2.0 * np.pi, 181)
    rings = [row for at in (-size, 0.0, size) for row in turned(np.full(181, at), round_, f"{at:.3g}")]
    form_rows = [
        {**row, "a": _number(np.rad2deg(turn)), "d": _number(value)}
        for row, turn, value in zip(turned(deviation, angle, "form"), angle, deviation.tolist(), strict=True)
    ]
    ticks = [
        {"u": _number((_INSIDE + at / size) * np.cos(1.17)), "v": _number((_INSIDE + at / size) * np.sin(1.17)), "t": t}
        for at, t in ((-size, f"{-size:.3g}"), (0.0, "0"), (size, f"{size:.3g} µm"))
    ]
    degrees = [
        {"u": _number(2.42 * np.cos(turn)), "v": _number(2.42 * np.sin(turn)), "t": f"{np.rad2deg(turn):.0f}°"}
        for turn in np.arange(8) * np.pi / 4
    ]
    ends = (-2.55, 2.55)
    stroke = {"field": "l", "type": "nominal", "legend": None}
    dash = {"scale": {"domain": [f"{-size:.3g}", "0", f"{size:.3g}"], "range": [[1, 3], [4, 3], [1, 3]]}}
    return _spec(
        _SQUARE,
        title=f"revolution {number}: {rms:.3g} µm RMS",
        encoding={
            "x": _quantity("u", "", scale=_axis(ends=ends), axis=None),
            "y": _quantity("v", "", scale=_axis(ends=ends), axis=None),
        },
        layer=[
            {
                "params": [_BOX],
                "data": {"values": rings},
                "mark": {"type": "line", "clip": True, "color": "#888", "strokeWidth": 1},
                "encoding": {"order": {"field": "k"}, "detail": {"field": "l"}, "strokeDash": {**stroke, **dash}},
            },
            {
                "data": {"values": form_rows},
                "mark": {"type": "line", "clip": True, "strokeWidth": 1.6},
                "encoding": {
                    "order": {"field": "k"},
                    "color": _one("form", colour),
                    "tooltip": _tip(a="angle [°]", d="deviation [µm]"),
                },
            },
            {
                "data": {"values": [*ticks, *degrees]},
                "mark": {"type": "text", "clip": True, "fontSize": 10},
                "encoding": {"text": {"field": "t"}},
            },
        ],
        usermeta={**_META, "square": _SQUARE},
    )


def spectrum(form: Form) -> Spec:
    """Amplitude by undulations per revolution."""
    shown = shown_revolutions(form)
    names = {"first": _FIRST, "best": _BEST, "last": _LAST}
    rows: Rows = []
    labels = ["_0", "_1", "_2"]
    low, high = spectrum_range(form)
    for k, (name, _, revolution) in enumerate(shown):
        label = f"{name} revolution ({revolution.numbers['revolution']})"
        labels[names[name.split(", ")[-1]]] = label
        width = 0.8 / len(shown)
        left = k * width - 0.4
        for order, value in enumerate(um(revolution.amplitude[1:]).tolist(), start=1):
            x, y = order + left, max(value, low) or FLOOR
            rows.append({"n": order, "u": _number(x), "u2": _number(x + width), "v": _number(y), "l": label})
    kind = "log" if high else "linear"
    legend = {**_LEGEND, "symbolType": "square", "values": list(dict.fromkeys(row["l"] for row in rows))}
    return _spec(
        260,
        data={"values": rows},
        params=[_BOX],
        mark={"type": "rect", "clip": True},
        encoding={
            "x": _quantity("u", "undulations per revolution", scale=_axis(ends=(0.4, 50.6)), axis={"grid": False}),
            "x2": {"field": "u2"},
            "y": _quantity("v", "amplitude [µm]", scale=_axis(kind, (low, high) if high else None)),
            "y2": {"datum": _number(low)},
            "color": {"field": "l", "type": "nominal", "scale": {"domain": labels}, "legend": legend},
            "tooltip": _tip(n="undulations per revolution", v="amplitude [µm]"),
        },
    )


def _curves(bands: Mapping[str, tuple[Samples, Samples, Samples]], dots: Sequence[str] = (), *, log: bool) -> Rows:
    """Rows of envelopes by name: where, lowest, highest; of what has no place on a logarithmic axis none."""
    rows: Rows = []
    for label, (place, low, high) in bands.items():
        for x, a, b in zip(place.tolist(), low.tolist(), high.tolist(), strict=True):
            if not log or a > 0.0:
                rows.append({"u": _number(x), "a": _number(a), "b": _number(b), "l": label, "dot": label in dots})
    return rows


def _lines(
    rows: Rows, labels: Sequence[str], across: str, up: str, *, log: bool, limit: float = 0.0, height: int
) -> Spec:
    """Lines, each with a band where it stands for several values; a limit as a dashed one."""
    colour: Spec = {"field": "l", "type": "nominal", "scale": {"domain": list(labels)}, "legend": None}
    if len(named := [label for label in labels if label.strip()]) > 1:
        colour["legend"] = {**_LEGEND, "values": named}
    mark = {"clip": True, "strokeWidth": 1.4}
    middle = {"calculate": "sqrt(datum.a * datum.b)" if log else "(datum.a + datum.b) / 2", "as": "m"}
    tip = _tip(u=across, a="lowest", b="highest")
    line = {"type": "line", "point": {"size": 12} if len(rows) <= 400 else False, **mark}
    layer: Rows = [
        {
            "params": [_BOX],
            "transform": [{"filter": "!datum.dot"}],
            "mark": {"type": "area", "opacity": 0.35, "clip": True},
            "encoding": {"y": _quantity("a", up), "y2": {"field": "b"}},
        },
        {"transform": [{"filter": "!datum.dot"}], "mark": line, "encoding": {"y": {"field": "m"}, "tooltip": tip}},
    ]
    if any(row["dot"] for row in rows):
        dots = {"type": "point", "filled": True, "size": 16, "clip": True}
        layer.append({"transform": [{"filter": "datum.dot"}], "mark": dots, "encoding": {"y": {"field": "m"}}})
        layer[-1]["encoding"]["tooltip"] = tip
    scale = _axis("log" if log else "linear")
    found = _spec(
        height,
        data={"values": rows},
        transform=[middle],
        encoding={
            "x": _quantity("u", across, scale=_axis(), axis={"grid": False, "format": "~r"}),
            "y": {"type": "quantitative", "title": up, "scale": scale, "axis": {"format": ".4~g", "tickCount": 5}},
            "color": colour,
        },
        layer=layer,
    )
    if limit > 0.0:
        marked: Rows = [{"v": _number(limit), "t": f"tolerance {limit:.3g} µm"}]
        own = {"color": {"value": "#888"}}
        layer += [
            {
                "data": {"values": marked},
                "mark": {"type": "rule", "strokeDash": [6, 4], "clip": True},
                "encoding": {"x": {"value": 0}, "x2": {"value": "width"}, "y": {"field": "v"}, **own},
            },
            {
                "data": {"values": marked},
                "mark": {"type": "text", "align": "right", "dy": -6, "clip": True, "fontSize": 11},
                "encoding": {"x": {"value": "width"}, "y": {"field": "v"}, "text": {"field": "t"}, **own},
            },
        ]
    return found


def convergence(form: Form | None, cycles: Mapping[str, Envelope]) -> Spec:
    """Form error by revolution, and by name what the controllers say of each cycle [m]."""
    bands = {}
    if form and form.rms.size:
        for label, series in ((_RMS, form.rms), (_LARGEST, form.largest)):
            place, low, high = series.curve()
            bands[label] = (place + 1, um(low), um(high))
    own = []
    for name, series in list(cycles.items())[:_OTHERS]:
        place, low, high = series.curve()
        own.append(plain(name))
        bands[own[-1]] = (place + 1, um(low), um(high))
    rows = _curves(bands, own, log=True)
    colours = [_RMS if _RMS in bands else "", *own[:_OTHERS]]
    colours += [" " * k for k in range(1, _GREY - len(colours) + 1)] + ([_LARGEST] if _RMS in bands else [])
    limit = form.tolerance * 1e6 if form else 0.0
    return _lines(rows, colours, "revolution or cycle", "error [µm]", log=True, limit=limit, height=280)


def against_time(told: Gathered, curves: Mapping[str, Envelope], unit: str, scale: float) -> Spec:
    """Signals by simulated time, their extremes as a band; see `report_figures.against_time`."""
    bands = {}
    for name, series in curves.items():
        place, low, high = series.curve()
        bands[plain(name)] = (told.at(place), limited(low) * scale, limited(high) * scale)
    return _lines(_curves(bands, log=False), list(bands), "time since sample 0 [s]", unit, log=False, height=220)


def timing(host: Host, step: float) -> list[Spec]:
    """Histograms of pace, and of lateness and latency of blocks where there are any; ``step`` in s."""
    colours = {"pace": _GREY, "lateness": _BEST, "latency": _LAST}
    found = []
    for name, each in histograms(host, step).items():
        edges = each.edges.tolist()
        rows = [
            {"u": _number(low), "u2": _number(high), "v": int(count), "l": name}
            for low, high, count in zip(edges[:-1], edges[1:], each.counts, strict=True)
        ]
        scale = _axis("log" if each.log else "linear", (edges[0], edges[-1]))
        found.append(
            _spec(
                220,
                title=name,
                data={"values": rows},
                params=[_BOX],
                mark={"type": "rect", "clip": True},
                encoding={
                    "x": _quantity("u", each.across, scale=scale, axis={"grid": False, "format": "~r"}),
                    "x2": {"field": "u2"},
                    "y": _quantity("v", each.up, scale={"zero": True}),
                    "y2": {"value": "height"},
                    "color": _one(name, colours[name]),
                    "tooltip": _tip(u="from", u2="to", v=each.up),
                },
            )
        )
    return found
