# SPDX-License-Identifier: Apache-2.0
"""Self-contained HTML page of a sweep, and its figures as PNGs beside it.

`page_data` prepares the data, `effects` computes the statistics, and `figures` and `parallel` draw the figures.
"""

import math
import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from pathlib import Path
from typing import Any

import numpy as np

from lathe_explore.sweep import figures, row
from lathe_explore.sweep.best_cell import Surroundings, surroundings
from lathe_explore.sweep.effects import LEAST, Axis, Bins, Effect, Yield, bins, effect, groups, is_grid, total_effect
from lathe_explore.sweep.figures import Goal, said
from lathe_explore.sweep.folder import Folder
from lathe_explore.sweep.outcomes import outcomes
from lathe_explore.sweep.page_data import PageData, text_of
from lathe_explore.sweep.parallel import parallel
from lathe_rc import __version__, files
from lathe_rc.drawing.charts import Charts, page_template
from lathe_rc.errors import LatheError, shown

PAGE, FIGURES = "page.html", "figures"

_MOST_AXES = 6  # parameters offered for maps and lines
_MOST_LINES = 10  # axes of parallel coordinates
_MOST_FIELDS = 16_000  # total number of rows in the data sets of all pairs
_MOST_BINS = 24  # bins of an axis whose values are not shown individually
_MOST_ALONE = 200  # values of a sole parameter that are shown individually
_FIELD = 10  # mean number of cells per field where values are binned
_BEST = 10  # listed cells
_MOST_REASONS = 12
_NONE = "no result"  # column of effects: whether a cell has no value of the goal
_SCALE = 2.0  # scale of the PNGs
_NAMES = ("heat-map", "lines", "sensitivity", "parallel-coordinates", "yield")


@dataclass(frozen=True)
class Written:
    """Paths of the files written by `write`.

    Attributes:
        page: path of the HTML file.
        figures: paths of the PNGs.
    """

    page: Path
    figures: Sequence[Path]


def write(folder: Folder, goal: str = "") -> Written:
    """Write the page of a sweep, and its figures as PNGs, into the sweep's folder; existing files are replaced.

    Args:
        folder: folder of the sweep; the page shows the cells computed so far.
        goal: column by which the cells are ranked, see `PageData`.

    Raises:
        InputError: there is no such goal.
        LatheError: the files cannot be written.
    """
    seen = PageData(folder, goal)
    drawn = Charts()
    text = _text(seen, drawn)
    place, page = folder.path / FIGURES, folder.path / PAGE
    # All figures are drawn before any file is written, so after an error the old page still matches its figures.
    pngs = {place / f"{name}.png": drawn.png(name, _SCALE) for name in drawn.specs}
    try:
        place.mkdir(exist_ok=True)
        for old in {place / f"{name}.png" for name in _NAMES} - pngs.keys():
            old.unlink(missing_ok=True)
        for path, content in {**pngs, page: text.encode()}.items():
            with files.replacing(path) as stream:
                stream.write(content)
    except OSError as error:
        raise LatheError(
            f"{error.filename or page}: {error.strerror or shown(error)}; the rows are as they were"
        ) from None
    return Written(page, list(pngs))


def _text(seen: PageData, drawn: Charts) -> str:
    done = Yield(np.sort(seen.goal.values[seen.goal.order]), len(seen.cells), seen.goal.above)
    place = surroundings(seen)
    sections: dict[str, Any] = {"nothing": _nothing(seen)}
    if not sections["nothing"]:
        sections |= _sections(seen, done, drawn)
    return page_template(Path(__file__).with_name("page.html.j2")).render(
        title=f"Sweep of {seen.folder.name}",
        goal=seen.goal,
        default_goal=seen.folder.description.goal,
        cells=len(seen.cells),
        facts=_facts(seen, done, place),
        surroundings=place.sentences,
        asked=seen.asked(),
        seeds=seen.seeds,
        outcomes=_outcomes(seen),
        limits=_limits(seen),
        folder=shlex.quote(str(seen.folder.path)),
        version=__version__,
        least=LEAST,
        charts=drawn,
        **sections,
    )


def _nothing(seen: PageData) -> str:
    """Return the reason why nothing can be plotted; empty if there are results."""
    if not len(seen.cells):
        return "No cell is computed yet."
    if seen.goal.order.size:
        return ""
    told = ", ".join(f"{count} {status}" for status, count in seen.statuses.most_common())
    others = ", ".join(goal.name for goal in seen.goals)
    instead = f" What cells have is {others}: choose one with --goal." if others else ""
    return f"No cell has a {seen.goal.name}: {told}.{instead}"


