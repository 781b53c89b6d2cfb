# SPDX-License-Identifier: Apache-2.0
"""Command group ``lathe study``: one command per study."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem
from rich.console import Console
from rich.progress import Progress

from lathe_rc import allowed_code
from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import ParameterRow, Value
from lathe_rc.commands import completers, options, picture, tables
from lathe_rc.errors import InputError
from lathe_rc.names import instead
from lathe_rc.study import STUDIES, Study, StudyParameters, StudyResult


def _value(row: ParameterRow, text: str) -> object:
    """Parse a parameter's string, such as 1,2,3 for a list; a string parameter keeps the string unchanged."""

    def scalar(part: str) -> Value:
        return part if row.type is str else ros_yaml.parse_value(part, f"--set {row.name}")

    if not row.is_list:
        return scalar(text)
    bare = text.strip()
    if bare.startswith("[") and bare.endswith("]"):
        bare = bare[1:-1]
    return [scalar(part.strip()) for part in bare.split(",")]


def read(study: Study[Any], overrides: Sequence[str]) -> StudyParameters:
    """Return the parameters of a study from ``PARAM=VALUE`` strings, applied in order.

    Raises:
        InputError: a parameter or value is not allowed; the one-line message names the first one.
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


def _save(study: Study[Any], result: StudyResult, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=study.size, layout="constrained")
    result.draw(figure)
    picture.save(figure, path)


class _StudyCommand(click.Command):
    """Command that runs a study and lists its parameters in the help."""

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
        if "law" in subject.parameters.rows():
            entered = "as --set law=...; the class may be in the current folder"
            click.option("--law", metavar="PACKAGE.MODULE:CLASS", help=entered)(self)

    def _complete(self, _ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return completers.beginning((f"{name}=" for name in self.subject.parameters.rows()), incomplete)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Append the parameters of the study to the help."""
        with formatter.section("Parameters"):
            formatter.write_dl(
                [
                    (name, f"{row.doc}; {row.allowed()}; default {json.dumps(row.default)}")
                    for name, row in self.subject.parameters.rows().items()
                ]
            )

    def _run(
        self, overrides: tuple[str, ...], figure: Path, *, as_json: bool, quick: bool = False, law: str | None = None
    ) -> None:
        if law is not None:
            allowed_code.allow_own_code()
            allowed_code.allow_named(law)
            overrides = (*overrides, f"law={law}")
        parameters = read(self.subject, (*overrides, "quick=true") if quick else overrides)
        picture.check_place(figure)
        console = Console(stderr=True)
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            result = self.subject.run(parameters, lambda items: progress.track(items, description=self.subject.name))
        _save(self.subject, result, figure)
        if as_json:
            click.echo(json.dumps({**result.to_json(), "figure": str(figure)}, allow_nan=False))
            return
        out = tables.console(soft_wrap=False)
        out.print(result.table())
        out.print(f"figure: {figure}", soft_wrap=True)


class _Studies(click.Group):
    """Command group of the built-in and third-party studies; an unknown name is a one-line error."""

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete an option or the name of a study, without importing the study."""
        if not incomplete.startswith("-"):
            return completers.beginning(STUDIES, incomplete)
        return click.Command.shell_complete(self, ctx, incomplete)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all studies."""
        return list(STUDIES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of a study; None if there is no such study.

        Raises:
            InputError: a third-party study cannot be imported, or is not a study.
        """
        return _StudyCommand(cmd_name, STUDIES[cmd_name]) if cmd_name in STUDIES else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the studies with their summaries in the help."""
        with formatter.section("Studies"):
            formatter.write_dl([(name, _summary(name)) for name in STUDIES])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Split the arguments into the name of a study and the rest.

        Raises:
            InputError: there is no such study.
        """
        if args[0] not in STUDIES and not args[0].startswith("-") and not ctx.resilient_parsing:
            raise InputError(f"no study {args[0]!r}; {instead(args[0], STUDIES)}, or PACKAGE.MODULE:STUDY")
        return super().resolve_command(ctx, args)


def _summary(name: str) -> str:
    """Return the summary of a study, with its package if it is third-party; an import error is returned as text."""
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
