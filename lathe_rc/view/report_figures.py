# SPDX-License-Identifier: Apache-2.0
"""The figures of a report, as SVG: light, printable, and all in one style."""

import base64
import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes

from lathe_rc.analysis.metrology import Lay
from lathe_rc.messages import Samples
from lathe_rc.view.report_form import Form, Revolution
from lathe_rc.view.report_gather import Gathered
from lathe_rc.view.report_host import Host
from lathe_rc.view.report_series import Envelope

FIRST, LAST, BEST = "#c0392b", "#1f6f8b", "#d08a1d"
_GREY = "#999999"
_COLOURS = (LAST, FIRST, BEST, "#5b7f3a")
_CYCLE_COLOURS = (FIRST, BEST, "#5b7f3a", "#7d5a9b")
_WIDTH = 9.2  # [in]
_TICKS = 8  # font size
_LONGEST_LABEL = 60  # characters
LONGEST_LENGTH = 1e3  #: that is drawn [m]
_MOST_VALUE = 1e12  # of other signals
FLOOR = 1e-3  #: size of a form error that a figure takes for the least [µm]
_ALMOST = 1e-9  # of their size, by which numbers differ that count as two
STYLE: Any = {"svg.hashsalt": "lathe_rc", "axes.titlesize": 10, "axes.labelsize": 9, "legend.fontsize": 8}
STYLE |= {"xtick.labelsize": _TICKS, "ytick.labelsize": _TICKS}


def plain(text: str) -> str:
    """A text from a bag, for a label: short, and without what matplotlib takes for formulas."""
    shown = text[:_LONGEST_LABEL].encode("ascii", "replace").decode()
    return "".join(letter if letter.isprintable() else "?" for letter in shown).replace("$", r"\$")


def um(length: Samples) -> Samples:
    """Lengths [m] in µm; absurd ones are cut at 1 km, for figures of a bag that holds just anything."""
    cut: Samples = np.clip(np.nan_to_num(length), -LONGEST_LENGTH, LONGEST_LENGTH) * 1e6
    return cut


def limited(values: Samples) -> Samples:
    """Other signals; absurd values are cut."""
    cut: Samples = np.clip(values, -_MOST_VALUE, _MOST_VALUE)
    return cut