def _facts(seen: PageData, done: Yield, place: Surroundings) -> Iterator[tuple[str, str, str]]:
    """Yield the key figures at the top of the page: name, value and CSS class."""
    yield "cells", str(len(seen.cells)), ""
    for status in (row.DONE, row.REFUSED, row.DIVERGED, row.FAILED):
        if count := seen.statuses[status]:
            yield status, str(count), "" if status == row.DONE else "bad"
    if done.goal.size:
        best, which = (done.goal[-1], "largest") if done.above else (done.goal[0], "smallest")
        yield f"{which} {seen.goal.name}", seen.goal.told(float(best)), "good" if place.sound else ""
        limit = done.point(0.95)
        kept = "not reached" if limit is None else seen.goal.told(limit)
        yield f"95 % of all cells {'from' if done.above else 'up to'}", kept, ""
    if seen.tolerance is not None:
        yield f"within {seen.goal.told(seen.tolerance)}", f"{done.share(seen.tolerance):.2%}", ""


def _outcomes(seen: PageData) -> list[list[str]]:
    """Return one row per outcome of the cells: status, number, share, and the reason of one cell as an example."""
    largest = outcomes(seen.table)
    found = [(each.status, each.cells, each.example) for each in largest[:_MOST_REASONS]]
    if rest := largest[_MOST_REASONS:]:
        found.append(("others", sum(each.cells for each in rest), f"{len(rest)} more reasons"))
    return [[status, str(count), f"{count / len(seen.cells):.1%}", told] for status, count, told in found]


def _limits(seen: PageData) -> str:
    """List the nodes that reached a limit, with the number of cells."""
    counts = Counter(name for text in seen.table.column("limits").to_pylist() if text for name in text.split(", "))
    return ", ".join(f"{name} in {count} cells" for name, count in counts.most_common())


def _sections(seen: PageData, done: Yield, drawn: Charts) -> dict[str, Any]:
    """Return the template's sections for cells with a goal value, and add their figures."""
    weighed = zip(seen.axes, effects_of(seen, [seen.goal], seen.axes)[seen.goal.name], strict=True)
    axes = [axis for axis, _ in sorted(weighed, key=lambda each: _weight(*each))]
    none = Goal(_NONE, _NONE, "", np.isnan(seen.goal.values).astype(np.float64))
    goals = [*seen.goals, *([none] if none.values.any() else [])]
    effects = effects_of(seen, goals, axes)
    mine = effects[seen.goal.name]
    told = parallel_note = ""
    if axes:
        told = _choices(seen, axes, drawn)
        drawn.add("sensitivity", {"": figures.sensitivity([axis.name for axis in axes], mine)})
        parallel_note = _parallel(seen, axes, drawn)
    drawn.add("yield", {"": figures.cumulative(done, seen.goal, seen.tolerance)})
    shares = [each.share for axis, each in zip(axes, mine, strict=True) if not axis.tied and each.share is not None]
    goals = [goal for goal in goals if any(found.share is not None for found in effects[goal.name])]
    return {
        "best": _best(seen),
        "choices": [axis.label for axis in axes[:_MOST_AXES]],
        "parameters": len(axes),
        "map_note": told,
        "parallel_note": parallel_note,
        "effects": {
            "columns": ["parameter", *(f"{goal.name} (log)" if goal.log else goal.name for goal in goals)],
            "rows": [
                [
                    f"{axis.name} (tied)" if axis.tied else axis.name,
                    *(_told(effects[goal.name][place]) for goal in goals),
                ]
                for place, axis in enumerate(axes)
            ],
        },
        "exact": is_grid(seen.axes, np.zeros(len(seen.cells))),
        "total": any(found.total is not None for found in mine),
        "missing": bool(none.values.any()),
        "rest": f"{round(1.0 - sum(shares), 3) + 0.0:.3f}" if shares else "",
        "yields": list(_yields(seen, done)),
    }


def effects_of(seen: PageData, goals: Sequence[Goal], axes: Sequence[Axis]) -> dict[str, list[Effect]]:
    """Return the effects of the parameters of a sweep on goals, by goal, in the order of ``axes``."""
    exact, lot = is_grid(axes, np.zeros(len(seen.cells))), seen.lot
    alike = groups(axes, seen.table.column("seed").to_numpy(zero_copy_only=False).astype(np.float64))
    drawn = (seen.cells % lot < 2) | (lot == 1)  # in a Saltelli sample only these cells are independent of each other
    found: dict[str, list[Effect]] = {}
    for goal in goals:
        values = np.log10(goal.values) if goal.log else goal.values
        for axis, group in zip(axes, alike, strict=True):
            each = effect(axis, np.where(drawn, values, np.nan), exact=exact)
            total = None if axis.tied else total_effect(group, values, exact=exact, lot=lot)
            if total is not None:
                each = replace(each, total=total[0], error=total[1])
            found.setdefault(goal.name, []).append(each)
    return found


def _weight(axis: Axis, found: Effect) -> tuple[bool, float, float]:
    """Return the sort key of a parameter: largest effect first, derived parameters last."""
    weight = found.share if found.total is None else found.total
    return axis.tied, math.inf if weight is None else -weight, -abs(found.rank or 0.0)


