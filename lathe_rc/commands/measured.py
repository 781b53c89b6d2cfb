# SPDX-License-Identifier: Apache-2.0
"""Argument and options of commands that read a measurement."""

from collections.abc import Sequence
from pathlib import Path

import click

from lathe_rc.commands import lossy, options
from lathe_rc.signals import measurement_file
from lathe_rc.signals.measurement_file import MeasuredQuantities
from lathe_rc.signals.quantities import parse_columns

_BAGS = (".mcap", ".db3", ".zstd")

argument = click.argument("measured", type=options.PATH)
columns = click.option(
    "--column",
    "columns",
    multiple=True,
    metavar="QUANTITY=COLUMN[:UNIT]",
    help="where the file names it otherwise, such as command=u_um:um or response=/joint_states.position[x]; repeatable",
)


def is_bag(path: Path) -> bool:
    """Return True for the path of a recording."""
    return path.is_dir() or path.suffix in _BAGS


def tell_origin(path: Path) -> None:
    """Print to stderr of which bags a bag was made, if it was not recorded."""
    from lathe_rc.bag import provenance
    from lathe_rc.bag.reading.source import BagSource

    with BagSource(path) as source:
        for what in provenance.origin(source.about):
            click.echo(f"lathe: warning: {path}: {what}", err=True)


def opened(path: Path, given: Sequence[str]) -> MeasuredQuantities:
    """Open a file or a bag with the columns that the options name.

    Raises:
        InputError: the path has no measurement, or an option names no column of it.
        LatheError: the package that reads the format is not installed.
    """
    mapping = parse_columns(given)
    if is_bag(path):
        lossy.tell([path])
        from lathe_rc.commands import bag_columns

        return bag_columns.measurement(path, mapping)
    return measurement_file.read(path, mapping)
