# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe sweep``: variations of a scenario into a table, and what is in it."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from lathe_rc import harness
from lathe_rc.commands import options, outcome
from lathe_rc.commands import scenario as scenarios
from lathe_rc.errors import InputError
from lathe_rc.sweep import row
from lathe_rc.sweep.folder import Folder
from lathe_rc.sweep.space import Space, given
from lathe_rc.sweep.sweep import Models, Sweep, run_sweep

if TYPE_CHECKING:
    from lathe_rc.sweep.page import Written

_BEST = 5  # cells that are shown
INTERRUPTED = 130


measured = click.option(
    "--measure",
    "measures",
    multiple=True,
    metavar="TOPIC.FIELD:STATISTIC",
    help=f"more columns: {', '.join(row.STATISTICS)}",
)


def check_crew(scheduler: str | None, workers: int | None) -> None:
    """Refuse workers of this machine beside those of a scheduler."""
    if scheduler and workers:
        raise InputError("--workers with --scheduler; allowed: one of them: a scheduler has its own workers")


class _Sweep(click.Group):
    """``lathe sweep SCENARIO`` is short for ``lathe sweep run SCENARIO``."""

    short_for = "run"

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """See `click.Command`."""
        if args and args[0] not in self.commands and args[0] not in ("-h", "--help"):
            args = [self.short_for, *args]
        return super().parse_args(ctx, args)


@click.group(cls=_Sweep)
def sweep() -> None:
    """Compute many variations of a scenario into a table: lathe sweep SCENARIO --vary NODE.PARAM=LOW:HIGH:COUNT."""


def pairs(option: str, texts: Sequence[str], allowed: str) -> dict[str, str]:
    """By target, of ``TARGET=...``."""
    found: dict[str, str] = {}
    for text in texts:
        target, equals, told = text.partition("=")
        if not equals or not target.strip() or not told.strip():
            raise InputError(f"{option} {text!r}; allowed: {allowed}")
        if target.strip() in found:
            raise InputError(f"{option} {text!r}: {target.strip()} is given twice; allowed: once")
        found[target.strip()] = told.strip()
    return found


def space_of(
    vary: Sequence[str], draw: Sequence[str], tie: Sequence[str], sample: str, seeds: int, cells: Path | None
) -> Space:
    """The space that options name: with a sample, ranges without a count are part of it."""
    varied = pairs("--vary", vary, "NODE.PARAM=LOW:HIGH:COUNT, =LOW:HIGH:COUNT:log, =A,B,C, or =LOW:HIGH of a --sample")
    ranges = {target: told for target, told in varied.items() if sample and told.count(":") == 1}
    ranges |= {
        target: told for target, told in varied.items() if sample and told.count(":") == 2 and told.endswith(":log")
    }
    return Space(
        grid={target: told for target, told in varied.items() if target not in ranges},
        sampled=ranges
        | pairs("--draw", draw, "NODE.PARAM=normal:DEVIATION, =normal:MEAN:DEVIATION or =uniform:LOW:HIGH"),
        ties=pairs("--tie", tie, "NODE.PARAM=FORMULA"),
        sample=sample,
        seeds=seeds,
        given=given(cells) if cells else (),
    )


@sweep.command()
@click.argument("scenario")
@click.option(
    "--vary", multiple=True, metavar="NODE.PARAM=RANGE", help="LOW:HIGH:COUNT[:log] or A,B,C; % of the scenario's value"
)
@click.option(
    "--draw", multiple=True, metavar="NODE.PARAM=LAW", help="normal:DEVIATION, normal:MEAN:DEVIATION, uniform:LOW:HIGH"
)
@click.option("--tie", multiple=True, metavar="NODE.PARAM=FORMULA", help="such as fine_controller.q_time*1.1")
@click.option(
    "--sample",
    default="",
    metavar="SAMPLER:N",
    help="points of ranges LOW:HIGH and of laws: sobol, halton, latin, random",
)
@click.option("--seeds", type=click.IntRange(1), default=1, show_default=True, help="each cell with so many seeds")
@click.option("--cells", type=click.Path(path_type=Path), help="CSV or YAML file with a cell a row")
@measured
@click.option(
    "--models",
    type=click.Choice(["follow", "nominal"]),
    default="follow",
    show_default=True,
    help="what controllers take for a drive that is varied: as it is, or as the scenario has it",
)
@options.overrides
@options.length
@click.option("--out", type=click.Path(path_type=Path), help="folder of the results; default: sweep-SCENARIO")
@options.scheduler
@options.workers
@options.allow_code
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
def run(
    scenario: str,
    vary: tuple[str, ...],
    draw: tuple[str, ...],
    tie: tuple[str, ...],
    sample: str,
    seeds: int,
    cells: Path | None,
    measures: tuple[str, ...],
    models: Models,
    overrides: tuple[str, ...],
    revolutions: float | None,
    out: Path | None,
    scheduler: str | None,
    workers: int | None,
    *,
    as_json: bool,
) -> None:
    """Compute variations of a SCENARIO into a table; its rows are not computed again."""
    check_crew(scheduler, workers)
    loaded = scenarios.load(scenario, overrides, revolutions=revolutions)
    space = space_of(vary, draw, tie, sample, seeds, cells)
    place = out or Path(f"sweep-{loaded.name}")
    progress = Watch(Console(stderr=True), quiet=as_json)
    try:
        with progress:
            found = run_sweep(
                loaded,
                space,
                place,
                measures=measures,
                models=models,
                scheduler=scheduler,
                workers=workers,
                watch=progress,
            )
    except KeyboardInterrupt:
        click.echo(
            f"lathe: stopped; {progress.done} of {progress.cells} cells are in {place}: the same command goes on",
            err=True,
        )
        raise click.exceptions.Exit(INTERRUPTED) from None
    _show(found, as_json=as_json)


