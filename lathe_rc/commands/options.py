# SPDX-License-Identifier: Apache-2.0
"""Arguments and options shared by several commands; this module imports only Click."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import click

from lathe_rc import allowed_code
from lathe_rc.commands import completers
from lathe_rc.sweep import LOOP_FIGURES

F = TypeVar("F", bound=Callable[..., Any])

POSITIVE = click.FloatRange(min=0, min_open=True)
PATH = click.Path(path_type=Path)

scenario = click.argument("scenario", shell_complete=completers.scenarios)
bag = click.argument("bag", type=PATH)
as_json = click.option("--json", "as_json", is_flag=True, help="print one JSON object")

allow_code = click.option(
    allowed_code.OPTION,
    multiple=True,
    metavar="PACKAGE",
    is_eager=True,
    expose_value=False,
    callback=lambda ctx, _option, packages: None if ctx.resilient_parsing else _allow(packages),
    help="import classes that scenario, bag or members name from this package, also of the current folder; repeatable",
)


def _allow(packages: Iterable[str]) -> None:
    for package in packages:
        allowed_code.allow(package)


overrides = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="NODE.PARAM=VALUE",
    shell_complete=completers.targets,
    help="also PARAM=VALUE if shared",
)

groups = click.option(
    "--group",
    "groups",
    multiple=True,
    metavar="NODE+NODE",
    shell_complete=completers.nodes,
    help="nodes that share a process, instead of those that the scenario names; repeatable; none: one each",
)


def topics(default: str) -> Callable[[F], F]:
    """Return the option ``--topics``, a list of topics; ``default``: what it is without the option, in words."""
    return click.option(
        "--topics",
        multiple=True,
        metavar="LIST",
        callback=lambda _context, _option, lists: tuple(
            topic.strip() for text in lists for topic in text.split(",") if topic.strip()
        ),
        help=f"like /tool,/encoder; repeatable; default: {default}",
    )


start = click.option(
    "--start",
    type=click.Choice(["fork", "spawn"]),
    help="processes are forked from one that has imported everything, or interpreters of their own; default: fork",
)

start_from = click.option(
    "--from", "start_from", type=PATH, metavar="FILE", help="checkpoint from which the cell goes on"
)

length = click.option("--revolutions", type=POSITIVE, help="length of each run")

# --- sweep and tuning

tie = click.option(
    "--tie",
    multiple=True,
    metavar="NODE.PARAM=FORMULA",
    shell_complete=completers.targets,
    help="such as fine_controller.q_time*1.1",
)

seeds = click.option(
    "--seeds", type=click.IntRange(1), default=1, show_default=True, help="each cell with so many seeds"
)

measures = click.option(
    "--measure",
    "measures",
    multiple=True,
    metavar="TOPIC.FIELD:STATISTIC",
    help="more columns: max, rms, mean, peak_to_valley; or NODE.FIGURE of a force or position controller: "
    + ", ".join(LOOP_FIGURES),
)

scheduler = click.option("--scheduler", metavar="ADDRESS", help="of Dask; default: workers on this machine")

workers = click.option(
    "--workers", type=click.IntRange(1), help="processes on this machine; default: one for each core"
)
