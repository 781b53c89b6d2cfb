# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe sweep``: compute variations of a scenario into a table, and show the table."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

import lathe_rc
from lathe_rc.commands import completers, options
from lathe_rc.errors import InputError, LatheError

if TYPE_CHECKING:
    from lathe_rc.sweep.page import Written
    from lathe_rc.sweep.sweep import Sweep

_BEST = 5  # number of displayed cells
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


def pairs(option: str, texts: Sequence[str], allowed: str) -> dict[str, str]:
    """Parse strings ``TARGET=VALUE`` into values by target."""
    found: dict[str, str] = {}
    for text in texts:
        target, equals, value = (part.strip() for part in text.partition("="))
        if not (target and equals and value):
            raise InputError(f"{option} {text!r}; allowed: {allowed}")
        if target in found:
            raise InputError(f"{option} {text!r}: {target} is given twice; allowed: once")
        found[target] = value
    return found


def space_of(
    vary: Sequence[str], draw: Sequence[str], tie: Sequence[str], sample: str, seeds: int, cells: Path | None
) -> "lathe_rc.Space":
    """Return the space given by options; with ``sample``, ranges without a count are sampled."""
    from lathe_rc.sweep.space import Space, given

    varied = pairs("--vary", vary, "NODE.PARAM=LOW:HIGH:COUNT, =LOW:HIGH:COUNT:log, =A,B,C, or =LOW:HIGH of a --sample")
    drawn = pairs("--draw", draw, "NODE.PARAM=normal:DEVIATION, =normal:MEAN:DEVIATION or =uniform:LOW:HIGH")
    ranges = {target: text for target, text in varied.items() if sample and text.removesuffix(":log").count(":") == 1}
    return Space(
        grid={target: text for target, text in varied.items() if target not in ranges},
        sampled=ranges | drawn,
        ties=pairs("--tie", tie, "NODE.PARAM=FORMULA"),
        sample=sample,
        seeds=seeds,
        given=given(cells) if cells else (),
    )


