# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe reference``: reference of nodes, topics, messages and parameters."""

import click

from lathe_rc import reference as pages
from lathe_rc.cell.scenario import TABLES
from lathe_rc.commands import options
from lathe_rc.errors import InputError


@click.command()
@click.argument("stages", nargs=-1)
@options.allow_code
def reference(stages: tuple[str, ...]) -> None:
    """Print the reference of nodes, topics, messages and parameters as Markdown, or only that of some STAGES."""
    for kind in stages:
        if kind not in TABLES:
            raise InputError(f"no stage {kind!r}; {TABLES.instead(kind)}")
    click.echo("\n\n".join(map(pages.node, stages)) if stages else pages.page(), nl=bool(stages))