class Watch:
    """Shows the progress of a sweep: cells, how many a second, time left, what came of them."""

    def __init__(self, console: Console, *, quiet: bool = False) -> None:
        self.cells = self.done = 0
        self._statuses: Counter[str] = Counter()
        self._console, self._quiet = console, quiet
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[speed]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[statuses]}"),
            console=console,
            transient=True,
            disable=not console.is_terminal or quiet,
        )
        self._task = self._bar.add_task("starting workers", total=None, statuses="", speed="")

    def __enter__(self) -> "Watch":
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def describe(self, text: str) -> None:
        """Say what is going on."""
        self._bar.update(self._task, description=text)

    def __call__(self, event: Mapping[str, Any]) -> None:
        """Take an event of `lathe_rc.run_sweep`."""
        if event["event"] == "began":
            self.cells, self.done = event["cells"], event["computed"]
            there = f", {self.done} of them are there already" if self.done else ""
            if not self._quiet:
                self._console.print(f"{self.cells} cells{there}", highlight=False)
            self._bar.update(self._task, total=self.cells, completed=self.done)
        elif event["event"] == "compiling":
            self._bar.update(self._task, description="compiling, once on this machine")
        elif event["event"] == "ready":
            if not self._quiet:
                self._console.print(f"Dask's dashboard: {event['dashboard']}", highlight=False)
            self._bar.reset(self._task, total=self.cells, completed=self.done)
            self._bar.update(self._task, description="computing")
        else:
            self._statuses += event["statuses"]
            self.done += event["statuses"].total()
            told = ", ".join(
                f"{count} {status}" for status, count in self._statuses.most_common() if status != row.DONE
            )
            speed = self._bar.tasks[0].speed
            self._bar.update(
                self._task, completed=self.done, statuses=told, speed=f"{speed:.3g} cells/s" if speed else ""
            )


def best(found: Sweep) -> list[dict[str, Any]]:
    """The cells with the smallest largest error, and what was varied in them."""
    columns = ["cell", *found.folder.targets, "tool.max_error", "tool.rms_error", "margin"]
    table = found.table().select(columns).sort_by("tool.max_error")
    return [each for each in table.slice(0, _BEST).to_pylist() if each["tool.max_error"] is not None]


def _show(found: Sweep, written: "Written | None" = None, *, as_json: bool) -> None:
    statuses, top = found.statuses(), best(found)
    if as_json:
        told = {
            "folder": str(found.folder.path),
            "scenario": found.folder.scenario.name,
            "statuses": statuses,
            "best": top,
        }
        if written:
            told |= {"page": str(written.page), "figures": [str(path) for path in written.figures]}
        click.echo(json.dumps(told))
        return
    console = Console()
    if top:
        table = Table(title="smallest errors", title_justify="left", show_edge=False, header_style="bold")
        for name in top[0]:
            table.add_column(name, justify="right", overflow="fold")
        for each in top:
            table.add_row(*(_said(name, value) for name, value in each.items()))
        console.print(table)
    console.print(", ".join(f"{count} {status}" for status, count in statuses.items()), highlight=False)
    console.print(f"rows:    {found.folder.path}/rows", highlight=False, soft_wrap=True)
    page = written.page if written else f"lathe sweep show {found.folder.path}"
    console.print(f"page:    {page}", highlight=False, soft_wrap=True)
    if written and written.figures:
        count = len(written.figures)
        console.print(f"figures: {written.figures[0].parent} ({count} PNG)", highlight=False, soft_wrap=True)


def _said(name: str, value: object) -> str:
    if isinstance(value, float):
        return f"{value * 1e6:.4g} µm" if name.endswith("_error") else f"{value:.6g}"
    return "" if value is None else str(value)


@sweep.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--cell", type=click.IntRange(0), help="run this cell again, and compare it with its row")
@click.option("--bag", type=click.Path(path_type=Path), help="with --cell: folder to record it to")
@click.option("--goal", metavar="COLUMN", help="what the page judges cells by  [default: tool.max_error]")
@options.allow_code
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
def show(folder: Path, cell: int | None, bag: Path | None, goal: str | None, *, as_json: bool) -> None:
    """Show what is in the FOLDER of a sweep, and write FOLDER/page.html and its figures: maps, sensitivity, yield."""
    found = Sweep(Folder(folder))
    if cell is None:
        if bag:
            raise InputError(f"--bag {bag} without --cell; allowed: --cell N --bag FOLDER")
        from lathe_rc.sweep import page, seen

        _show(found, page.write(found.folder, goal or seen.GOAL), as_json=as_json)
        return
    if goal is not None:
        raise InputError(f"--goal {goal} with --cell {cell}; allowed: one of them")
    result = harness.run(found.scenario(cell), bag=bag)
    kept = found.row(cell)
    same = row.digest(result.recording, found.folder.measures) == kept["digest"]
    if as_json:
        click.echo(json.dumps({**result.summary(), "cell": cell, "same_digest": same}))
    else:
        outcome.show(result, {}, told="")
        click.echo(
            f"cell {cell}: {'the digest of its row' if same else 'ANOTHER DIGEST than in its row: ' + kept['version']}"
        )
    if not same:
        raise click.exceptions.Exit(1)
