# SPDX-License-Identifier: Apache-2.0
"""Figure of a tuning: history of one goal, or the trade-off between the first and the last of several goals."""

import math
from pathlib import Path
from typing import Any, cast

import altair as alt

from lathe_explore.sweep.folder import writing
from lathe_explore.sweep.row import unit
from lathe_explore.sweep.tuning import Tuning

_WIDTH, _HEIGHT = 560, 300
_START, _FEASIBLE, _OTHER, _BEST = "#e08e0b", "#2f8fb0", "#8f979b", "#c0392b"
_KINDS = ("start", "meets all subjects", "does not")
_SHAPES = ["diamond", "circle", "cross"]


def _unit(tuning: Tuning, column: str) -> tuple[float, str, str]:
    """Return the factor from SI units, the unit in a title, and the expression of a tick; lengths have SI prefixes."""
    factor, name = unit(column, tuning.folder.scenario)
    if name == "µm":
        return 1.0, "", "datum.label && replace(format(datum.value, '~s'), regexp('[^0-9]?$'), ' $&m')"
    return factor, f" [{name}]" if name else "", "datum.label"


def _title(tuning: Tuning, column: str) -> str:
    percentile, name = tuning.objectives.percentile, _unit(tuning, column)[1]
    over = "" if tuning.cells == 1 else ", worst" if percentile == 100.0 else f", {percentile:g}th percentile"
    return f"{column}{over}{name}"


def chart(tuning: Tuning) -> alt.LayerChart:
    """Return the chart of a tuning.

    For one goal it shows the goal and the best value so far against the trial number; for several goals, the last goal
    against the first.
    """
    columns = [goal.column for goal in tuning.objectives.goals]
    factors = {column: _unit(tuning, column)[0] for column in columns}
    axes = [alt.Axis(labelExpr=_unit(tuning, column)[2]) for column in columns]
    front = {trial.number for trial in tuning.front}
    improvements = {trial.number for trial in tuning.improvements}
    rows: list[dict[str, Any]] = []
    best: float | None = None
    for trial in tuning.trials:
        goals = [value * factors[column] for column, value in tuning.goals(trial).items()]
        first, second = (value if math.isfinite(value) else None for value in (goals[0], goals[-1]))
        best = first if trial.number in improvements else best
        kind = _KINDS[0] if trial.number == 0 else _KINDS[1] if trial.score.feasible else _KINDS[2]
        told = {"trial": trial.number, "kind": kind, "first": first, "second": second, "best": best}
        rows.append(told | {"front": trial.number in front})
    legend = alt.Legend(orient="top")
    colour = alt.Color(
        "kind:N",
        title=None,
        scale=alt.Scale(domain=_KINDS, range=[_START, _FEASIBLE, _OTHER]),
        legend=legend,
    )
    base = alt.Chart(alt.InlineData(values=rows))
    scale = _scale(rows, "first")
    if len(columns) > 1:
        across = alt.X("first:Q", title=_title(tuning, columns[0]), scale=scale, axis=axes[0])
        up = alt.Y("second:Q", title=_title(tuning, columns[-1]), scale=_scale(rows, "second"), axis=axes[-1])
        line = base.transform_filter("datum.front").mark_line(color=_BEST).encode(across, up)
        tip = "second:Q"
    else:
        across = alt.X("trial:Q", title="trial")
        up = alt.Y("first:Q", title=_title(tuning, columns[0]), scale=scale, axis=axes[0])
        line = base.mark_line(color=_BEST, interpolate="step-after").encode(across, alt.Y("best:Q", scale=scale))
        tip = "kind:N"
    shape = alt.Shape("kind:N", title=None, scale=alt.Scale(domain=_KINDS, range=_SHAPES), legend=legend)
    dots = base.mark_point(size=60, filled=True, opacity=1.0).encode(
        across, up, colour, shape, tooltip=["trial:Q", alt.Tooltip("first:Q", format=".4~s"), tip]
    )
    text = f"Tuning of {tuning.folder.scenario.name}: {len(tuning.trials)} trials"
    without = sum(not all(map(math.isfinite, trial.score.costs)) for trial in tuning.trials)
    subtitle = f"{without} of them refused or diverged: not in the figure" if without else []
    title = alt.TitleParams(text, subtitle=subtitle)
    return cast("alt.LayerChart", alt.layer(dots, line).properties(width=_WIDTH, height=_HEIGHT, title=title))


def _scale(rows: list[dict[str, Any]], name: str) -> alt.Scale:
    """Return the scale of an axis: logarithmic if all values are positive and span more than a decade."""
    values = [row[name] for row in rows if row[name] is not None]
    log = bool(values) and min(values) > 0.0 and max(values) > 10.0 * min(values)
    return alt.Scale(type="log") if log else alt.Scale(zero=False)


def write(tuning: Tuning) -> Path:
    """Write the figure into the tuning's folder as history.png.

    Returns:
        The path of the PNG.

    Raises:
        LatheError: the file cannot be written.
    """
    path = tuning.folder.path / "history.png"
    with writing(tuning.folder.path):
        chart(tuning).save(str(path), scale_factor=2.0)
    return path
