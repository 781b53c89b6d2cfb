# SPDX-License-Identifier: Apache-2.0
"""The command group ``lathe study``: one command a study."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import Progress

from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import Row, Value
from lathe_rc.errors import InputError
from lathe_rc.names import instead
from lathe_rc.studies import STUDIES
from lathe_rc.studies.study import Result, Study, StudyParameters


def _value(row: Row, text: str) -> object:
    """What ``text`` says about a parameter: 1,2,3 is a list where one is wanted, and a text stands as it is."""

    def scalar(part: str) -> Value:
        return part if row.type is str else ros_yaml.parse_value(part, f"--set {row.name}")

    if not row.is_list:
        return scalar(text)
    bare = text.strip()
    if bare.startswith("[") and bare.endswith("]"):
        bare = bare[1:-1]
    return [scalar(part.strip()) for part in bare.split(",")]


def read(study: Study[Any], overrides: Sequence[str]) -> StudyParameters:
    """The parameters of a study from ``PARAM=VALUE`` texts, applied in order.

    Raises:
        InputError: one line for the first that is refused.
    """
    rows = study.parameters.rows()
    values: dict[str, object] = {}
    for override in overrides:
        name, equals, text = override.partition("=")
        if not equals:
            raise InputError(f"--set {override!r}; allowed: PARAM=VALUE; lathe study {study.name} --help lists PARAM")
        name = name.strip()
        values[name] = _value(rows[name], text) if name in rows else text
    table: StudyParameters = study.parameters.read(study.name, values)
    return table


def _check_place(path: Path) -> None:
    """Refuse before anything is computed."""
    if path.suffix.lower() != ".png":
        raise InputError(f"--figure {path}; allowed: a file name that ends in .png")
    if path.is_dir() or not path.parent.is_dir():
        raise InputError(f"--figure {path}: {'is a folder' if path.is_dir() else 'no such folder'}; name a file")


def _save(study: Study[Any], result: Result, path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=study.size, layout="constrained")
    FigureCanvasAgg(figure)
    result.draw(figure)
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise InputError(f"--figure {path}: cannot be written ({error.strerror})") from None


class _StudyCommand(click.Command):
    """Runs a study; its help lists the parameters."""

    def __init__(self, subject: Study[Any]) -> None:
        options = [
            click.Option(
                ["--set", "overrides"], multiple=True, metavar="PARAM=VALUE", help="repeatable; lists as 1,2,3"
            ),
            click.Option(
                ["--figure"],
                type=click.Path(path_type=Path),
                default=Path(f"study-{subject.name}.png"),
                show_default=True,
                help="PNG to write",
            ),
            click.Option(["--json", "as_json"], is_flag=True, help="print one JSON object"),
        ]
        super().__init__(subject.name, params=list(options), callback=self._run, help=subject.doc)
        self._subject = subject

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Append the parameters."""
        with formatter.section("Parameters"):
            formatter.write_dl(
                [
                    (name, f"{row.doc}; {row.allowed()}; default {json.dumps(row.default)}")
                    for name, row in self._subject.parameters.rows().items()
                ]
            )

    def _run(self, overrides: tuple[str, ...], figure: Path, *, as_json: bool) -> None:
        parameters = read(self._subject, overrides)
        _check_place(figure)
        console = Console(stderr=True)
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            result = self._subject.run(parameters, lambda items: progress.track(items, description=self._subject.name))
        _save(self._subject, result, figure)
        if as_json:
            click.echo(json.dumps({**result.to_json(), "figure": str(figure)}, allow_nan=False))
            return
        out = Console()
        out.print(result.table())
        out.print(f"figure: {figure}", highlight=False, soft_wrap=True)


class _Studies(click.Group):
    """The studies; refuses an unknown one in one line."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """See `click.Group`."""
        if args[0] not in self.commands and not args[0].startswith("-") and not ctx.resilient_parsing:
            raise InputError(f"no study {args[0]!r}; {instead(args[0], self.commands)}")
        return super().resolve_command(ctx, args)


@click.group(cls=_Studies, invoke_without_command=True)
@click.pass_context
def study(ctx: click.Context) -> None:
    """Compute a table or figure of the papers; without a name, list the studies."""
    if ctx.invoked_subcommand is None:
        width = max(map(len, STUDIES))
        for name, subject in STUDIES.items():
            click.echo(f"{name:{width}}  {subject.doc}")


for _subject in STUDIES.values():
    study.add_command(_StudyCommand(_subject))
