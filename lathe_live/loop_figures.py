# SPDX-License-Identifier: Apache-2.0
"""Figures of drives beside their loops: Bode diagrams, and margins along a setting."""

import json
from collections.abc import Sequence

import numpy as np

from lathe_live.varied_loop import Along, DriveCurve
from lathe_rc.drawing.charts import Rows, Spec, axis_scale, quantity, rows, tip
from lathe_rc.messages import Samples
from lathe_rc.view.report_figures import BOX, colours, figure

_MOST = 5  # responses of a controller
_LOWEST, _HIGHEST = -60.0, 20.0  # [dB] ends of the axis


def bode(drives: Sequence[DriveCurve]) -> list[Spec]:
    """Return magnitude and phase over the frequency, of all responses of one controller."""
    shown = list(drives)[:_MOST]
    magnitude, phase = [], []
    for each in shown:
        with np.errstate(divide="ignore"):
            size = 20.0 * np.log10(np.abs(each.value))
        hertz, angle = each.frequency / (2.0 * np.pi), np.rad2deg(np.unwrap(np.angle(each.value)))
        kept = size > _LOWEST
        magnitude += rows(f=hertz[kept], v=size[kept], l=each.label, dot=each.measured)
        phase += rows(f=hertz[kept], v=angle[kept], l=each.label, dot=each.measured)
    labels = [each.label for each in shown]
    high = min(_HIGHEST, max((row["v"] for row in magnitude), default=_HIGHEST))
    low = min((row["v"] for row in magnitude), default=_LOWEST)
    back = min((row["v"] for row in phase), default=-180.0)
    return [
        _over_frequency("magnitude [dB]", magnitude, labels, (low - 3.0, high + 3.0)),
        _over_frequency("phase [°]", phase, labels, (max(back, -720.0), max((row["v"] for row in phase), default=0.0))),
    ]


def _over_frequency(title: str, data: Rows, labels: list[str], ends: tuple[float, float]) -> Spec:
    encoding = {
        "x": quantity("f", "frequency [Hz]", scale=axis_scale(log=True), axis={"grid": False, "format": "~g"}),
        "y": quantity("v", title, scale=axis_scale(ends=ends), axis={"tickCount": 6}),
        "color": colours({label: place for place, label in enumerate(labels)}, legend=True),
        "tooltip": tip(f="frequency [Hz]", v=title),
    }
    first = f"datum.l == {json.dumps(labels[0])}"
    layer: Rows = [
        {
            "params": [BOX],
            "transform": [{"filter": f"!datum.dot && {first}"}],
            "mark": {"type": "line", "clip": True, "strokeWidth": 4, "opacity": 0.6},
        },
        {  # a model that equals the drive is seen on top of it
            "transform": [{"filter": f"!datum.dot && !({first})"}],
            "mark": {"type": "line", "clip": True, "strokeWidth": 1.6, "strokeDash": [6, 4]},
        },
    ]
    if any(row["dot"] for row in data):
        mark = {"type": "point", "filled": True, "size": 18, "clip": True}
        layer.append({"transform": [{"filter": "datum.dot"}], "mark": mark})
    return figure(260, data={"values": data}, encoding=encoding, layer=layer)


def strip(along: Along, value: float) -> str:
    """Return an SVG of the least drive margin along a setting, with refused values shaded, and a mark at a value."""
    wide = 1000.0

    def at(number: Samples | float) -> Samples:
        return np.asarray((number - along.setting.low) / (along.setting.high - along.setting.low) * wide)

    places = at(along.values)
    middle = np.concatenate(([places[0]], (places[1:] + places[:-1]) / 2.0, [places[-1]]))
    drawn = [f'<svg viewBox="0 0 {wide:g} 30" preserveAspectRatio="none" role="img" aria-label="{_in_words(along)}">']
    drawn += [
        f'<rect class="refused" x="{middle[k]:.1f}" y="0" width="{middle[k + 1] - middle[k]:.1f}" height="30"/>'
        for k in np.flatnonzero(along.refused)
    ]
    points = [
        f"{x:.1f} {28.0 - 26.0 * min(y, 1.0):.1f}" for x, y in zip(places, along.margins, strict=True) if y >= 0.0
    ]
    drawn += [f'<path class="margin" d="M {" L ".join(points)}"/>'] if len(points) > 1 else []
    drawn += [f'<path class="here" d="M {float(at(value)):.1f} 0 V 30"/>', "</svg>"]
    return "".join(drawn)


def _in_words(along: Along) -> str:
    accepted = along.values[~along.refused]
    if not accepted.size:
        return "all values are refused"
    return f"accepted from {accepted[0]:.4g} to {accepted[-1]:.4g} {along.setting.unit}"