@sweep.command()
@options.scenario
@options.of_targets(
    "--vary", metavar="NODE.PARAM=RANGE", help="LOW:HIGH:COUNT[:log] or A,B,C; % of the scenario's value"
)
@options.of_targets(
    "--draw", metavar="NODE.PARAM=LAW", help="normal:DEVIATION, normal:MEAN:DEVIATION, uniform:LOW:HIGH"
)
@options.tie
@click.option(
    "--sample",
    default="",
    metavar="SAMPLER:N",
    help="points of ranges LOW:HIGH and of laws: sobol, halton, latin, random, saltelli",
)
@options.seeds
@click.option("--cells", type=options.PATH, help="CSV or YAML file with a cell a row")
@options.measures
@click.option(
    "--models",
    type=click.Choice(["follow", "nominal"]),
    default="follow",
    show_default=True,
    help="what controllers take for a drive that is varied: as it is, or as the scenario has it",
)
@click.option("--retry", is_flag=True, help="compute failed cells again")
@options.many_cells("sweep-SCENARIO")
def run(
    scenario: str,
    vary: tuple[str, ...],
    draw: tuple[str, ...],
    tie: tuple[str, ...],
    sample: str,
    seeds: int,
    cells: Path | None,
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
    from lathe_rc.commands import scenario as scenarios
    from lathe_rc.commands.progress import SweepWatch

    check_crew(scheduler, workers)
    loaded = scenarios.load(scenario, overrides, revolutions=revolutions, start_from=start_from)
    if not (vary or draw or cells or seeds > 1):
        raise InputError("nothing varies; allowed: --vary, --draw, --cells or --seeds (lathe run computes one cell)")
    space = space_of(vary, draw, tie, sample, seeds, cells)
    place = out or Path(f"sweep-{loaded.name}")
    with SweepWatch(place, quiet=as_json) as watch:
        found = lathe_rc.run_sweep(loaded, space, place, scheduler=scheduler, workers=workers, watch=watch, **how)
    _show(found, as_json=as_json)
    statuses = found.statuses()
    if not statuses.get("done"):
        raise LatheError(f"no cell of {place} came to a result")
    if failed := statuses.get("failed"):
        raise LatheError(f"{failed} cells of {place} failed; --retry computes them again")


def best(found: "Sweep") -> list[dict[str, Any]]:
    """Return the cells with the smallest maximum error, and their varied parameters, errors and margins."""
    goal = found.folder.description.goal
    columns = ["cell", *found.folder.targets, goal, goal.replace("max_error", "rms_error")]
    columns.append("margin" if goal.startswith("tool.") else goal.replace("max_error", "settling"))
    table = found.table().select(columns).sort_by(goal)
    return [each for each in table.slice(0, _BEST).to_pylist() if each[goal] is not None]


def _show(found: "Sweep", written: "Written | None" = None, *, as_json: bool) -> None:
    from lathe_rc.commands.tables import broken, console, table

    statuses, top, folder = found.statuses(), best(found), found.folder
    if as_json:
        summary = {"folder": str(folder.path), "scenario": folder.name, "statuses": statuses, "best": top}
        summary["reasons"] = [each._asdict() for each in found.outcomes() if each.reason]
        if written:
            summary |= {"page": str(written.page), "figures": [str(path) for path in written.figures]}
        click.echo(json.dumps(summary))
        return
    out = console()
    if top:
        lines = table(*broken(list(top[0]), out.width), title="smallest errors", overflow="fold")
        for each in top:
            lines.add_row(*(_formatted(value, *folder.description.unit(name)) for name, value in each.items()))
        out.print(lines, soft_wrap=False)
    out.print(", ".join(f"{count} {status}" for status, count in statuses.items()))
    reasons = [each for each in found.outcomes() if each.reason]
    for outcome in reasons[:_REASONS]:
        out.print(f"{outcome.cells} {outcome.status}, such as {outcome.example}", soft_wrap=True, highlight=False)
    if more := reasons[_REASONS:]:
        out.print(f"{sum(outcome.cells for outcome in more)} for {len(more)} more reasons, which are on the page")
    out.print(f"rows:    {folder.path}/rows")
    out.print(f"page:    {written.page if written else f'lathe sweep show {folder.path}'}")
    if written and written.figures:
        out.print(f"figures: {written.figures[0].parent} ({len(written.figures)} PNG)")


def _formatted(value: object, factor: float, unit: str) -> str:
    if isinstance(value, float):
        return f"{value * factor:.4g} {unit}" if unit else f"{value:.6g}"
    return "" if value is None else str(value)


@sweep.command()
@click.argument("folder", type=options.PATH)
@click.option("--cell", type=click.IntRange(0), help="run this cell again, and compare it with its row")
@click.option("--bag", type=options.PATH, help="with --cell: folder to record it to")
@click.option(
    "--goal",
    metavar="COLUMN",
    help="what the page judges cells by  [default: tool.max_error, or NODE.max_error of a loop]",
)
@options.allow_code
@options.as_json
def show(folder: Path, cell: int | None, bag: Path | None, goal: str | None, *, as_json: bool) -> None:
    """Show the results in the FOLDER of a sweep; write FOLDER/page.html and figures: maps, sensitivity and yield."""
    from lathe_rc.sweep import row
    from lathe_rc.sweep.folder import Folder
    from lathe_rc.sweep.sweep import Sweep

    found = Sweep(Folder(folder))
    if cell is None:
        if bag:
            raise InputError(f"--bag {bag} without --cell; allowed: --cell N --bag FOLDER")
        from lathe_rc.sweep import page

        _show(found, page.write(found.folder, goal or ""), as_json=as_json)
        return
    if goal is not None:
        raise InputError(f"--goal {goal} with --cell {cell}; allowed: one of them")
    from lathe_rc.commands import outcome

    result = lathe_rc.run(found.scenario(cell), bag=bag)
    kept = found.row(cell)
    same = row.digest(result.recording, found.folder.measures) == kept["digest"]
    if as_json:
        click.echo(json.dumps({**result.summary(), "cell": cell, "same_digest": same}))
    else:
        outcome.show(result, {})
        click.echo(
            f"cell {cell}: {'the digest of its row' if same else 'ANOTHER DIGEST than in its row: ' + kept['version']}"
        )
    if not same:
        raise click.exceptions.Exit(1)
