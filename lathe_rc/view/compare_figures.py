# SPDX-License-Identifier: Apache-2.0
"""Figures that show several runs on one scale; a revolution and a tolerance chosen on the page apply to all of them.

The maps of all runs and their differences are one data set: a number per field, by map, revolution and angle. Every
figure finds its own fields by their positions.
"""

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lathe_rc.drawing.charts import Rows, Spec, axis_scale, chart, number, quantity, rows, tip
from lathe_rc.judge.loops import LoopResult
from lathe_rc.messages import Samples
from lathe_rc.view.report_figures import LEGEND, colour_range, diverging, rectangles, um
from lathe_rc.view.report_form import FormByRevolution
from lathe_rc.view.report_series import Envelope

MAPS, SPECTRA, SIZES = "maps", "spectra", "sizes"  #: names of the data sets
_FIELDS = 60_000  # total number of fields in the maps of a page
_ACROSS = 128  # fields of a map per revolution
_ORDERS = 50  # largest number of undulations per revolution in the spectra
_POLAR = 360  # [px] size of the polar figure


@dataclass(frozen=True)
class Compared:
    """Maps of several runs with common revolutions and angles.

    Attributes:
        maps: radius deviation [µm] by name, shape (rows, angles) each; NaN after the end of a run.
        differences: the same for each run but the first, less the first run.
        step: number of revolutions of a row.
        revolutions: number of revolutions of the longest run.
        shown: revolution shown first, the last one that all runs have.
        sizes: largest magnitude of the form error [µm] by name and revolution.
        doubts: how far the desired form of each run may be off between the points of its table [µm].
        tolerance: tolerance shown first [µm].
        unjudged: runs whose end is not known.
    """

    maps: Mapping[str, Samples]
    differences: Mapping[str, Samples]
    step: int
    revolutions: int
    shown: int
    sizes: Mapping[str, tuple[Samples, Samples]]
    doubts: Mapping[str, float]
    tolerance: float
    unjudged: Collection[str] = ()

    @property
    def rows(self) -> int:
        """Return the number of rows of each map."""
        return len(next(iter(self.maps.values())))

    @property
    def data(self) -> dict[str, Rows]:
        """Return the data sets that all figures share."""
        fields = np.concatenate([*self.maps.values(), *self.differences.values()])
        spectra = np.abs(np.fft.rfft(np.stack(list(self.maps.values())), axis=-1))[..., 1 : _ORDERS + 1]
        numbers = {MAPS: fields, SPECTRA: spectra * 2.0 / _ACROSS}
        sizes: Rows = []
        for name, (revolution, size) in self.sizes.items():
            sizes += rows(r=revolution, v=size, d=self.doubts[name], l=name)
        plain = {name: [{"data": number(each, 4)} for each in found.ravel()] for name, found in numbers.items()}
        return {**plain, SIZES: sizes}


