# SPDX-License-Identifier: Apache-2.0
"""End of commands that have read a bag of a run with lost members."""

from collections.abc import Iterable
from pathlib import Path

import click

from lathe_rc.bag.reading.source import Source
from lathe_rc.errors import LossyRunError


def losses(bags: Iterable[Path]) -> list[str]:
    """Return the losses of members in the runs of bags, one line each."""
    found = []
    for path in bags:
        with Source(path, partial=True) as source:
            found += [f"{path}: {loss}" for loss in [source.loss] if loss]
    return found


def tell(bags: Iterable[Path]) -> bool:
    """Print the losses on the error stream; return whether there are any."""
    found = losses(bags)
    for line in found:
        click.echo(line, err=True)
    return bool(found)


def end(*bags: Path) -> None:
    """End a command with exit code 3 and the reason if members were lost in a run whose bag it has read."""
    if tell(bags):
        raise click.exceptions.Exit(LossyRunError.exit_code)
