# SPDX-License-Identifier: Apache-2.0
"""A sweep as one HTML page that needs nothing else, and its figures as PNGs beside it; see `write`.

`seen` says what is looked at, `effects` computes, `figures` and `parallel` draw.
"""

import math
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, permutations
from pathlib import Path
from typing import Any

import numpy as np
import vl_convert

from lathe_rc import __version__, files
from lathe_rc.errors import LatheError, shown
from lathe_rc.sweep import figures, row
from lathe_rc.sweep.effects import LEAST, Axis, Bins, Effect, Yield, bins, effect, is_grid
from lathe_rc.sweep.figures import Goal, Rows, Spec, said
from lathe_rc.sweep.folder import Folder
from lathe_rc.sweep.parallel import parallel
from lathe_rc.sweep.seen import GOAL, Seen, text_of
from lathe_rc.view.page_template import page_template

PAGE, FIGURES = "page.html", "figures"

_MOST_AXES = 6  # that can be chosen for maps and lines
_MOST_LINES = 10  # axes of parallel coordinates
_MOST_FIELDS = 16_000  # rows of the data sets of all pairs
_MOST_BINS = 24  # of an axis whose values are not shown one by one
_MOST_ALONE = 200  # values of the only parameter that are shown one by one
_FIELD = 10  # cells of a field, on average, where values are put into bins
_BEST = 10  # cells that are listed
_MOST_REASONS = 12
_SCALE = 2.0  # of the PNGs
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_NAMES = ("heat-map", "lines", "sensitivity", "parallel-coordinates", "yield")
_LIGHT = {
    "font": "sans-serif",
    "background": "white",
    "view": {"stroke": None},
    "style": {
        "edge": {"stroke": "#888"},
        "halo": {"stroke": "white", "strokeWidth": 4, "fontSize": 11},
        "guide-label": {"fontSize": 11},
        "guide-title": {"fontSize": 11},
    },
}  #: looks of the PNGs; those of the page are in its script


@dataclass(frozen=True)
class Written:
    """The files that `write` has written.

    Attributes:
        page: the HTML file.
        figures: the PNGs.
    """

    page: Path
    figures: Sequence[Path]


@dataclass(eq=False)
class _Drawn:
    """Figures of a page: specifications by figure and choice, the data sets of them all, and which is shown first."""

    specs: dict[str, dict[str, Spec]] = field(default_factory=dict)
    first: dict[str, str] = field(default_factory=dict)
    data: dict[str, Rows] = field(default_factory=dict)

    def add(self, name: str, specs: Mapping[str, Spec], first: str = "") -> None:
        self.specs[name], self.first[name] = dict(specs), first

    def pngs(self) -> dict[str, bytes]:
        """The pictures by their names, each as it is shown first."""
        found = {}
        for name, specs in self.specs.items():
            spec = {**specs[self.first[name]], "config": _LIGHT}
            if name == "parallel-coordinates":
                found[name] = vl_convert.vega_to_png(spec, scale=_SCALE)
            else:
                found[name] = vl_convert.vegalite_to_png({**spec, "datasets": self.data}, scale=_SCALE)
        return found


def write(folder: Folder, goal: str = GOAL) -> Written:
    """Write the page of a sweep into its folder, and its figures as PNGs; older ones are replaced.

    Args:
        folder: of the sweep; what is computed so far is shown.
        goal: column by which the cells are judged.

    Raises:
        InputError: no such goal.
        LatheError: the disk does not take it.
    """
    seen = Seen(folder, goal)
    drawn = _Drawn()
    text = _text(seen, drawn)
    place, page = folder.path / FIGURES, folder.path / PAGE
    pngs = {place / f"{name}.png": png for name, png in drawn.pngs().items()}
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


def _text(seen: Seen, drawn: _Drawn) -> str:
    done = Yield(np.sort(seen.goal.values[seen.goal.order]), len(seen.cells), seen.goal.above)
    sections: dict[str, Any] = {"nothing": _nothing(seen)}
    if not sections["nothing"]:
        sections |= _sections(seen, done, drawn)
    return page_template(Path(__file__).with_name("page.html.j2")).render(
        title=f"Sweep of {seen.folder.scenario.name}",
        goal=seen.goal,
        cells=len(seen.cells),
        facts=_facts(seen, done),
        asked=seen.asked(),
        seeds=seen.seeds,
        outcomes=_outcomes(seen),
        limits=_limits(seen),
        folder=shlex.quote(str(seen.folder.path)),
        version=__version__,
        least=LEAST,
        specs=drawn.specs,
        first=drawn.first,
        data=drawn.data,
        script=vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;") if drawn.specs else "",
        **sections,
    )


