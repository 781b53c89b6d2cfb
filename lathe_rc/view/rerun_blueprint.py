# SPDX-License-Identifier: Apache-2.0
"""How a run opens in Rerun: the part and its error map on the left, curves on the right."""

from collections.abc import Mapping

import rerun.blueprint as rrb

from lathe_rc import messages
from lathe_rc.event_log import LOGGED
from lathe_rc.view import rerun_part as parts
from lathe_rc.view.rerun_signals import ERROR, PLOTS, POSITION, curve_path, curves

_LATEST_S, _LATEST_REVOLUTIONS = 0.3, 5  # before the time cursor, in plots of fast signals
_FAST = {ERROR, POSITION}


def _so_far() -> list[rrb.VisibleTimeRange]:
    """Everything up to the time cursor: rings that have been turned stay."""
    end = rrb.TimeRangeBoundary.cursor_relative(seq=0)
    return [
        rrb.VisibleTimeRange(timeline, start=rrb.TimeRangeBoundary.infinite(), end=end)
        for timeline in ("time", "revolution")
    ]


def _latest() -> list[rrb.VisibleTimeRange]:
    """The range shortly before the time cursor: the plot takes its scale from that."""
    starts = {
        "time": rrb.TimeRangeBoundary.cursor_relative(seconds=-_LATEST_S),
        "revolution": rrb.TimeRangeBoundary.cursor_relative(seq=-_LATEST_REVOLUTIONS),
    }
    end = rrb.TimeRangeBoundary.cursor_relative(seq=0)
    return [rrb.VisibleTimeRange(timeline, start=start, end=end) for timeline, start in starts.items()]


def _plots(types: Mapping[str, str]) -> dict[str, rrb.TimeSeriesView]:
    """A plot of curves each, of those that there are."""
    paths: dict[str, list[str]] = {}
    for topic, fields in curves(types).items():
        for field, curve in fields.items():
            paths.setdefault(curve.plot, []).append("/" + curve_path(topic, field))
    return {
        plot: rrb.TimeSeriesView(
            origin="/signals",
            contents=paths[plot],
            name=f"{plot} [{unit}]" + (f", latest {_LATEST_S:g} s" if plot in _FAST else ""),
            plot_legend=rrb.Corner2D.LeftTop,
            time_ranges=_latest() if plot in _FAST else None,
        )
        for plot, unit in PLOTS.items()
        if plot in paths
    }


def _part() -> rrb.Vertical:
    middle = parts.LENGTH / 2
    return rrb.Vertical(
        rrb.Spatial3DView(
            origin="/machine",
            name="part, colour: form error",
            eye_controls=rrb.EyeControls3D(
                position=(1.3 * parts.RADIUS, 3.2 * parts.RADIUS, middle + 1.6 * parts.RADIUS),
                look_target=(-0.15 * parts.RADIUS, 0.0, middle),
                eye_up=(1.0, 0.0, 0.0),
            ),
            line_grid=False,
            background=rrb.Background(color=(24, 27, 33)),
            time_ranges=_so_far(),
        ),
        rrb.TensorView(
            origin="/form_error/map",
            name="form error over angle: log10 |µm|",
            scalar_mapping=rrb.TensorScalarMapping(colormap=parts.COLOURS, mag_filter="nearest"),
            view_fit="fill",
        ),
        row_shares=[3, 2],
    )


def blueprint(types: Mapping[str, str], *, live: bool = False) -> rrb.Blueprint:
    """The layout for a run with these topics.

    Args:
        types: message type by topic.
        live: the picture follows what comes in.
    """
    kinds = set(types.values())
    plots = _plots(types)
    left = _part() if {messages.ENCODER, messages.TOOL} <= kinds else None
    top: list[rrb.View] = []
    if left or kinds & {messages.LEARNING, messages.PERIODIC}:
        top.append(
            rrb.TimeSeriesView(
                origin="/learning", name="learning: log10 of the error in µm", plot_legend=rrb.Corner2D.RightTop
            )
        )
    if left:
        top.append(rrb.BarChartView(origin="/form_error/spectrum", name="form error by harmonic [µm]"))
    first = [plots.pop(plot) for plot in (ERROR, POSITION) if plot in plots]
    rows: list[rrb.View | rrb.Container] = [rrb.Horizontal(*top)] if top else []
    rows += first
    tabs: list[rrb.View] = list(plots.values())
    if live or kinds & {*LOGGED}:  # live, what had to be left out stands there
        tabs.append(rrb.TextLogView(origin="/events", name="events"))
    if tabs:
        rows.append(rrb.Tabs(*tabs, active_tab=0))
    right = rrb.Vertical(*rows)
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[4, 5]) if left else right,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following", playback_speed=1.0 if live else 0.1),
        auto_views=False,
    )
