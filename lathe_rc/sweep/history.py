# SPDX-License-Identifier: Apache-2.0
"""The figure of a tuning: its history or, of two goals, what has to be traded off."""

import math
from pathlib import Path
from typing import Any, cast

import altair as alt

from lathe_rc.sweep.folder import writing
from lathe_rc.sweep.tuned import Trial, Tuning

_WIDTH, _HEIGHT = 560, 300
_FEASIBLE, _OTHER, _BEST, _START = "#1f6f8b", "#c8cdd0", "#c0392b", "#e08e0b"


def unit(column: str) -> tuple[float, str]:
    """In what a column is shown: how many of the unit are 1, and its name."""
    return (1e6, "µm") if column.endswith("_error") else (1.0, "")


def _title(tuning: Tuning, place: int) -> str:
    goal = tuning.aims.goals[place]
    name = unit(goal.column)[1]
    over = ""
    if tuning.over.count(tuning.folder.scenario) > 1:
        percentile = tuning.aims.percentile
        over = ", worst" if percentile == 100.0 else f", {percentile:g}th percentile"
    return f"{goal.column}{over}{f' [{name}]' if name else ''}"


def _shown(tuning: Tuning, trial: Trial, place: int) -> float | None:
    goal, cost = tuning.aims.goals[place], trial.score.costs[place]
    return goal.sign * cost * unit(goal.column)[0] if math.isfinite(cost) else None


def chart(tuning: Tuning) -> alt.LayerChart:
    """By trial: the goal, and the best so far; of several goals, the second over the first."""
    rows: list[dict[str, Any]] = []
    best: float | None = None
    least = math.inf
    front = {trial.number for trial in tuning.front}
    several = len(tuning.aims.goals) > 1
    for trial in tuning.trials:
        values = [_shown(tuning, trial, place) for place in range(len(tuning.aims.goals))]
        if trial.score.feasible and trial.score.costs[0] < least:
            best, least = values[0], trial.score.costs[0]
        kind = "start" if trial.number == 0 else "meets all subjects" if trial.score.feasible else "does not"
        told = {"trial": trial.number, "kind": kind, "first": values[0], "second": values[-1], "best": best}
        rows.append(told | {"front": trial.number in front})
    kinds = ["start", "meets all subjects", "does not"]
    colour = alt.Color(
        "kind:N", title=None, scale=alt.Scale(domain=kinds, range=[_START, _FEASIBLE, _OTHER]),
        legend=alt.Legend(orient="top"),
    )  # fmt: skip
    base = alt.Chart(alt.InlineData(values=rows))
    if several:
        first, second = (
            alt.X("first:Q", title=_title(tuning, 0), scale=_scale(rows, "first")),
            alt.Y("second:Q", title=_title(tuning, 1), scale=_scale(rows, "second")),
        )
        line = base.transform_filter("datum.front").mark_line(color=_BEST).encode(first, second)
        dots = base.mark_circle(size=40).encode(first, second, colour, tooltip=["trial:Q", "first:Q", "second:Q"])
    else:
        scale = _scale(rows, "first")
        trials = alt.X("trial:Q", title="trial")
        line = base.mark_line(color=_BEST, interpolate="step-after").encode(
            trials, alt.Y("best:Q", scale=scale, title=_title(tuning, 0))
        )
        dots = base.mark_circle(size=40).encode(
            trials, alt.Y("first:Q", scale=scale), colour, tooltip=["trial:Q", "first:Q", "kind:N"]
        )
    text = f"Tuning of {tuning.folder.scenario.name}: {len(tuning.trials)} trials"
    without = sum(not all(map(math.isfinite, trial.score.costs)) for trial in tuning.trials)
    title = alt.TitleParams(
        text, subtitle=f"{without} of them refused or diverged: not in the figure" if without else []
    )
    return cast("alt.LayerChart", alt.layer(dots, line).properties(width=_WIDTH, height=_HEIGHT, title=title))


def _scale(rows: list[dict[str, Any]], name: str) -> alt.Scale:
    """Logarithmic, if all is above 0 and reaches over more than a decade."""
    values = [row[name] for row in rows if row[name] is not None]
    log = bool(values) and min(values) > 0.0 and max(values) > 10.0 * min(values)
    return alt.Scale(type="log") if log else alt.Scale(zero=False)


def write(tuning: Tuning) -> Path:
    """Write the figure to the tuning's folder, as history.png and, to look into it, history.html without network.

    Returns:
        The PNG.

    Raises:
        LatheError: it cannot be written.
    """
    made, folder = chart(tuning), tuning.folder.path
    with writing(folder):
        made.save(str(folder / "history.png"), scale_factor=2.0)
        made.save(str(folder / "history.html"), inline=True)
    return folder / "history.png"