def _nothing(seen: Seen) -> str:
    """Why nothing can be drawn; empty: something can."""
    if not len(seen.cells):
        return "No cell is computed yet."
    if seen.goal.order.size:
        return ""
    statuses = Counter(seen.table.column("status").to_pylist())
    told = ", ".join(f"{count} {status}" for status, count in statuses.most_common())
    others = ", ".join(goal.name for goal in seen.goals)
    instead = f" What cells have is {others}: choose one with --goal." if others else ""
    return f"No cell has a {seen.goal.name}: {told}.{instead}"


def _facts(seen: Seen, done: Yield) -> list[dict[str, str]]:
    """The figures at the top."""
    statuses = Counter(seen.table.column("status").to_pylist())
    found = [{"name": "cells", "value": str(len(seen.cells)), "mood": ""}]
    found += [
        {"name": status, "value": str(statuses[status]), "mood": "" if status == row.DONE else "bad"}
        for status in (row.DONE, row.REFUSED, row.DIVERGED, row.FAILED)
        if statuses[status]
    ]
    unit = f" {seen.goal.unit}" if seen.goal.unit else ""
    if done.goal.size:
        best, which = (done.goal[-1], "largest") if done.above else (done.goal[0], "smallest")
        found.append({"name": f"{which} {seen.goal.name}", "value": f"{said(float(best))}{unit}", "mood": "good"})
        limit = done.point(0.95)
        kept = "not reached" if limit is None else f"{said(limit)}{unit}"
        found.append({"name": f"95 % of all cells {'from' if done.above else 'up to'}", "value": kept, "mood": ""})
    if seen.tolerance is not None:
        share = f"{done.share(seen.tolerance):.2%}"
        found.append({"name": f"within {said(seen.tolerance)}{unit}", "value": share, "mood": ""})
    return found


def _outcomes(seen: Seen) -> list[list[str]]:
    """Status, how many, and why, with the numbers left out by which reasons differ; the first cell's as example."""
    groups: dict[tuple[str, str], list[int]] = {}
    statuses, reasons = seen.table.column("status").to_pylist(), seen.table.column("reason").to_pylist()
    for place, (status, reason) in enumerate(zip(statuses, reasons, strict=True)):
        groups.setdefault((status, _NUMBER.sub("…", reason or "")), []).append(place)
    largest = sorted(groups.items(), key=lambda item: -len(item[1]))
    found = []
    for (status, pattern), places in largest[:_MOST_REASONS]:
        told = f"cell {seen.cells[places[0]]}: {reasons[places[0]]}" if pattern else ""
        found.append([status, str(len(places)), f"{len(places) / len(seen.cells):.1%}", told])
    if rest := largest[_MOST_REASONS:]:
        count = sum(len(places) for _, places in rest)
        found.append(["others", str(count), f"{count / len(seen.cells):.1%}", f"{len(rest)} more reasons"])
    return found


def _limits(seen: Seen) -> str:
    """Which nodes came to a limit in how many cells."""
    counts = Counter(name for text in seen.table.column("limits").to_pylist() if text for name in text.split(", "))
    return ", ".join(f"{name} in {count} cells" for name, count in counts.most_common())


