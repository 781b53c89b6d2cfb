# SPDX-License-Identifier: Apache-2.0
"""The commands ``lathe node`` and ``lathe container``: nodes in this process, as ``ros2 run`` starts them."""

import json
import sys
from collections.abc import Sequence

import click
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from lathe_rc.cell.scenario import TABLES
from lathe_rc.errors import InputError

_PASS_THROUGH = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []}


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


@click.command(cls=_PassingThrough, context_settings=_PASS_THROUGH)
@click.argument("name", metavar="NAME[:STAGE]")
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def node(name: str, arguments: tuple[str, ...]) -> None:
    """Run one node, as ``ros2 run lathe_rc NAME`` does; --help lists its parameters."""
    _, _, kind = name.partition(":")
    kind = kind or name
    if kind not in TABLES:
        raise InputError(f"no node {kind!r}; {TABLES.instead(kind)}")
    if "--help" in arguments or "-h" in arguments:
        click.echo(f"usage: lathe node {name} [--ros-args -p PARAM:=VALUE --params-file FILE -r OLD:=NEW ...]\n")
        Console().print(_parameters(kind))
        return
    sys.exit(_nodes([name, *arguments]))


@click.command(cls=_PassingThrough, context_settings=_PASS_THROUGH)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def container(arguments: tuple[str, ...]) -> None:
    """Run several nodes in one process: NODE[:STAGE]... [--ros-args ...]."""
    if not arguments or arguments[0].startswith("-"):
        raise InputError(f"no nodes named; allowed: {TABLES.allowed()}, each once, or NAME:STAGE")
    sys.exit(_nodes(arguments))


def _nodes(arguments: Sequence[str]) -> int:
    try:
        from lathe_rc.nodes import process
    except ImportError as error:
        raise InputError(
            f"no ROS 2 here ({error}); run through ./lathe, source a ROS 2 installation, or use --mode offline"
        ) from None
    return process.run(*process.split(arguments))
