# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe compare``: HTML page of several runs side by side."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import click

from lathe_rc import allowed_code
from lathe_rc.commands import lossy, measured, options


@click.command()
@click.argument("runs", type=options.PATH, nargs=-1, required=True)
@click.option("-o", "--output", type=options.PATH, default=Path("compare.html"), show_default=True, help="HTML file")
@options.allow_code
def compare(runs: Sequence[Path], output: Path) -> None:
    """Write several RUNS side by side as one page: bags, or scenarios, which run offline first.

    The page opens without a network. A revolution and a tolerance chosen on it apply to all figures.
    """
    from lathe_rc import harness
    from lathe_rc.commands import scenario as scenarios
    from lathe_rc.view import compare as comparing

    with tempfile.TemporaryDirectory(prefix="lathe-compare-") as folder:
        bags = dict(zip(comparing.names_of(runs), runs, strict=True))
        comparing.check(bags, output)
        for number, (name, path) in enumerate(bags.items()):
            if not measured.is_bag(path):
                allowed_code.allow_own_code()
                bags[name] = Path(folder) / str(number)
                harness.run(scenarios.load(str(path), []), bag=bags[name])
        comparing.write_comparison(bags, output, [str(path) for path in runs])
    click.echo(f"comparison: {output}")
    lossy.end(*filter(measured.is_bag, runs))
