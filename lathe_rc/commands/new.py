# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe new``: create a user package that runs and has tests from the start."""

from pathlib import Path

import click

from lathe_rc.scaffold import KINDS, begin


@click.command()
@click.argument("kind", type=click.Choice(list(KINDS)))
@click.argument("name")
@click.option("--plain", is_flag=True, help="plain Python, without a compiled step: slower, with the same bits")
def new(kind: str, name: str, *, plain: bool) -> None:
    """Create a package NAME, in a folder of that name, with a control law, drive, stage or study of your own."""
    files = begin(kind, name, Path(), compiled=not plain)
    run = f"lathe run {name}.yaml" if KINDS[kind].members else f"lathe study --allow-code {name} {name}:STUDY"
    click.echo(f"{name}: {', '.join(files)}\nnext: cd {name} && {run}")