def _told(found: Effect) -> str:
    total, share, rank = figures.effect_said(found)
    alone = f"{share} ({rank})" if rank else share or "–"
    return f"{total}; {alone}" if total else alone


def _choices(seen: PageData, axes: Sequence[Axis], drawn: Charts) -> str:
    """Add heat maps and line plots of the parameters with the largest effects; return a note on cells and binning."""
    some = list(axes[:_MOST_AXES])
    free = [axis for axis in axes if not axis.tied]
    pairs = max(math.comb(len(some), 2), 1)
    # Individual values are shown only if the data sets of all pairs do not exceed the size limit of a page.
    exact = min(int(math.sqrt(_MOST_FIELDS / pairs)), len(seen.cells) // 2)
    exact = _MOST_ALONE if len(free) == 1 and pairs == 1 else exact
    most = int(np.clip(math.sqrt(len(seen.cells) / _FIELD), 4, _MOST_BINS))
    shown_: list[tuple[Axis, Bins]] = [(axis, bins(axis, exact, most)) for axis in some]
    for place, (axis, found) in enumerate(shown_):
        drawn.data[f"bins-{place}"] = figures.places(axis, found)
        drawn.data[f"one-{place}"] = figures.one(found, seen.goal.values)
    for low, high in combinations(range(len(some)), 2):
        drawn.data[f"pair-{low}-{high}"] = figures.pair(shown_[low][1], shown_[high][1], seen.goal.values)
    ordered = list(permutations(range(len(some)), 2))
    if ordered:
        drawn.add("heat-map", {f"{i}-{j}": figures.heat_map(shown_, i, j, seen.goal) for i, j in ordered}, "0-1")
    lines = {f"{i}-": figures.lines(shown_, i, None, seen.goal) for i in range(len(some))}
    lines |= {f"{i}-{j}": figures.lines(shown_, i, j, seen.goal) for i, j in ordered}
    drawn.add("lines", lines, "0-2" if len(some) > 2 else "0-1" if len(some) > 1 else "0-")
    told = f"All {len(seen.cells)} cells are in it."
    binned = [axis.name for axis, found in shown_ if found.count < axis.distinct.size]
    whose = "" if len(binned) == len(some) else f" of {', '.join(binned)}"
    return f"{told} Values{whose} are put into {most} bins of equal width." if binned else told


def _parallel(seen: PageData, axes: Sequence[Axis], drawn: Charts) -> str:
    """Add the parallel coordinates; return a note on the number of plotted cells."""
    some = list(axes[:_MOST_LINES])
    margin = next((goal for goal in seen.goals if goal.name == "margin" and goal is not seen.goal), None)
    if margin is not None and np.unique(margin.values[seen.goal.order]).size > 1:
        some.append(Axis(margin.name, margin.label, margin.values))
    if np.ptp(seen.goal.values[seen.goal.order]) > 0.0:
        some.append(Axis(seen.goal.name, seen.goal.label, seen.goal.values, log=seen.goal.log))
    found = parallel(some, seen.goal, seen.cells)
    drawn.add("parallel-coordinates", {"": found.spec})
    if found.lines == found.cells:
        return f"All {found.cells} cells with a result are in it."
    return f"{found.lines} of {found.cells} cells with a result are in it: the best, and others by lot."


def _best(seen: PageData) -> dict[str, Any]:
    """Return the table of the best cells, with their parameters and goals."""
    places = seen.goal.order[:_BEST].tolist()
    others = [
        goal
        for goal in seen.goals
        if goal is not seen.goal and goal.name.endswith((".rms_error", ".settling", "margin"))
    ]
    goals = [seen.goal, *others]
    some = seen.table.take(places)
    columns = [
        some.column("cell").to_pylist(),
        *([text_of(value) for value in some.column(target).to_pylist()] for target in seen.folder.targets),
        *([said(value) for value in goal.values[places].tolist()] for goal in goals),
    ]
    rows = list(zip(*columns, strict=True))
    return {"columns": ["cell", *seen.folder.targets, *(goal.label for goal in goals)], "rows": rows}


def _yields(seen: PageData, done: Yield) -> Iterator[str]:
    """Yield sentences about the share of cells within limits."""
    points = {share: done.point(share) for share in (0.95, 0.99)}
    for share, limit in points.items():
        if limit is not None:
            yield f"{share:.0%} of the cells have {'at least' if done.above else 'at most'} {seen.goal.told(limit)}."
    if missed := [share for share, limit in points.items() if limit is None]:
        yield f"Fewer than {missed[0]:.0%} come to a result."
    if seen.tolerance is not None:
        low, high = done.interval(seen.tolerance)
        sure = f", of all that could be drawn {low:.2%} to {high:.2%} (95 % confidence)" if seen.is_sampled else ""
        within = f"{done.share(seen.tolerance):.2%}"
        yield f"{within} are within the tolerance of {seen.goal.told(seen.tolerance)}{sure}."
    if done.goal.size < done.cells:
        yield f"{done.cells - done.goal.size} cells without a result count as beyond every limit."
