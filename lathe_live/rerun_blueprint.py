# SPDX-License-Identifier: Apache-2.0
"""Layout of a run in Rerun: form error at the top, part and error map on the left, curves on the right."""

from collections.abc import Collection, Mapping, Sequence

import rerun.blueprint as rrb

from lathe_live import rerun_part as parts
from lathe_live.rerun_signals import CYCLES, DRIVE, ERROR, PLOTS, POSITION, STATES, curve_path, curves
from lathe_rc import messages
from lathe_rc.event_log import LOGGED
from lathe_rc.judge.loops import ServoLoop

_LATEST_S, _LATEST_REVOLUTIONS = 0.3, 5  # range before the time cursor, in plots of fast signals
_FAST = {ERROR, POSITION, DRIVE}
LOOPS, LOOP_RESULTS = "loops", "loop_results"  #: entity paths of the force and position loops
_COLOURS = ("blue", "orange", "green")  # names of the colours of a plot's first curves


def _until_cursor(time: rrb.TimeRangeBoundary, revolution: rrb.TimeRangeBoundary) -> list[rrb.VisibleTimeRange]:
    """Return the visible time ranges from the given starts to the time cursor."""
    end = rrb.TimeRangeBoundary.cursor_relative(seq=0)
    starts = {"time": time, "revolution": revolution}
    return [rrb.VisibleTimeRange(timeline, start=start, end=end) for timeline, start in starts.items()]


_EVER = rrb.TimeRangeBoundary.infinite()
_SO_FAR = _until_cursor(_EVER, _EVER)  # finished rings stay visible
_LATEST = _until_cursor(  # this range sets the scale of a plot
    rrb.TimeRangeBoundary.cursor_relative(seconds=-_LATEST_S),
    rrb.TimeRangeBoundary.cursor_relative(seq=-_LATEST_REVOLUTIONS),
)


def _plots(types: Mapping[str, str], loops: Sequence[ServoLoop]) -> dict[str, rrb.TimeSeriesView]:
    """Return one plot per group of curves, for the curves that exist.

    Since a legend would cover the curves, the title names their colours instead if there are only a few.
    """
    paths: dict[str, list[str]] = {}
    labels: dict[str, list[str]] = {}
    for topic, fields in curves(types, loops).items():
        for field, curve in fields.items():
            paths.setdefault(curve.plot, []).append("/" + curve_path(topic, field))
            labels.setdefault(curve.plot, []).append(curve.label)

    def named(plot: str, unit: str) -> str:
        few = len(labels[plot]) <= len(_COLOURS) and len(set(labels[plot])) == len(labels[plot]) > 1
        which = [f"{label} {colour}" for label, colour in zip(labels[plot], _COLOURS, strict=False)] if few else []
        latest = [f"latest {_LATEST_S:g} s"] if plot in _FAST else []
        return ": ".join(filter(None, [f"{plot} [{unit}]", ", ".join([*which, *latest])]))

    return {
        plot: rrb.TimeSeriesView(
            origin="/signals",
            contents=paths[plot],
            name=named(plot, unit),
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=len(paths[plot]) > len(_COLOURS)),
            time_ranges=_LATEST if plot in _FAST else None,
        )
        for plot, unit in PLOTS.items()
        if plot in paths
    }


def _part() -> rrb.Vertical:
    middle = parts.LENGTH / 2
    return rrb.Vertical(
        rrb.Spatial3DView(
            origin="/machine",
            name="part; red: material left, blue: cut too deep",
            eye_controls=rrb.EyeControls3D(
                position=(1.5 * parts.RADIUS, 3.6 * parts.RADIUS, middle + 1.8 * parts.RADIUS),
                look_target=(-0.15 * parts.RADIUS, 0.0, middle),
                eye_up=(1.0, 0.0, 0.0),
            ),
            line_grid=False,
            background=rrb.Background(color=(24, 27, 33)),
            time_ranges=_SO_FAR,
        ),
        rrb.Spatial2DView(
            origin="/form_error/map",
            name="form error from 0° to 360°, a row a revolution, the first on top; red: material left",
        ),
        row_shares=[3, 2],
    )


def _loops(loops: Sequence[ServoLoop]) -> list[rrb.View]:
    """Return a plot of the error of each force or position loop by revolution, and a text with their results."""
    found: list[rrb.View] = [
        rrb.TimeSeriesView(
            origin=f"/{LOOPS}/{loop.node}",
            name=f"{loop.quantity.error}, {loop.node} [10^y {loop.quantity.unit}]: RMS blue, largest orange",
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for loop in loops
    ]
    return [*found, rrb.TextDocumentView(origin=f"/{LOOP_RESULTS}", name="force and position: results")] * bool(loops)


def blueprint(
    types: Mapping[str, str],
    *,
    live: bool = False,
    silent: Collection[str] = (),
    loops: Sequence[ServoLoop] = (),
    bands: bool = False,
) -> rrb.Blueprint:
    """Return the layout for a run with the given topics.

    Args:
        types: message type by topic.
        live: whether the view follows incoming data.
        silent: topics without messages.
        loops: force and position loops whose results are logged.
        bands: whether there are states, of a supervisor, faults or limits.
    """
    kinds = set(types.values())
    said = {kind for topic, kind in types.items() if topic not in silent}
    plots = _plots(types, loops)
    left = _part() if {messages.ENCODER, messages.TOOL} <= kinds else None
    cycles = sum(kind in CYCLES for kind in types.values())
    top: list[rrb.View] = []
    if left or kinds & {messages.LEARNING, messages.PERIODIC}:
        top.append(
            rrb.TimeSeriesView(
                origin="/learning",
                name="form error [10^y µm]: RMS blue, largest orange" + ", controllers green" * (cycles == 1),
                plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=cycles > 1),
            )
        )
    if left:
        top.append(
            rrb.BarChartView(
                origin="/form_error/spectrum",
                name="form error by harmonic, latest revolution [µm]",
                plot_legend=rrb.PlotLegend(visible=False),
            )
        )
    first = [plots.pop(plot) for plot in (ERROR, POSITION) if plot in plots]
    rows: list[rrb.View | rrb.Container] = [*first]
    tabs: list[rrb.View] = list(plots.values())
    if left:
        tabs += _loops(loops)
    else:
        top += _loops(loops)
    if live or said & {*LOGGED}:  # the live view reports dropped chunks there
        tabs.append(rrb.TextLogView(origin="/events", name="events"))
    if tabs:
        rows.append(rrb.Tabs(*tabs, active_tab=0))
    if bands:
        rows.append(rrb.StateTimelineView(origin=f"/{STATES}", name="states of the supervisor, faults, limits met"))
    above = [rrb.Horizontal(*top, column_shares=[3, 2, 3, 3][: len(top)])] if top else []
    right = rrb.Vertical(*rows)
    below = rrb.Horizontal(left, right, column_shares=[4, 5]) if left else right
    return rrb.Blueprint(
        rrb.Vertical(*above, below, row_shares=[2, 5] if above else [1]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following", playback_speed=1.0 if live else 0.1),
        auto_views=False,
    )
