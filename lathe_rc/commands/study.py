# SPDX-License-Identifier: Apache-2.0
"""The command group ``lathe study``: one command a study."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem
from rich.console import Console
from rich.progress import Progress

from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import Row, Value
from lathe_rc.commands import completers, options, picture
from lathe_rc.errors import InputError
from lathe_rc.names import instead
from lathe_rc.study import STUDIES, Result, Study, StudyParameters


def _value(row: Row, text: str) -> object:
    """The value that ``text`` gives a parameter: 1,2,3 is a list where one is wanted, and a text stands as it is."""

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


def _save(study: Study[Any], result: Result, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=study.size, layout="constrained")
    result.draw(figure)
    picture.save(figure, path)


class _StudyCommand(click.Command):
    """Runs a study; its help lists the parameters."""

    def __init__(self, name: str, subject: Study[Any]) -> None:
        self.subject = subject
        super().__init__(name, callback=self._run, help=subject.doc)
        figure = Path(f"study-{subject.name}.png")
        click.option(
            "--set",
            "overrides",
            multiple=True,
            metavar="PARAM=VALUE",
            shell_complete=self._complete,
            help="repeatable; lists as 1,2,3",
        )(self)
        click.option("--figure", type=options.PATH, default=figure, show_default=True, help="PNG to write")(self)
        options.as_json(self)
        if "quick" in subject.parameters.rows():
            click.option("--quick", is_flag=True, help="as --set quick=true")(self)

    def _complete(self, _ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return completers.beginning((f"{name}=" for name in self.subject.parameters.rows()), incomplete)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Append the parameters."""
        with formatter.section("Parameters"):
            formatter.write_dl(
                [
                    (name, f"{row.doc}; {row.allowed()}; default {json.dumps(row.default)}")
                    for name, row in self.subject.parameters.rows().items()
                ]
            )

    def _run(self, overrides: tuple[str, ...], figure: Path, *, as_json: bool, quick: bool = False) -> None:
        parameters = read(self.subject, (*overrides, "quick=true") if quick else overrides)
        picture.check_place(figure)
        console = Console(stderr=True)
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            result = self.subject.run(parameters, lambda items: progress.track(items, description=self.subject.name))
        _save(self.subject, result, figure)
        if as_json:
            click.echo(json.dumps({**result.to_json(), "figure": str(figure)}, allow_nan=False))
            return
        out = Console()
        out.print(result.table())
        out.print(f"figure: {figure}", highlight=False, soft_wrap=True)


class _Studies(click.Group):
    """The studies of lathe_rc and of other packages; an unknown one is refused in one line."""

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete a name without importing its study, or an option."""
        if not incomplete.startswith("-"):
            return completers.beginning(STUDIES, incomplete)
        return click.Command.shell_complete(self, ctx, incomplete)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all studies."""
        return list(STUDIES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of a study; None if there is none.

        Raises:
            InputError: a study of another package cannot be imported, or is none.
        """
        return _StudyCommand(cmd_name, STUDIES[cmd_name]) if cmd_name in STUDIES else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the studies with their subjects."""
        with formatter.section("Studies"):
            formatter.write_dl([(name, _summary(name)) for name in STUDIES])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Split off the name of a study.

        Raises:
            InputError: there is no such study.
        """
        if args[0] not in STUDIES and not args[0].startswith("-") and not ctx.resilient_parsing:
            raise InputError(f"no study {args[0]!r}; {instead(args[0], STUDIES)}, or PACKAGE.MODULE:STUDY")
        return super().resolve_command(ctx, args)


def _summary(name: str) -> str:
    """The subject of a study, and its package if it is not ours; a broken one does not hide the others."""
    by = STUDIES.offered_by(name)
    try:
        about = STUDIES[name].doc
    except InputError as error:
        return str(error)
    return f"{about} ({by})" if by else about


@click.group(cls=_Studies, invoke_without_command=True)
@options.allow_code
@click.pass_context
def study(ctx: click.Context) -> None:
    """Compute a table or figure of the papers; without a name, list the studies."""
    if ctx.invoked_subcommand is None:
        width = max(map(len, STUDIES))
        for name in STUDIES:
            click.echo(f"{name:{width}}  {_summary(name)}")
