# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe bench``: the benchmarks of the checkout, measured on the machine at hand."""

import json
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from benchmarks import growth, page, suite
from lathe_rc import cli
from lathe_rc.errors import InputError


def _stored(option: str, name: str) -> dict[str, Any]:
    path = next((path for path in (Path(name), suite.STORE / f"{name}.json") if path.is_file()), None)
    if path is None:
        known = ", ".join(sorted(path.stem for path in suite.STORE.glob("*.json"))) or "none yet"
        raise InputError(f"{option} {name}: no such file or stored commit; stored: {known}")
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except ValueError as error:
        raise InputError(f"{option} {path}: not a result of lathe bench ({error})") from None


def _write_page(result: dict[str, Any]) -> Path:
    """The page of a result, with its plot."""
    docs = Path(suite.ROOT) / "docs"
    if "growth" in result:
        growth.plot(result["growth"], docs / page.GROWTH_IMAGE)
    path = docs / "performance.md"
    path.write_text(page.page(result), encoding="utf-8")
    return path


def _table(result: dict[str, Any], other: dict[str, Any] | None) -> Table:
    table = Table(title=f"commit {result['commit']}", title_justify="left", show_edge=False, header_style="bold")
    table.add_column("figure")
    table.add_column("median", justify="right")
    before = suite.figures(other) if other else {}
    if other:
        table.add_column(str(other["commit"]), justify="right")
        table.add_column("ratio", justify="right")
    for name, value in suite.figures(result).items():
        if name.split(".")[0] in suite.PARTS:
            old = before.get(name)
            beside = [f"{old:.4g}", f"{value / old:.3g}" if old else ""] if old is not None else ["", ""]
            table.add_row(name, f"{value:.4g}", *(beside if other else []))
    return table


@click.command()
@click.argument("parts", nargs=-1)
@click.option("--quick", is_flag=True, help="under a minute; rough figures")
@click.option("--against", metavar="COMMIT|FILE", help="show the figures of a stored result beside these")
@click.option(
    "--page", "stored", metavar="COMMIT|FILE", help="measure nothing: make docs/performance.md of a stored result"
)
@click.option("--json", "as_json", is_flag=True, help="print one JSON object")
def bench(parts: tuple[str, ...], against: str | None, stored: str | None, *, quick: bool, as_json: bool) -> None:
    """Measure how fast lathe_rc is here, as ratios side by side; PARTS chooses some, default all.

    The result is kept under .lathe/bench by commit. docs/performance.md says what each figure means.
    """
    for part in parts:
        if part not in suite.PARTS:
            raise InputError(f"lathe bench {part}; allowed: {', '.join(suite.PARTS)}")
    if stored:
        click.echo(_write_page(_stored("--page", stored)))
        return
    other = _stored("--against", against) if against else None
    said = Console(stderr=True)
    chosen = parts or (suite.QUICK if quick else suite.PARTS)
    result = suite.run(chosen, quick=quick, say=lambda line: said.print(line, highlight=False))
    path = suite.store(result)
    if as_json:
        click.echo(json.dumps(result))
        return
    console = Console()
    console.print(_table(result, other))
    console.print(f"kept in {path}", highlight=False, soft_wrap=True)


main = cli.Group("lathe", commands=[bench], context_settings={"help_option_names": ["-h", "--help"]})

if __name__ == "__main__":
    main(prog_name="lathe")