def compared(forms: Mapping[str, FormByRevolution], tolerance: float, unjudged: Collection[str] = ()) -> Compared:
    """Return the maps of several runs with common rows.

    Args:
        forms: form by run.
        tolerance: tolerance shown first [m]; 0: none.
        unjudged: runs whose end is not known.
    """
    group = max(form.map.group for form in forms.values())
    longest = max(form.map.size for form in forms.values())
    most = max(2, _FIELDS // _ACROSS // (2 * len(forms) - 1))
    step = group * -(-longest // (group * most))
    maps = {name: _rows(form, step, -(-longest // step)) for name, form in forms.items()}
    first, *others = maps
    sizes = {}
    for name, form in forms.items():
        place, _, high = form.largest.curve()
        sizes[name] = place + 1.0, um(high)
    differences = {f"{name} − {first}": maps[name] - maps[first] for name in others}
    least = min(float(size[-1]) for _, size in sizes.values())
    shown = min(form.map.size for form in forms.values())
    first_shown = tolerance * 1e6 or float(f"{2.0 * least:.1g}")
    doubts = {name: 1e6 * form.tolerances.doubt for name, form in forms.items()}
    return Compared(maps, differences, step, longest, shown, sizes, doubts, first_shown, unjudged)


def _rows(form: FormByRevolution, step: int, count: int) -> Samples:
    """Return the map of a run in µm with ``step`` revolutions a row."""
    fields = um(form.map.rows())
    fields = fields.reshape(len(fields), _ACROSS, -1).mean(axis=-1)
    starts = np.arange(0, len(fields), step // form.map.group)
    sums = np.add.reduceat(fields, starts)
    found = np.full((count, _ACROSS), np.nan)
    found[: len(sums)] = sums / np.diff(starts, append=len(fields))[:, None]
    return found


# --- parts of specifications


def _steered(runs: Compared, spec: Spec, **usermeta: object) -> Spec:
    """Return a figure with the page's revolution and tolerance as parameters."""
    params = [{"name": "revolution", "value": runs.shown}, {"name": "tolerance", "value": number(runs.tolerance)}]
    return {**spec, "params": params, "usermeta": {"signals": ["revolution", "tolerance"], **usermeta}}


def _placed(runs: Compared, width: int, maps: str) -> Rows:
    """Return transforms that find map, row, column and first revolution of each number of a data set."""
    return [
        {"window": [{"op": "row_number", "as": "k"}]},
        {"calculate": f"floor((datum.k - 1) / {width * runs.rows})", "as": "m"},
        {"filter": maps},
        {"calculate": f"(datum.k - 1) % {width}", "as": "n"},
        {"calculate": f"floor((datum.k - 1) / {width}) % {runs.rows} * {runs.step} + 1", "as": "r"},
    ]


def _chosen(runs: Compared, width: int) -> Rows:
    """Return transforms that find the numbers of each run at the chosen revolution."""
    here = f"datum.r <= revolution && revolution < datum.r + {runs.step} && isValid(datum.data)"
    return [
        *_placed(runs, width, f"datum.m < {len(runs.maps)}"),
        {"filter": here},
        {"calculate": f"{json.dumps(list(runs.maps))}[datum.m]", "as": "l"},
    ]


def _by_run(names: Iterable[str], **tips: str) -> Spec:
    """Return an encoding of lines by run: colour, dashes for readers who do not see it, and tooltip."""
    domain = list(names)
    patterns = [[1, 0], [6, 3], [2, 2], [8, 2, 2, 2]]
    dashes = [patterns[k % len(patterns)] for k in range(len(domain))]
    named = {"field": "l", "type": "nominal", "legend": LEGEND if len(domain) > 1 else None}
    return {
        "color": {**named, "scale": {"domain": domain}},
        "strokeDash": {**named, "scale": {"domain": domain, "range": dashes}},
        "tooltip": [*tip(**tips), {"field": "l", "title": "run"}],
    }


def _rule(channel: str, signal: str, dash: Sequence[int] = ()) -> Spec:
    return {
        "data": {"values": [{}]},
        "transform": [{"calculate": signal, "as": "at"}],
        "mark": {"type": "rule", "clip": True, "strokeDash": list(dash), "strokeWidth": 1.4},
        "encoding": {channel: {"field": "at", "type": "quantitative"}},
    }


# --- figures


def verdicts(runs: Compared) -> Spec:
    """Return a strip of revolutions within and beyond the tolerance per run, with the verdict."""
    worst = {"op": "max", "field": "beyond", "as": "last"}, {"op": "max", "field": "r", "as": "end"}
    beyond = {"calculate": "datum.v + datum.d <= tolerance ? 0 : datum.r", "as": "beyond"}
    text = (
        f"datum.l + (indexof({json.dumps([*runs.unjudged])}, datum.l) >= 0 ? ': not judged, its end is not known' : "
        "datum.last >= datum.end ? ': not within the tolerance at the end' : "
        "': within the tolerance from revolution ' + floor(datum.last + 1) + ' on')"
    )
    where = {"field": "l", "type": "nominal", "sort": None, "axis": None, "scale": {"paddingInner": 0.0}}
    colour = {"field": "told", "type": "nominal", "scale": {"domain": ["within", "beyond"]}, "legend": None}
    spec = chart(
        46 * len(runs.sizes),
        data={"name": SIZES},
        transform=[beyond],
        encoding={"y": where},
        layer=[
            {
                "transform": [
                    {"calculate": "datum.r - 0.5", "as": "u"},
                    {"calculate": "datum.r + 0.5", "as": "u2"},
                    {"calculate": "datum.beyond ? 'beyond' : 'within'", "as": "told"},
                ],
                "mark": {"type": "bar", "height": 10, "yOffset": 10},
                "encoding": {
                    "x": quantity("u", "revolution", scale=axis_scale(ends=(0.5, runs.revolutions + 0.5))),
                    "x2": {"field": "u2"},
                    "color": colour,
                    "opacity": {"condition": {"test": "datum.beyond > 0", "value": 1.0}, "value": 0.35},
                    "tooltip": [*tip(r="revolution", v="largest [µm]"), {"field": "told", "title": "tolerance"}],
                },
            },
            {
                "transform": [{"aggregate": list(worst), "groupby": ["l"]}, {"calculate": text, "as": "t"}],
                "mark": {"type": "text", "align": "left", "baseline": "middle", "dy": -8, "fontSize": 13},
                "encoding": {"x": {"value": 4}, "text": {"field": "t"}},
            },
        ],
    )
    return _steered(runs, spec)


def _by_revolution(data: Spec, error: str, unit: str, names: Iterable[str]) -> Spec:
    """Return the largest error by revolution as lines, from a data set with r, v and the run l."""
    return {
        "data": data,
        "transform": [{"filter": "datum.v > 0"}],
        "mark": {"type": "line", "clip": True, "strokeWidth": 1.6},
        "encoding": {
            "x": quantity("r", "revolution", scale=axis_scale(), axis={"grid": False}),
            "y": quantity("v", f"largest {error} [{unit}]", scale=axis_scale(log=True)),
            **_by_run(names, r="revolution", v=f"largest [{unit}]"),
        },
    }


def convergence(runs: Compared) -> Spec:
    """Return the largest form error by revolution of all runs, with the chosen tolerance and revolution."""
    drawn = _by_revolution({"name": SIZES}, "form error", "µm", runs.sizes)
    return _steered(runs, chart(280, layer=[drawn, _rule("y", "tolerance", (6, 4)), _rule("x", "revolution")]))


def servo_error(results: Mapping[str, LoopResult], shown: int) -> Spec:
    """Return the largest error of a force or position loop by revolution of all runs, with the chosen revolution.

    Args:
        results: results of the loop by run, of one quantity.
        shown: revolution shown first.
    """
    quantity_ = next(iter(results.values())).loop.quantity
    data, limits = [], {}
    for name, result in results.items():
        sizes = Envelope()
        sizes.add(result.found.errors.largest)
        place, _, high = sizes.curve()
        data += rows(r=place + 1.0 + result.before, v=high * quantity_.scale, l=name)
        limits[name] = result.loop.tolerance * quantity_.scale
    line = _by_revolution({"values": data}, quantity_.error, quantity_.unit, results)
    tolerances = [_rule("y", str(number(limit)), (6, 4)) for limit in sorted({*limits.values()}) if limit > 0.0]
    spec = chart(240, layer=[line, *tolerances, _rule("x", "revolution")])
    return {**spec, "params": [{"name": "revolution", "value": shown}], "usermeta": {"signals": ["revolution"]}}


def maps(runs: Compared) -> list[Spec]:
    """Return the map of each run on one scale of colours, then those of the differences on their own."""
    found = []
    count = 0
    for group in (runs.maps, runs.differences):
        if not group:
            continue
        together = np.concatenate(list(group.values()))
        largest, linear = colour_range(together[np.isfinite(together).all(axis=1)])
        for name in group:
            found.append(_map(runs, count, name, largest, linear))
            count += 1
    return found


def _map(runs: Compared, place: int, name: str, largest: float, linear: float) -> Spec:
    end, across = runs.revolutions + 0.5, {"grid": False, "values": [0, 90, 180, 270, 360]}
    fields = {
        "data": {"name": MAPS},
        "transform": [
            *_placed(runs, _ACROSS, f"datum.m == {place} && isValid(datum.data)"),
            {"calculate": f"datum.n * {360 / _ACROSS}", "as": "u"},
            {"calculate": f"datum.u + {360 / _ACROSS}", "as": "u2"},
            {"calculate": "datum.r - 0.5", "as": "v"},
            {"calculate": f"min(datum.v + {runs.step}, {end})", "as": "v2"},
        ],
        **rectangles(
            quantity("u", "spindle angle [°]", scale=axis_scale(ends=(0, 360)), axis=across),
            quantity("v", "revolution", scale={**axis_scale(ends=(0.5, end)), "reverse": True}, axis={"grid": False}),
            {"field": "v2"},
            diverging("radius deviation [µm]", largest, linear),
            tip(u="spindle angle [°]", r="revolution", data="radius deviation [µm]"),
        ),
    }
    return _steered(runs, chart(260, title=name, layer=[fields, _rule("y", "revolution")]), renderer="canvas")


def profile(runs: Compared) -> Spec:
    """Return the radius deviation of all runs over the angle, at the chosen revolution."""
    spec = chart(
        220,
        data={"name": MAPS},
        transform=[*_chosen(runs, _ACROSS), {"calculate": f"datum.n * {360 / _ACROSS}", "as": "u"}],
        layer=[
            {
                "mark": {"type": "line", "clip": True, "strokeWidth": 1.6},
                "encoding": {
                    "x": quantity("u", "spindle angle [°]", scale=axis_scale(ends=(0, 360)), axis={"grid": False}),
                    "y": quantity("data", "radius deviation [µm]", axis={"format": ".3~g"}),
                    **_by_run(runs.maps, u="angle [°]", data="deviation [µm]"),
                },
            },
            _rule("y", "tolerance", (6, 4)),
            _rule("y", "-tolerance", (6, 4)),
        ],
    )
    return _steered(runs, spec)


def polar(runs: Compared) -> Spec:
    """Return the radius deviation of all runs around the part, at the chosen revolution and on one scale."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = rows(x=1.2 * np.cos(turn), y=1.2 * np.sin(turn), n=np.arange(turn.size))
    angle = f"datum.n * {2.0 * np.pi / _ACROSS}"
    where = {"scale": axis_scale(ends=(-2.4, 2.4)), "axis": None}
    spec = chart(
        _POLAR,
        encoding={"x": quantity("x", "", **where), "y": quantity("y", "", **where), "order": {"field": "n"}},
        layer=[
            {"data": {"values": circle}, "mark": {"type": "line", "color": "#888", "strokeDash": [4, 3]}},
            {
                "data": {"name": MAPS},
                "transform": [
                    *_chosen(runs, _ACROSS),
                    {"calculate": "abs(datum.data)", "as": "size"},
                    {"joinaggregate": [{"op": "max", "field": "size", "as": "most"}]},
                    {"calculate": f"(1.2 + datum.data / max(datum.most, 1e-9)) * cos({angle})", "as": "x"},
                    {"calculate": f"(1.2 + datum.data / max(datum.most, 1e-9)) * sin({angle})", "as": "y"},
                ],
                "mark": {"type": "line", "interpolate": "linear-closed", "strokeWidth": 1.6},
                "encoding": _by_run(runs.maps, data="deviation [µm]", most="outer circle [µm]"),
            },
        ],
    )
    return _steered(runs, spec, square=_POLAR)


def spectrum(runs: Compared) -> Spec:
    """Return the amplitudes of the undulations of all runs, at the chosen revolution."""
    spec = chart(
        220,
        data={"name": SPECTRA},
        transform=[
            *_chosen(runs, _ORDERS),
            {"calculate": "datum.n + 1", "as": "o"},
            {"filter": "datum.data > 0"},
        ],
        mark={"type": "line", "point": {"size": 18}, "clip": True, "strokeWidth": 1.2},
        encoding={
            "x": quantity(
                "o", "undulations per revolution", scale=axis_scale(ends=(0.5, _ORDERS + 0.5)), axis={"grid": False}
            ),
            "y": quantity("data", "amplitude [µm]", scale=axis_scale(log=True), axis={"format": ".2~g"}),
            **_by_run(runs.maps, o="undulations per revolution", data="amplitude [µm]"),
        },
    )
    return _steered(runs, spec)
