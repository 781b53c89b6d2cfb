# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe export``: signals of a bag as CSV, Parquet or NumPy files."""

from pathlib import Path

import click

from lathe_rc.commands import options
from lathe_rc.errors import InputError


@click.command()
@options.bag
@click.option("--csv", "kinds", flag_value="csv", multiple=True, help="a CSV file for each topic")
@click.option("--parquet", "kinds", flag_value="parquet", multiple=True, help="a Parquet file for each topic")
@click.option("--npz", "kinds", flag_value="npz", multiple=True, help="one NumPy archive")
@click.option(
    "-o",
    "--output",
    type=options.PATH,
    help="folder, for --npz file, to make; must not exist; default: BAG-csv, BAG-parquet or BAG.npz, here",
)
@click.option("--topics", multiple=True, metavar="LIST", help="like /tool,/encoder; repeatable; default: all signals")
def export(bag: Path, kinds: tuple[str, ...], output: Path | None, topics: tuple[str, ...]) -> None:
    """Export the signal topics of a recording, with units."""
    if len(kinds) != 1:
        raise InputError(f"{len(kinds)} formats; allowed: one of --csv, --parquet and --npz")
    from lathe_rc.bag.exporting import export as exporting
    from lathe_rc.bag.reading.source import name_of

    (kind,) = kinds
    name = name_of(bag).removesuffix(".mcap")
    place = output or Path(f"{name}.npz" if kind == "npz" else f"{name}-{kind}")
    wanted = [topic.strip() for text in topics for topic in text.split(",") if topic.strip()]
    done = exporting.export_bag(bag, place, kind, wanted)
    click.echo(f"{len(done.rows)} topics, {sum(done.rows.values())} rows: {done.place}")
