# SPDX-License-Identifier: Apache-2.0
"""Arguments and options shared by several commands; this module imports only Click."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import click

from lathe_rc import allowed_code
from lathe_rc.commands import completers

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