def _sections(seen: Seen, done: Yield, drawn: _Drawn) -> dict[str, Any]:
    """The sections of the template for cells that have a goal, and the figures."""
    grids = {goal.name: is_grid(seen.axes, goal.values) for goal in seen.goals}
    effects = {goal.name: [_effect(axis, goal, grid=grids[goal.name]) for axis in seen.axes] for goal in seen.goals}
    mine = effects[seen.goal.name]
    order = sorted(range(len(seen.axes)), key=lambda place: _weight(seen.axes[place], mine[place]))
    axes = [seen.axes[place] for place in order]
    told = parallel_note = ""
    if axes:
        told = _choices(seen, axes, drawn)
        names = [axis.name for axis in axes]
        drawn.add("sensitivity", {"": figures.sensitivity(names, [mine[place] for place in order])})
        parallel_note = _parallel(seen, axes, drawn)
    drawn.add("yield", {"": figures.cumulative(done, seen.goal, seen.tolerance)})
    shares = [mine[place].share for place in order if not seen.axes[place].tied]
    rest = 1.0 - sum(share for share in shares if share is not None)
    return {
        "best": _best(seen),
        "choices": [axis.label for axis in axes[:_MOST_AXES]],
        "parameters": len(axes),
        "map_note": told,
        "parallel_note": parallel_note,
        "effects": _effects(seen, effects, order),
        "exact": grids[seen.goal.name],
        "rest": f"{round(rest, 3) + 0.0:.3f}" if any(share is not None for share in shares) else "",
        "yields": _yields(seen, done),
    }


def _effect(axis: Axis, goal: Goal, *, grid: bool) -> Effect:
    return effect(axis, np.log10(goal.values) if goal.log else goal.values, exact=grid)


def _weight(axis: Axis, found: Effect) -> tuple[bool, float, float]:
    """By which parameters are put in order, the one that matters most first; those that follow from others last."""
    share = -math.inf if found.share is None else found.share
    return axis.tied, -share, -abs(found.rank or 0.0)


def _effects(seen: Seen, effects: Mapping[str, Sequence[Effect]], order: Sequence[int]) -> dict[str, Any]:
    """The table of what each goal depends on."""
    goals = [goal for goal in seen.goals if any(found.share is not None for found in effects[goal.name])]
    columns = ["parameter", *(f"{goal.name} (log)" if goal.log else goal.name for goal in goals)]
    names = [f"{axis.name} (tied)" if axis.tied else axis.name for axis in seen.axes]
    rows = [[names[place], *(_told(effects[goal.name][place]) for goal in goals)] for place in order]
    return {"columns": columns, "rows": rows}


def _told(found: Effect) -> str:
    share, rank = figures.effect_said(found)
    return f"{share} ({rank})" if rank else share or "–"


def _choices(seen: Seen, axes: Sequence[Axis], drawn: _Drawn) -> str:
    """Maps and lines of the parameters that matter most; says what of the cells is in them."""
    some = list(axes[:_MOST_AXES])
    free = [axis for axis in axes if not axis.tied]
    pairs = max(math.comb(len(some), 2), 1)
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


def _parallel(seen: Seen, axes: Sequence[Axis], drawn: _Drawn) -> str:
    """Parallel coordinates; says which cells are in them."""
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


def _best(seen: Seen) -> dict[str, Any]:
    """The table of the best cells."""
    places = seen.goal.order[:_BEST].tolist()
    others = [goal for goal in seen.goals if goal is not seen.goal and goal.name in ("tool.rms_error", "margin")]
    goals = [seen.goal, *others]
    some = seen.table.take(places)
    columns = [
        some.column("cell").to_pylist(),
        *([text_of(value) for value in some.column(target).to_pylist()] for target in seen.folder.targets),
        *([said(value) for value in goal.values[places].tolist()] for goal in goals),
    ]
    rows = list(zip(*columns, strict=True))
    return {"columns": ["cell", *seen.folder.targets, *(goal.label for goal in goals)], "rows": rows}


def _yields(seen: Seen, done: Yield) -> list[str]:
    """The sentences about the yield."""
    unit = f" {seen.goal.unit}" if seen.goal.unit else ""
    bound = "at least" if done.above else "at most"
    points = {share: done.point(share) for share in (0.95, 0.99)}
    found = [
        f"{share:.0%} of the cells have {bound} {said(limit)}{unit}."
        for share, limit in points.items()
        if limit is not None
    ]
    found += [f"Fewer than {share:.0%} come to a result." for share, limit in points.items() if limit is None][:1]
    if seen.tolerance is not None:
        low, high = done.interval(seen.tolerance)
        sure = f", of all that could be drawn {low:.2%} to {high:.2%} (95 % confidence)" if seen.is_sampled else ""
        found.append(
            f"{done.share(seen.tolerance):.2%} are within the tolerance of {said(seen.tolerance)}{unit}{sure}."
        )
    if done.goal.size < done.cells:
        found.append(f"{done.cells - done.goal.size} cells without a result count as beyond every limit.")
    return found
