# SPDX-License-Identifier: Apache-2.0
"""The command line, ``lathe``."""

import importlib
import json
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, cast

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table as RichTable
from rich.text import Text

from lathe_rc import __version__, harness, part
from lathe_rc.bag.record import recorder_of
from lathe_rc.cell.scenario import TABLES, Scenario
from lathe_rc.cell.stages.spindle_encoder import SpindleEncoder
from lathe_rc.commands import scenario as options
from lathe_rc.errors import InputError, LatheError

_MOST_EVENTS = 12  # that are told of a run
_ALIKE = 4  # of them that follow one another: those in between are left out
_NO_SNAPSHOTS = "no snapshots: no --bag was given"
_REFRESH = 0.1  # [s] between updates of the progress line
_LOG_PERIOD = 2.0  # [s] between lines where there is no terminal
# in lathe_rc.commands, imported when they are wanted
_ELSEWHERE = (
    "bag",
    "bench",
    "export",
    "fit",
    "measure",
    "policy",
    "record",
    "replay",
    "report",
    "resim",
    "study",
    "view",
)
_PASS_THROUGH = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []}


class _Group(click.Group):
    """Turns the project's errors into one line and an exit code; imports a command's module when it is wanted."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """See `click.Group`."""
        return sorted([*super().list_commands(ctx), *_ELSEWHERE])

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """See `click.Group`."""
        if cmd_name in _ELSEWHERE:
            found = getattr(importlib.import_module(f"lathe_rc.commands.{cmd_name}"), cmd_name)
            return cast("click.Command", found)
        return super().get_command(ctx, cmd_name)

    def invoke(self, ctx: click.Context) -> Any:
        # SIGTERM ends a command as Ctrl-C does: children are ended and bags closed on the way out.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            return super().invoke(ctx)
        except LatheError as error:
            click.echo(f"lathe: {error}", err=True)
            ctx.exit(error.exit_code)


@click.group(
    cls=_Group,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="./lathe of a checkout also has: setup; test (linters and tests; --system: those that need privileges); "
    "python SCRIPT ... (in its environment).",
)
@click.version_option(__version__)
def main() -> None:
    """Emulate the control cell of a lathe for non-circular turning."""


class _Watch:
    """Shows a run's progress on the error stream."""

    def __init__(self, console: Console) -> None:
        self._step = 0.0
        self._start = time.monotonic()
        self._due = {"progress": 0.0, "cycle": 0.0}
        self._silent = ""  # who was said to be
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[revolution]}  {task.fields[error]}  {task.fields[factor]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("starting", total=None, revolution="", error="", factor="")

    def __enter__(self) -> Callable[[harness.Event], None]:
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def _log(self, event: harness.Event, now: float) -> None:
        """Without a terminal, a line now and then."""
        if event["event"] == "cycle" and now >= self._due["cycle"]:
            self._due["cycle"] = now + _LOG_PERIOD
            error = f"error {event['rms_error'] * 1e6:.3g} µm RMS"
            self._bar.console.print(f"revolution {event['cycle']:.0f}: {error}", highlight=False)

    def __call__(self, event: harness.Event) -> None:
        """Take an event of the run."""
        kind, update = event["event"], self._bar.update
        now = time.monotonic()
        if kind in _TROUBLE and (text := _TROUBLE[kind](event)):
            self._bar.console.print(text)
        if self._bar.disable:
            self._log(event, now)
            return
        if kind in ("progress", "cycle"):
            if now < self._due[kind]:
                return  # nobody reads faster, and drawing would slow an offline run down
            self._due[kind] = now + _REFRESH
        if kind == "checked":
            # Not before: a refusal is one line and nothing else.
            self._step = event["step"]
            update(self._task, total=event["samples"])
            self._bar.start()
        elif kind == "block0":
            self._start = now
            update(self._task, description="turning")
        elif kind == "progress":
            self._silent = ""
            simulated = event["samples"] * self._step
            elapsed = max(now - self._start, 1e-9)
            update(self._task, completed=event["samples"], factor=f"{simulated / elapsed:.1f}x real time")
        elif kind == "cycle":
            update(
                self._task,
                revolution=f"revolution {event['cycle']:.0f}",
                error=f"error {event['rms_error'] * 1e6:.3g} µm RMS",
            )
        elif kind == "stall" and event["member"] != self._silent:
            self._silent = event["member"]  # every other member tells of a silent time master
            self._bar.console.print(f"{event['member']} is silent at block {event['blocks']}: the cell stands still")


_TROUBLE: dict[str, Callable[[harness.Event], str]] = {
    "stuck": lambda event: f"{event['node']} did not end{event['place']}; the bag is closed: no longer waited for",
    "stranger": lambda event: (
        f"{event['node']} refuses: {event['message']}; publishers: {', '.join(event['publishers'])}"
    ),
    "dead": lambda event: (
        f"{event['member']} has died at block {event['blocks']}: "
        + ("another process goes on in its place" if event["restarts"] else "the cell goes to its safe state")
    ),
    "exit": lambda event: harness.how_it_ended(event) if event["code"] < 0 else "",
    "stopped": lambda event: (
        f"{event['node']} has been stopped ({signal.Signals(event['signal']).name}): the cell "
        + ("waits for it" if event["waits"] else "goes to its safe state, if it does not go on in time")
    ),
    "not_reached": lambda event: f"{event['node']}: the run ends before {'; '.join(event['events'])}",
    "safe": lambda event: f"{event['why']}; the run ends at sample {event['end']}",
}  #: what is said of an event in any case


def _table(result: harness.Result) -> RichTable:
    table = RichTable(show_edge=False, header_style="bold", title_justify="left")
    columns = {"rms": "RMS [µm]", "max": "maximum [µm]", "peak_to_valley": "peak to valley [µm]", "ront": "RONt [µm]"}
    for column in ("", *columns.values()):
        table.add_column(column, justify="right" if column else "left")
    for label, revolution in (("first revolution", 0), ("last revolution", -1)):
        told = part.numbers(result.part, revolution)
        table.add_row(label, *(f"{told[name]:#.4g}" for name in columns))
    return table


def _events(result: harness.Result) -> RichTable:
    """What happened, as far as there is room; of equal ones that follow one another the first and the last."""
    table = RichTable(show_edge=False, header_style="bold")
    for column in ("time [s]", "topic", "what happened"):
        table.add_column(Text(column), justify="left" if table.columns else "right", overflow="fold")
    step, rows = result.scenario.shared.step, list[tuple[str, str, str]]()
    for _, run in groupby(result.happened, lambda found: (found.topic, found.text.partition(":")[0])):
        alike = [(f"{found.sample * step:.6g}", found.topic, found.text) for found in run]
        rows += alike if len(alike) < _ALIKE else [alike[0], ("", "", f"{len(alike) - 2} more of the kind"), alike[-1]]
    if (left := len(rows) - _MOST_EVENTS) > 0:
        rows[_MOST_EVENTS:] = [("", "", f"and {left} more: see --json, or the bag's report")]
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def _facts(result: harness.Result) -> list[str]:
    refused = [f"{count} messages refused from {sender}" for sender, count in result.refused.items()]
    return [
        f"{result.blocks} blocks sent, {result.dropped} lost; {result.errors.rms.size} revolutions",
        f"{result.simulated_s:.2f} s simulated in {result.wall_s:.2f} s: {result.real_time_factor:.1f}x real time",
        *refused,
    ]


def _run(
    scenario: Scenario,
    *,
    mode: harness.Mode,
    groups: list[list[str]] | None,
    bag: Path | None,
    domain: int | None = None,
    namespace: str = "/",
) -> harness.Result:
    with _Watch(Console(stderr=True)) as watch:
        return harness.run(scenario, mode=mode, groups=groups, bag=bag, watch=watch, domain=domain, namespace=namespace)


def _show(result: harness.Result, further: Mapping[str, Path], *, told: str = "") -> None:
    """Print a run: its part, what happened, how it went, and the files that it left."""
    console = Console()
    if result.errors.rms.size:
        console.print(_table(result))
    if result.happened:
        console.print(_events(result))
    for fact in [*_facts(result), *filter(None, [told])]:
        console.print(fact, highlight=False)
    files = [("bag", result.bag), *(("snapshot", path) for path in result.snapshots), *further.items()]
    for name, path in files:
        if path:
            console.print(f"{name}: {path}", highlight=False, soft_wrap=True)


@main.command()
@click.argument("scenario")
@click.option("--mode", type=click.Choice(["offline", "composed", "processes"]), default="offline", show_default=True)
@options.groups
@click.option("--revolutions", type=click.FloatRange(min=0, min_open=True), help="length of the run")
@click.option("--speed-factor", type=click.FloatRange(min=0), help="pace against real time; 0: as fast as possible")
@click.option("--bag", type=click.Path(path_type=Path), help="folder to record to; must not exist")
@click.option("--profile", type=click.Path(path_type=Path), help="CSV file to write the last revolution's profile to")
@options.overrides
@click.option("--domain", type=click.IntRange(0, 232), help="ROS domain, for others to listen; default: a free one")
@click.option("--namespace", help="of the nodes, for two cells in one domain; default: /")
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
def run(
    scenario: str,
    mode: harness.Mode,
    groups: tuple[str, ...],
    revolutions: float | None,
    speed_factor: float | None,
    bag: Path | None,
    profile: Path | None,
    overrides: tuple[str, ...],
    domain: int | None,
    namespace: str | None,
    *,
    as_json: bool,
) -> None:
    """Run a SCENARIO, a ROS 2 parameter file, to its end."""
    loaded = options.load(scenario, overrides)
    asked = {"revolutions": revolutions, "speed_factor": speed_factor}
    given = {name: value for name, value in asked.items() if value is not None}
    changes = [f"{node}.{n}={v!r}" for node in loaded.of_kind(SpindleEncoder.kind) for n, v in given.items()]
    if changes:
        loaded = options.load(scenario, [*overrides, *changes])
    split = options.split(loaded, groups)
    if groups and mode != "processes":
        raise InputError(f"--group with --mode {mode}; allowed: --mode processes")
    for option, value in (("--domain", domain), ("--namespace", namespace)):
        if value is not None and mode == "offline":
            raise InputError(f"{option} {value} with --mode offline; allowed: --mode processes or composed")
    result = _run(loaded, mode=mode, groups=split, bag=bag, domain=domain, namespace=namespace or "/")
    if profile:
        part.write_profile(profile, result.recording, result.part, [result.errors.rms.size - 1])
    if as_json:
        click.echo(json.dumps(result.summary()))
        return
    asks_for_snapshots = recorder_of(loaded)[1].mode != "continuous"
    _show(result, {"profile": profile} if profile else {}, told="" if bag or not asks_for_snapshots else _NO_SNAPSHOTS)


_DEMOS = {
    "piston": (
        "An oval-barrel piston at 1000 rpm with a 10 % harmonic speed deviation: five ROS 2 processes, one bag.",
        "Oval-barrel piston, 1000 rpm, 10 % speed deviation",
    ),
    "two_channel": (
        "An oval-barrel piston, coarse and piezo channel both self-learning: seven ROS 2 processes, one bag.",
        "Oval-barrel piston, 1000 rpm, self-learning coarse and piezo channel",
    ),
}


@main.command()
@click.argument("name", type=click.Choice(list(_DEMOS)), default="piston")
@click.option("--revolutions", type=click.FloatRange(min=1), default=60.0, show_default=True)
@click.option("--folder", type=click.Path(path_type=Path), default=Path("bags"), show_default=True, help="for results")
def demo(name: str, revolutions: float, folder: Path) -> None:
    """Turn an oval-barrel piston: processes over DDS, learning, everything recorded.

    NAME is piston (one channel, the default) or two_channel (a piezo channel learns what the coarse one leaves).
    """
    number = 1
    while (folder / f"demo-{number}").exists():
        number += 1
    place = folder / f"demo-{number}"
    announcement, title = _DEMOS[name]
    scenario = options.load(name, [f"spindle_encoder.revolutions={revolutions!r}"])
    console = Console()
    console.print(announcement, highlight=False)
    folder.mkdir(parents=True, exist_ok=True)
    result = _run(scenario, mode="processes", groups=None, bag=place)
    from lathe_rc.view import figure

    picture = place.with_suffix(".png")
    figure.save(picture, result.recording, result.errors, title)
    console.print(_table(result))
    for fact in _facts(result):
        console.print(fact, highlight=False)
    console.print(f"bag:    {place}\nfigure: {picture}", highlight=False, soft_wrap=True)


def _parameters(kind: str) -> RichTable:
    table = RichTable(title=f"parameters of {kind}", title_justify="left", show_edge=False, header_style="bold")
    for column in ("name", "default", "allowed", "description"):
        table.add_column(column, overflow="fold")
    for name, row in TABLES[kind].rows().items():
        # as Text: rich would take the unit in brackets for markup
        table.add_row(name, Text(json.dumps(row.default, ensure_ascii=False)), Text(row.allowed()), Text(row.doc))
    return table


class _PassingThrough(click.Command):
    """Hands on what it does not know; asks for help are its own where they come first."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """See `click.Command`."""
        if args[:1] in (["-h"], ["--help"]):
            click.echo(ctx.get_help())
            ctx.exit()
        return super().parse_args(ctx, args)


@main.command(cls=_PassingThrough, context_settings=_PASS_THROUGH)
@click.argument("name", type=click.Choice(list(TABLES)))
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def node(name: str, arguments: tuple[str, ...]) -> None:
    """Run one node, as ``ros2 run lathe_rc NAME`` does; --help lists its parameters."""
    if "--help" in arguments or "-h" in arguments:
        click.echo(f"usage: lathe node {name} [--ros-args -p PARAM:=VALUE --params-file FILE -r OLD:=NEW ...]\n")
        Console().print(_parameters(name))
        return
    sys.exit(_nodes([name, *arguments]))


@main.command(cls=_PassingThrough, context_settings=_PASS_THROUGH)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def container(arguments: tuple[str, ...]) -> None:
    """Run several nodes in one process: NODE[:STAGE]... [--ros-args ...]."""
    if not arguments or arguments[0].startswith("-"):
        raise InputError(f"no nodes named; allowed: {', '.join(TABLES)}, each once, or NAME:STAGE")
    sys.exit(_nodes(arguments))


def _nodes(arguments: Sequence[str]) -> int:
    try:
        from lathe_rc.nodes import process
    except ImportError as error:
        raise InputError(
            f"no ROS 2 here ({error}); run through ./lathe, source a ROS 2 installation, or use --mode offline"
        ) from None
    return process.run(*process.split(arguments))


@main.command()
def reference() -> None:
    """Print the reference of nodes, topics, messages and parameters as Markdown."""
    from lathe_rc import reference as pages

    click.echo(pages.page(), nl=False)
