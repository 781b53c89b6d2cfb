# SPDX-License-Identifier: Apache-2.0
"""End of commands that have read a bag of a run with lost members."""

from collections.abc import Iterable
from pathlib import Path

import click

from lathe_rc.bag.reading.source import BagSource
from lathe_rc.errors import LossyRunError


def tell(bags: Iterable[Path]) -> bool:
    """Print the losses of members in the runs of bags on the error stream; return whether there are any."""
    found = False
    for path in bags:
        with BagSource(path, partial=True) as source:
            if loss := source.loss:
                click.echo(f"{path}: {loss}", err=True)
                found = True
    return found


def end(*bags: Path) -> None:
    """End a command with exit code 3 and the reason if members were lost in a run whose bag it has read."""
    if tell(bags):
        raise click.exceptions.Exit(LossyRunError.exit_code)
