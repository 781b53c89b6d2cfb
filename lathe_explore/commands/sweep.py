# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe sweep``: compute variations of a scenario into a table, and show the table."""

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click
from click.shell_completion import CompletionItem

import lathe_explore
import lathe_rc
from lathe_explore.commands import options as many
from lathe_rc import extras
from lathe_rc.commands import completers, options
from lathe_rc.errors import InputError, LatheError
from lathe_rc.names import pairs

if TYPE_CHECKING:
    from rich.console import RenderableType

    from lathe_explore.sweep.outcomes import CellsOutcome
    from lathe_explore.sweep.page import Written
    from lathe_explore.sweep.sweep import Sweep

_REASONS = 6  # number of displayed reasons


def check_crew(scheduler: str | None, workers: int | None) -> None:
    """Reject local workers in combination with those of a scheduler."""
    if scheduler and workers:
        raise InputError("--workers with --scheduler; allowed: one of them: a scheduler has its own workers")


class _Sweep(options.GroupWithDefault):
    """Command group in which ``lathe sweep SCENARIO`` is short for ``lathe sweep run SCENARIO``."""

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete commands and scenarios."""
        return [*super().shell_complete(ctx, incomplete), *completers.scenarios(ctx, None, incomplete)]


@click.group(cls=_Sweep, default="run")
def sweep() -> None:
    """Compute many variations of a scenario into a table: lathe sweep SCENARIO --vary NODE.PARAM=LOW:HIGH:COUNT."""


def space_of(
    vary: Sequence[str],
    draw: Sequence[str],
    tie: Sequence[str],
    seeds: int,
    sampling: many.Sampling,
    cells: Path | None = None,
    carry: Sequence[str] = (),
    columns: Sequence[str] = (),
) -> "lathe_explore.Space":
    """Return the space given by options; with a sample, ranges without a count are sampled."""
    from lathe_explore.sweep.space import Space
    from lathe_rc.cell import cells_file
    from lathe_rc.signals.quantities import parse_columns

    varied = pairs("--vary", vary, "NODE.PARAM=LOW:HIGH:COUNT, =LOW:HIGH:COUNT:log, =A,B,C, or =LOW:HIGH of a --sample")
    drawn = pairs("--draw", draw, "NODE.PARAM=normal:DEVIATION, =normal:MEAN:DEVIATION or =uniform:LOW:HIGH")
    sample, sample_seed, correlated = sampling
    ranges = {target: text for target, text in varied.items() if sample and text.removesuffix(":log").count(":") == 1}
    if (carry or columns) and not cells:
        option = f"--carry {carry[0]}" if carry else f"--column {columns[0]}"
        raise InputError(f"{option} without --cells; allowed: a column of the file of --cells")
    return Space(
        grid={target: text for target, text in varied.items() if target not in ranges},
        sampled=ranges | drawn,
        correlated={pair: _number(pair, text) for pair, text in pairs("--correlate", correlated, "A,B=NUMBER").items()},
        ties=pairs("--tie", tie, "NODE.PARAM=FORMULA"),
        sample=sample,
        sample_seed=sample_seed,
        seeds=seeds,
        given=cells_file.read(cells, carry, parse_columns(columns, names=())) if cells else (),
        carried=carry,
    )


def _number(pair: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--correlate {pair}={text}; allowed: a number above -1 and below 1") from None


@sweep.command()
@options.scenario
@options.of_targets(
    "--vary", metavar="NODE.PARAM=RANGE", help="LOW:HIGH:COUNT[:log] or A,B,C; % of the scenario's value"
)
@options.of_targets(
    "--draw",
    metavar="NODE.PARAM=LAW",
    help="normal:DEVIATION, normal:MEAN:DEVIATION, uniform:LOW:HIGH, or NAME:ARG=NUMBER of scipy.stats",
)
@many.tie
@many.sampling
@many.seeds
@click.option("--cells", type=options.PATH, help="CSV or YAML file with a cell a row")
@click.option("--carry", multiple=True, metavar="COLUMN", help="column of --cells that goes into the rows as text")
@click.option(
    "--column",
    "columns",
    multiple=True,
    metavar="TARGET=COLUMN[:FACTOR]",
    help="where --cells names a target otherwise, or in another unit; repeatable",
)
@many.measures
@click.option(
    "--models",
    type=click.Choice(["follow", "nominal"]),
    default="follow",
    show_default=True,
    help="what controllers take for a drive that is varied: as it is, or as the scenario has it",
)
@click.option("--retry", is_flag=True, help="compute failed cells again")
@many.many_cells("sweep-SCENARIO")
def run(
    scenario: str,
    vary: tuple[str, ...],
    draw: tuple[str, ...],
    tie: tuple[str, ...],
    sampling: many.Sampling,
    seeds: int,
    cells: Path | None,
    carry: tuple[str, ...],
    columns: tuple[str, ...],
    overrides: tuple[str, ...],
    revolutions: float | None,
    start_from: Path | None,
    out: Path | None,
    scheduler: str | None,
    workers: int | None,
    *,
    as_json: bool,
    **how: Any,
) -> None:
    """Compute variations of a SCENARIO into a table; existing rows are not computed again."""
    from lathe_explore.commands.progress import SweepWatch
    from lathe_rc.commands import scenario as scenarios

    check_crew(scheduler, workers)
    loaded = scenarios.load(scenario, overrides, revolutions=revolutions, start_from=start_from)
    if not (vary or draw or cells or seeds > 1):
        raise InputError("nothing varies; allowed: --vary, --draw, --cells or --seeds (lathe run computes one cell)")
    space = space_of(vary, draw, tie, seeds, sampling, cells, carry, columns)
    place = out or Path(f"sweep-{loaded.name}")
    with SweepWatch(place, quiet=as_json) as watch:
        found = lathe_explore.run_sweep(loaded, space, place, scheduler=scheduler, workers=workers, watch=watch, **how)
    _show(found, as_json=as_json)
    statuses = found.statuses()
    if not statuses.get("done"):
        raise LatheError(f"no cell of {place} came to a result")
    if failed := statuses.get("failed"):
        raise LatheError(f"{failed} cells of {place} failed; --retry computes them again")


def _show(found: "Sweep", goals: Sequence[str] = (), written: "Written | None" = None, *, as_json: bool) -> None:
    from lathe_rc.commands import tables

    top, folder = found.best(*goals), found.folder
    summary = {"folder": str(folder.path), "scenario": folder.name, "statuses": found.statuses(), "best": top}
    reasons = [each for each in found.outcomes() if each.reason]
    summary["reasons"] = [each._asdict() for each in reasons]
    if written:
        summary |= {"page": str(written.page), "figures": [str(path) for path in written.figures]}
    tables.show(summary, _told(found, summary, reasons, goals, written), as_json=as_json)
    if goals and not top:
        raise LatheError(f"no cell of {folder.path} has a value of {' and '.join(goals)}")


def _told(
    found: "Sweep",
    summary: dict[str, Any],
    reasons: Sequence["CellsOutcome"],
    goals: Sequence[str],
    written: "Written | None",
) -> Iterator["RenderableType"]:
    from lathe_rc.commands.tables import broken, console, table

    folder = found.folder
    if top := summary["best"]:
        best = f"best {goals[0]}" if goals else "smallest errors"
        title = "no other cell is better in all goals" if len(goals) > 1 else best
        lines = table(*broken(list(top[0]), console().width), title=title, overflow="fold")
        for each in top:
            lines.add_row(*(_formatted(value, *folder.description.unit(name)) for name, value in each.items()))
        yield lines
    yield ", ".join(f"{count} {status}" for status, count in summary["statuses"].items())
    for goal in goals:
        if missing := found.count_without(goal):
            yield f"{missing} done cells without a value of {goal}"
    for each in reasons[:_REASONS]:
        yield f"{each.cells} {each.status}, such as {each.example}"
    if more := reasons[_REASONS:]:
        yield f"{sum(each.cells for each in more)} for {len(more)} more reasons, which are on the page"
    yield f"rows:    {folder.path}/rows"
    yield f"page:    {written.page if written else f'lathe sweep show {folder.path}'}"
    if written and written.figures:
        yield f"figures: {written.figures[0].parent} ({len(written.figures)} PNG)"


def _formatted(value: object, factor: float, unit: str) -> str:
    if isinstance(value, float):
        return f"{value * factor:.4g} {unit}" if unit else f"{value:.6g}"
    return "" if value is None else str(value)


@sweep.command()
@click.argument("first", type=options.PATH)
@click.argument("second", type=options.PATH)
@click.option("--goal", default="", metavar="COLUMN", help="column or formula that ranks the cells")
@options.allow_code
@options.as_json
def compare(first: Path, second: Path, goal: str, *, as_json: bool) -> None:
    """Compare the sweeps in two folders: scenarios and code, best cells, effects, and the cells in common."""
    import numpy as np

    from lathe_explore.sweep import comparison
    from lathe_explore.sweep.figures import effect_said
    from lathe_explore.sweep.folder import Folder
    from lathe_rc.commands import tables

    found = comparison.compare(Folder(first), Folder(second), goal)
    name, effects = found.sides[0].goal.name, list(dict.fromkeys(key for side in found.sides for key in side.effects))
    rows: dict[str, list[str]] = {
        "cells": [", ".join(f"{n} {s}" for s, n in side.statuses.items()) for side in found.sides]
    }
    for side in found.sides:
        value = side.goal.told(float(side.goal.values[side.goal.order[0]])) if side.best else "none"
        rows.setdefault(f"best {name}", []).append(value)
        for key in ["cell", *effects, "margin"]:
            shown = side.best.get(key)
            rows.setdefault(f"  {key}", []).append(
                f"{shown:.6g}" if isinstance(shown, float) else "" if shown is None else str(shown)
            )
    for key in effects:
        told = [effect_said(side.effects[key]) if key in side.effects else ("", "", "") for side in found.sides]
        rows[f"effect of {key}"] = [total or share for total, share, _ in told]
    changed = found.changes
    middle = [float(np.quantile(changed, share)) for share in (0.0, 0.5, 1.0)] if changed.size else []
    text: list[RenderableType] = [
        *(found.differences or ["no difference of the scenarios, the code and the version of lathe_rc"])
    ]
    made = tables.table("", str(first), str(second), left=1, overflow="fold")
    for key, texts in rows.items():
        made.add_row(key, *texts)
    text += [made]
    if changed.size:
        low, half, high = (found.sides[0].goal.told(value) for value in middle)
        equal = int((changed == 0.0).sum())
        counts = f"{found.better} better in {second}, {equal} equal, {changed.size - found.better - equal} worse"
        text += [f"{changed.size} cells in common: {counts}; change {low} to {high}, median {half}"]
    else:
        text += ["no cell in common"]
    bests = [(side.folder.path, side.best["cell"]) for side in found.sides if side.best]
    text += (f"best run: lathe sweep show {path} --cell {cell} --panel" for path, cell in bests)
    summary = {"differences": list(found.differences), "common": changed.size, "better": found.better}
    tables.show(summary | {"changes": middle, "rows": rows}, text, as_json=as_json)


@sweep.command()
@click.argument("folder", type=options.PATH)
@click.option("--cell", type=click.IntRange(0), help="run this cell again, and compare it with its row")
@click.option("--bag", type=options.PATH, help="with --cell: folder to record it to; default: FOLDER/cell-N")
@click.option("--report", is_flag=True, help="with --cell: record it, and write its report beside the bag")
@click.option("--panel", is_flag=True, help="with --cell: record it, and play it on the panel")
@click.option(
    "--goal",
    "goals",
    multiple=True,
    metavar="COLUMN",
    help="column or formula that ranks the cells, -COLUMN: large is better; the page shows the first of several  "
    "[default: tool.max_error, or NODE.max_error of a loop]",
)
@options.allow_code
@options.as_json
@click.pass_context
def show(
    ctx: click.Context,
    folder: Path,
    cell: int | None,
    bag: Path | None,
    goals: tuple[str, ...],
    *,
    report: bool,
    panel: bool,
    as_json: bool,
) -> None:
    """Show the results in the FOLDER of a sweep; write FOLDER/page.html and figures: maps, sensitivity and yield."""
    from lathe_explore.sweep import row
    from lathe_explore.sweep.folder import Folder
    from lathe_explore.sweep.sweep import Sweep

    found = Sweep(Folder(folder))
    if cell is None:
        if given := [name for name, value in (("--bag", bag), ("--report", report), ("--panel", panel)) if value]:
            raise InputError(f"{given[0]} without --cell; allowed: --cell N {given[0]}")
        from lathe_explore.sweep import page

        _show(found, goals, page.write(found.folder, *goals[:1]), as_json=as_json)
        return
    if goals:
        raise InputError(f"--goal {goals[0]} with --cell {cell}; allowed: one of them")
    from lathe_rc.commands import outcome, tables

    if report or panel:
        bag = bag or folder / f"cell-{cell}"
    result = lathe_rc.run(found.scenario(cell), bag=bag)
    kept = found.row(cell)
    same = row.digest(result.recording, found.folder.measures) == kept["digest"]
    told = f"cell {cell}: {'the digest of its row' if same else 'ANOTHER DIGEST than in its row: ' + kept['version']}"
    summary = {**result.summary(), "cell": cell, "same_digest": same}  # its digests are there already
    tables.show(summary, chain(outcome.told(result, {}), [told]), as_json=as_json)
    if not same:
        raise click.exceptions.Exit(1)
    if report:
        from lathe_rc.view.report import write_report

        write_report(cast("Path", bag), path := Path(f"{bag}.html"))
        click.echo(f"report: {path}", err=as_json)
    if panel:
        ctx.invoke(extras.command("panel"), scenario=str(bag))
