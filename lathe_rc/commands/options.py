# SPDX-License-Identifier: Apache-2.0
"""Arguments and options shared by several commands; this module imports only Click."""

from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import click

from lathe_rc import allowed_code
from lathe_rc.commands import completers
from lathe_rc.sweep import LOOP_FIGURES

F = TypeVar("F", bound=Callable[..., Any])

POSITIVE = click.FloatRange(min=0, min_open=True)
PATH = click.Path(path_type=Path)


class GroupWithDefault(click.Group):
    """Group with a command that need not be named.

    Args:
        default: name of the command.
        more: see `click.Group`.
    """

    def __init__(self, *, default: str, **more: Any) -> None:
        super().__init__(**more)
        self._default = default

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, with the default command before them if they name none."""
        named = not args or args[0] in (*self.commands, *ctx.help_option_names)
        return super().parse_args(ctx, args if named else [self._default, *args])


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


def of_targets(*names: str, metavar: str, help: str) -> Callable[[F], F]:  # noqa: A002 - Click's name
    """Return a repeatable option whose values begin with NODE.PARAM."""
    return click.option(*names, multiple=True, metavar=metavar, shell_complete=completers.targets, help=help)


overrides = of_targets("--set", "overrides", metavar="NODE.PARAM=VALUE", help="also PARAM=VALUE if shared")

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

tie = of_targets("--tie", metavar="NODE.PARAM=FORMULA", help="such as fine_controller.q_time*1.1")


class Sampling(NamedTuple):
    """Sample of ranges and distributions, as the options of `sampling` give it.

    Attributes:
        sample: sampler and number of points.
        seed: random seed.
        correlated: texts ``TARGET,TARGET=NUMBER``.
    """

    sample: str
    seed: int
    correlated: tuple[str, ...]


def sampling(command: F) -> F:
    """Add the options of a sample to a command, which gets them as ``sampling``."""

    @wraps(command)
    def with_sampling(sample: str, sample_seed: int, correlate: tuple[str, ...], **more: Any) -> Any:
        return command(sampling=Sampling(sample, sample_seed, correlate), **more)

    own = [
        click.option(
            "--sample",
            default="",
            metavar="SAMPLER:N",
            help="points of ranges LOW:HIGH and of laws: sobol, halton, latin, random, saltelli",
        ),
        click.option("--sample-seed", type=click.IntRange(0), default=0, show_default=True, help="of the sample"),
        click.option(
            "--correlate", multiple=True, metavar="TARGET,TARGET=NUMBER", help="correlation of two drawn parameters"
        ),
    ]
    found: Any = with_sampling
    for option in reversed(own):
        found = option(found)
    return cast("F", found)


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


def many_cells(folder: str) -> Callable[[F], F]:
    """Return the last options of a command that computes many cells; ``folder``: default of ``--out``, in words."""
    own = [
        click.option("--out", type=PATH, help=f"folder of the results; default: {folder}"),
        click.option("--scheduler", metavar="ADDRESS", help="of Dask; default: workers on this machine"),
        click.option("--workers", type=click.IntRange(1), help="processes on this machine; default: one for each core"),
        click.option(
            "--cell-time",
            type=click.FloatRange(0.0, min_open=True),
            metavar="SECONDS",
            help="time limit of a cell; default: 20 times the slowest so far, at least 60 s",
        ),
    ]

    def added(command: F) -> F:
        for option in reversed([overrides, length, start_from, *own, allow_code, as_json]):
            command = option(command)
        return command

    return added