def colour_range(rows: Samples) -> tuple[float, float]:
    """Largest magnitude of a map [µm], and up to which its colours are linear: the largest of its quietest quarter.

    So the first cycles, the rest, and a fault can be seen.
    """
    each = np.sort(np.abs(rows).max(axis=1))
    largest = max(float(each[-1]), FLOOR)
    return largest, min(max(float(each[(len(each) - 1) // 4]), largest * 1e-4), largest)


def spectrum_range(form: Form) -> tuple[float, float]:
    """Range of amplitudes [µm] in which each shown revolution has three decades; (0, 0) without any amplitude."""
    tops = [float(um(revolution.amplitude[1:]).max()) for _, _, revolution in shown_revolutions(form)]
    tops = [top for top in tops if top > 0.0]
    return (min(min(tops) * 1e-3, max(tops) * 1e-6), max(tops) * 2.0) if tops else (0.0, 0.0)


def _figure(height: float) -> Figure:
    return Figure(figsize=(_WIDTH, height), layout="constrained")


def _svg(figure: Figure) -> str:
    """The figure as a data URI."""
    image = io.BytesIO()
    figure.savefig(image, format="svg", dpi=150, metadata={"Date": None, "Creator": None})
    return "data:image/svg+xml;base64," + base64.b64encode(image.getvalue()).decode()


def _grid(axes: Axes) -> None:
    axes.grid(visible=True, which="major", alpha=0.3)


def _band(axes: Axes, place: Samples, low: Samples, high: Samples, colour: str, label: str | None = None) -> None:
    """An envelope: a line where it is thin."""
    axes.fill_between(place, low, high, color=colour, alpha=0.35, lw=0)
    axes.plot(place, (low + high) / 2, color=colour, lw=1.0, label=label)


def form_map(form: Form) -> str:
    """Radius deviation by revolution and angle."""
    rows = um(form.map.rows())
    figure = _figure(3.6)
    axes = figure.subplots()
    largest, linear = colour_range(rows)
    revolutions = np.minimum(np.arange(len(rows) + 1) * form.map.group, form.map.size) + 0.5
    degrees = np.linspace(0, 360, rows.shape[1] + 1)
    norm = SymLogNorm(linear, linscale=1.0, vmin=-largest, vmax=largest, base=10)
    mesh = axes.pcolormesh(degrees, revolutions, rows, norm=norm, cmap="RdBu_r", rasterized=True)
    axes.set(xlabel="spindle angle [°]", ylabel="revolution", xticks=range(0, 361, 45))
    axes.invert_yaxis()
    bar = figure.colorbar(mesh, ax=axes, pad=0.01)
    ticks = np.array([linear, largest] if largest > 3 * linear else [largest])
    bar.set_ticks([*-ticks[::-1], 0.0, *ticks], labels=[f"{tick:.3g}" for tick in (*-ticks[::-1], 0.0, *ticks)])
    bar.ax.minorticks_off()
    bar.set_label("radius deviation [µm]", fontsize=9)
    return _svg(figure)


def along(surface: Lay) -> str:
    """The surface along the part over angle and height, and one trace of it."""
    figure = _figure(3.2)
    whole, trace = figure.subplots(1, 2, width_ratios=(3, 2))
    closed = um(np.concatenate((surface.surface, surface.surface[:1])))
    place = np.clip(surface.height, -LONGEST_LENGTH, LONGEST_LENGTH) * 1e3
    degrees = np.linspace(0, 360, closed.shape[0])
    mesh = whole.pcolormesh(degrees, place, closed.T, shading="gouraud", cmap="viridis", rasterized=True)
    whole.set(xlabel="spindle angle [°]", ylabel="height [mm]", xticks=range(0, 361, 90))
    figure.colorbar(mesh, ax=whole, pad=0.01).set_label("radius deviation [µm]", fontsize=9)
    trace.plot(place, closed[0], color=LAST, lw=1.0)
    trace.set(xlabel="height [mm]", ylabel="radius deviation at 0° [µm]")
    _grid(trace)
    return _svg(figure)


def polar(form: Form) -> str:
    """Radius deviation of the first and the last revolution, each in its own scale."""
    assert form.first, "there is no revolution"
    assert form.last, "there is no revolution"
    figure = _figure(4.1)
    for place, (revolution, colour) in enumerate(((form.first, FIRST), (form.last, LAST)), start=1):
        axes = figure.add_subplot(1, 2, place, projection="polar")
        assert isinstance(axes, PolarAxes)
        deviation = um(np.append(revolution.profile, revolution.profile[0]))
        angle = np.linspace(0, 2 * np.pi, deviation.size)
        size = max(float(np.abs(deviation).max()), FLOOR)
        axes.plot(angle, np.zeros_like(angle), color="#444444", lw=1.1, ls="--")
        axes.plot(angle, deviation, color=colour, lw=1.3)
        axes.set_rlim(-2.2 * size, 1.15 * size)
        axes.set_rticks([-size, 0.0, size], [f"{-size:.3g}", "0", f"{size:.3g} µm"])
        axes.set_rlabel_position(67)
        number, rms = revolution.numbers["revolution"], revolution.numbers["rms"]
        axes.set_title(f"revolution {number}: {rms:.3g} µm RMS", color=colour)
    return _svg(figure)


def shown_revolutions(form: Form) -> list[tuple[str, str, Revolution]]:
    """Name, colour and revolution: first, best and last, each once."""
    shown: dict[int, tuple[str, str, Revolution]] = {}
    for name, colour, revolution in (
        ("first", FIRST, form.first),
        ("best", BEST, form.best),
        ("last", LAST, form.last),
    ):
        if revolution:
            number = revolution.numbers["revolution"]
            names = f"{shown[number][0]}, {name}" if number in shown else name
            shown[number] = names, colour, revolution
    return list(shown.values())


def spectrum(form: Form) -> str:
    """Amplitude by undulations per revolution."""
    figure = _figure(3.0)
    axes = figure.subplots()
    shown = shown_revolutions(form)
    width = 0.8 / len(shown)
    for k, (name, colour, revolution) in enumerate(shown):
        amplitude = um(revolution.amplitude[1:])
        order = np.arange(1, amplitude.size + 1)
        label = f"{name} revolution ({revolution.numbers['revolution']})"
        axes.bar(order + (k - (len(shown) - 1) / 2) * width, amplitude, width, color=colour, label=label)
    axes.set(xlabel="undulations per revolution", ylabel="amplitude [µm]", xlim=(0.4, 50.6))
    low, high = spectrum_range(form)
    if high:
        axes.set(yscale="log", ylim=(low, high))
    _grid(axes)
    axes.legend(loc="upper right")
    return _svg(figure)


def convergence(form: Form | None, cycles: Mapping[str, Envelope]) -> str:
    """Form error by revolution, and by name what the controllers say of each cycle [m]."""
    figure = _figure(3.2)
    axes = figure.subplots()
    if form and form.rms.size:
        for series, colour, label in (
            (form.largest, _GREY, "form error, largest"),
            (form.rms, LAST, "form error, RMS"),
        ):
            place, low, high = series.curve()
            _band(axes, place + 1, um(low), um(high), colour, label)
    for (name, series), colour in zip(cycles.items(), _CYCLE_COLOURS, strict=False):
        place, low, high = series.curve()
        axes.plot(place + 1, (um(low) + um(high)) / 2, ".", color=colour, ms=4, label=plain(name))
    if form and form.tolerance:
        limit = form.tolerance * 1e6
        axes.axhline(limit, color=_GREY, lw=1.0, ls="--", label=f"tolerance {limit:.3g} µm")
    axes.set(xlabel="revolution or cycle", ylabel="error [µm]", yscale="log")
    _grid(axes)
    axes.legend(loc="upper right")
    return _svg(figure)


def against_time(told: Gathered, curves: Mapping[str, Envelope], unit: str, scale: float) -> str:
    """Signals by simulated time, their extremes as a band.

    Args:
        told: for the time.
        curves: by name.
        unit: of the axis, with its quantity.
        scale: from the signals' unit to that one.
    """
    figure = _figure(2.5)
    axes = figure.subplots()
    for (name, series), colour in zip(curves.items(), _COLOURS, strict=False):
        place, low, high = series.curve()
        low, high = limited(np.array([low, high])) * scale
        _band(axes, told.at(place), low, high, colour, plain(name))
    axes.set(xlabel="time since sample 0 [s]", ylabel=unit)
    axes.set_xmargin(0.01)
    _grid(axes)
    if len(curves) > 1:
        axes.legend(loc="upper right")
    return _svg(figure)


def _told_apart(numbers: Samples) -> tuple[float, float] | None:
    """Range of a histogram; numbers that are all but the same get one that can be cut into bins."""
    if not numbers.size:
        return None
    low, high = float(numbers.min()), float(numbers.max())
    least = _ALMOST * max(abs(low), abs(high))
    return (low, high) if high - low > least else (low - 0.5 - least, high + 0.5 + least)


@dataclass(frozen=True)
class Histogram:
    """Counts of bins.

    Attributes:
        counts: shape (bins,).
        edges: shape (bins + 1,).
        across, up: what the axes say.
        log: the bins are as wide as they are far from 0.
    """

    counts: Samples
    edges: Samples
    across: str
    up: str
    log: bool = False


def histograms(host: Host, step: float) -> dict[str, Histogram]:
    """Of pace, and of lateness and latency of blocks where there are any; ``step`` in s."""
    numbers = limited(host.pace.values()) * step
    bins = min(30, max(5, numbers.size // 3))
    counts, edges = np.histogram(numbers, bins=bins, range=_told_apart(numbers))
    found = {"pace": Histogram(counts, edges, "simulated by wall time [s/s]", "reports")}
    for name, across, durations in (
        ("lateness", "let go after it was due [ms]", host.lateness),
        ("latency", "until completed by all [ms]", host.latency),
    ):
        if any(any(each.counts) for each in durations.values()):
            counts = np.sum([each.counts for each in durations.values()], axis=0)
            used = np.flatnonzero(counts)
            edges = 2.0 ** np.arange(used[0] - 1, used[-1] + 1) * 1e-3
            found[name] = Histogram(counts[used[0] : used[-1] + 1], edges, across, "blocks", log=True)
    return found


def timing(host: Host, step: float) -> str:
    """The figure of `histograms`."""
    figure = _figure(2.8)
    found = histograms(host, step)
    colours = {"pace": _GREY, "lateness": BEST, "latency": LAST}
    for axes, (name, each) in zip(figure.subplots(1, len(found), squeeze=False)[0], found.items(), strict=True):
        axes.stairs(each.counts, each.edges, fill=True, color=colours[name], edgecolor="white", lw=0.5)
        axes.set(xscale="log" if each.log else "linear", xlabel=each.across, ylabel=each.up, title=name)
        if not each.log:
            axes.yaxis.get_major_locator().set_params(integer=True)
        _grid(axes)
    return _svg(figure)
