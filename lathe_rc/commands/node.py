# SPDX-License-Identifier: Apache-2.0
"""Commands ``lathe node`` and ``lathe container``: nodes in this process, as with ``ros2 run``."""

import sys
from collections.abc import Sequence

import click

from lathe_rc.catalogue import STANDALONE
from lathe_rc.cell.beside import MACHINE_STATE, MachineStateParameters
from lathe_rc.cell.scenario import TABLES
from lathe_rc.commands import completers, options
from lathe_rc.errors import InputError
from lathe_rc.extras import load
from lathe_rc.nodes.arguments import help_or_refusal

_PASS_THROUGH = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": []}


class _PassingThrough(click.Command):
    """Command that passes on unknown options and handles only a leading -h or --help itself."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Show the help for a leading -h or --help; pass on all other arguments."""
        if args[:1] in (["-h"], ["--help"]):
            click.echo(ctx.get_help())
            ctx.exit()
        return super().parse_args(ctx, args)


@click.command(cls=_PassingThrough, context_settings=_PASS_THROUGH)
@click.argument("name", metavar="NAME[:STAGE]", shell_complete=completers.kinds)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
@options.allow_code
def node(name: str, arguments: tuple[str, ...]) -> None:
    """Run one node, as ``ros2 run lathe_rc NAME`` does; --help lists its parameters."""
    own, _, kind = name.partition(":")
    kind = kind or own
    if name == MACHINE_STATE:
        if not help_or_refusal(f"lathe node {name}", name, MachineStateParameters, arguments):
            sys.exit(load(STANDALONE[name]).run({}, arguments))
        return
    if kind not in TABLES:
        raise InputError(f"no node {kind!r}; {TABLES.instead(kind)}")
    if not help_or_refusal(f"lathe node {name}", own, TABLES[kind], arguments):
        _run([name, *arguments])


@click.command(cls=_PassingThrough, context_settings=_PASS_THROUGH)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED, shell_complete=completers.kinds)
@options.allow_code
def container(arguments: tuple[str, ...]) -> None:
    """Run several nodes in one process: NODE[:STAGE]... [--ros-args ...]."""
    _run(arguments)


def _run(arguments: Sequence[str]) -> None:
    load("lathe_rc.nodes.process").run_and_exit(arguments)
