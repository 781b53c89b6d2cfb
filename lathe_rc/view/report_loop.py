# SPDX-License-Identifier: Apache-2.0
"""Figures of a controller's loop: its factor of a cycle in the unit circle, and the errors that the drive may have."""

from typing import Any

import numpy as np

from lathe_rc.drawing.charts import Rows, Spec, axis_scale, quantity, rows, tip
from lathe_rc.judge.loop_curves import LEAST, LoopCurve
from lathe_rc.view.report_figures import BOX, FIRST, LAST, colours, figure

_SQUARE = 460  # [px] size of the locus
_AXES = 50  # [px] width of its labels beside it
_LABELLED = (1, 2, 5, 10, 20, 50, 100)  # harmonics with a label in the locus
_APART = 0.12  # least distance of two labels
_TOP, _EDGE = 2.0, 1.25  # ends of the axes
_INNER = 0.3  # half of the inner share of a figure, in which a centred label has room
_RPM = 60.0 / (2.0 * np.pi)
_ERROR = "error that diverges (dashed)"


def loop(curve: LoopCurve) -> list[Spec]:
    """Return the locus of the factor of a cycle, if there is one, and its magnitude over the waves per revolution."""
    return [*([_locus(curve)] if curve.factor is not None else []), _over_waves(curve)]


def texts(data: Rows, **mark: Any) -> Rows:
    """Return layers of labels that a curve below does not make illegible."""
    text = {"type": "text", "clip": True, "fontSize": 11, **mark}
    encoding = {"text": {"field": "t"}}
    layer = {"data": {"values": data}, "encoding": encoding}
    return [{**layer, "mark": {**text, "style": "halo"}}, {**layer, "mark": text}]


def diamond(data: Rows, shade: Spec, **mark: Any) -> Rows:
    """Return layers of a diamond with its label, in a colour of an encoding."""
    point = {"type": "point", "shape": "diamond", "filled": True, "size": 130, "opacity": 1, "clip": True}
    return [{"data": {"values": data}, "mark": point, "encoding": {"color": shade}}, *texts(data, **mark)]


def _locus(curve: LoopCurve) -> Spec:
    factor, waves = curve.factor, curve.waves
    assert factor is not None, "asked by the caller"
    size, worst = max(_EDGE, 1.08 * float(np.abs(factor).max())), factor[_at(curve)]
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = rows(u=np.cos(turn), v=np.sin(turn), k=np.arange(turn.size))
    line = rows(u=factor.real, v=factor.imag, k=np.arange(waves.size), n=waves, f=np.abs(factor), l="factor")
    harmonics, labelled = np.isin(waves, np.arange(1.0, 101.0)), np.flatnonzero(np.isin(waves, _LABELLED))
    kept: list[int] = []
    for k in labelled:
        if all(abs(factor[k] - factor[j]) > _APART * size for j in kept):
            kept.append(int(k))
    dots = [row for row, whole in zip(line, harmonics, strict=True) if whole]
    names = rows(u=factor.real[kept], v=factor.imag[kept], t=[f"{waves[k]:.0f}" for k in kept])
    where = {"scale": axis_scale(ends=(-size, size)), "axis": {"tickCount": 5}}
    place = {"x": quantity("u", "real part", **where), "y": quantity("v", "imaginary part", **where)}
    shade = colours({"factor": LAST, "worst": FIRST}, legend=False)
    shown = tip(n="waves per revolution", f="magnitude")
    return figure(
        _SQUARE,
        title=f"{curve.node} at {curve.margin.speed * _RPM:.5g}/min: factor of a cycle",
        encoding=place,
        layer=[
            {
                "params": [BOX],
                "data": {"values": circle},
                "mark": {"type": "line", "clip": True, "color": "#888", "strokeDash": [6, 4]},
                "encoding": {"order": {"field": "k"}},
            },
            {
                "data": {"values": line},
                "mark": {"type": "line", "clip": True},
                "encoding": {"order": {"field": "k"}, "color": shade},
            },
            {
                "data": {"values": dots},
                "mark": {"type": "point", "filled": True, "size": 22, "clip": True},
                "encoding": {"color": shade, "tooltip": shown},
            },
            *texts(names, align="left", dx=6, dy=-6),
            *_worst(curve, rows(u=worst.real, v=np.array([worst.imag])), "worst", shade, side=worst.real / size),
        ],
        usermeta={"square": _SQUARE, "axes": _AXES},
    )


def _at(curve: LoopCurve) -> int:
    return int(np.argmin(np.abs(curve.waves - max(curve.margin.waves, LEAST))))


def _worst(curve: LoopCurve, place: Rows, label: str, shade: Spec, side: float) -> Rows:
    """Return the mark of the least margin with its label, in the colour of another label.

    Args:
        curve: loop with the margin.
        place: row with the place of the mark.
        label: label whose colour the mark has.
        shade: encoding of the colours.
        side: place between the left (-1) and the right end (1) of the figure, near which the label points inwards.
    """
    align, dx = ("center", 0) if abs(side) < _INNER else ("left", -8) if side < 0.0 else ("right", 8)
    data = [{**row, "t": f"margin {curve.margin}", "l": label} for row in place]
    return diamond(data, shade, dy=16, align=align, dx=dx)


def _over_waves(curve: LoopCurve) -> Spec:
    waves = curve.waves
    drawn = {_ERROR: np.minimum(curve.error, 2.0 * _TOP)}
    if curve.factor is not None:
        drawn = {"magnitude of the factor": np.abs(curve.factor), **drawn}
    data = [row for label, values in drawn.items() for row in rows(n=waves, v=values, l=label)]
    across = f"waves per revolution (1: {curve.margin.speed / (2.0 * np.pi):.4g} Hz)"
    dash = {"domain": list(drawn), "range": [[1, 0], [7, 3]][-len(drawn) :]}
    shade = colours(dict(zip(drawn, (LAST, FIRST)[-len(drawn) :], strict=True)), legend=True)
    limit = rows(v=np.ones(1))
    at = float(curve.waves[_at(curve)])
    worst = rows(n=at, v=np.array([min(curve.margin.error, _TOP)]))
    low, high = np.log(waves[[0, -1]])
    return figure(
        280,
        title=f"{curve.node} at {curve.margin.speed * _RPM:.5g}/min",
        encoding={
            "x": quantity("n", across, scale=axis_scale(log=True), axis={"grid": False, "format": "~g"}),
            "y": quantity("v", "relative to 1", scale=axis_scale(ends=(0.0, _TOP)), axis={"tickCount": 5}),
        },
        layer=[
            {
                "params": [BOX],
                "data": {"values": data},
                "mark": {"type": "line", "clip": True},
                "encoding": {
                    "color": shade,
                    "strokeDash": {"field": "l", "type": "nominal", "legend": None, "scale": dash},
                    "tooltip": tip(n="waves per revolution", v="value"),
                },
            },
            {
                "data": {"values": limit},
                "mark": {"type": "rule", "strokeDash": [2, 3], "clip": True},
                "encoding": {
                    "x": {"value": 0},
                    "x2": {"value": "width"},
                    "y": {"field": "v"},
                    "color": {"value": "#888"},
                },
            },
            *_worst(curve, worst, _ERROR, shade, side=2.0 * (np.log(at) - low) / (high - low) - 1.0),
        ],
    )
