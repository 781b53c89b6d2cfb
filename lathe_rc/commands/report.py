# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe report``: HTML page of a recording."""

from pathlib import Path

import click

from lathe_rc.commands import lossy, options
from lathe_rc.errors import LossyRunError


@click.command()
@options.bag
@click.option("-o", "--output", type=options.PATH, default=Path("report.html"), show_default=True, help="HTML file")
@options.allow_code
@click.option("--budget", is_flag=True, help="what the form error is made of, by some ten runs of the bag's scenario")
@click.pass_context
def report(ctx: click.Context, bag: Path, output: Path, *, budget: bool) -> None:
    """Write a recording as one page with result, figures and losses; the page opens without a network.

    Exit code 3: the recording of a cell is incomplete, and so is what the page says of it.
    """
    from lathe_rc.view import report as reporting

    gathered = reporting.write_report(bag, output, with_budget=budget)
    if not gathered.complete:
        why = gathered.stopped or ("" if gathered.samples else gathered.missing)
        click.echo(f"incomplete recording{': ' + why if why else ''}", err=True)
    click.echo(f"report: {output}")
    lost = lossy.tell([bag])
    ctx.exit(LossyRunError.exit_code if lost or gathered.is_lossy else 0)
