# SPDX-License-Identifier: Apache-2.0
"""Command line ``lathe``: commands are listed by name and imported only when called or completed.

Listing the commands takes only their names and summaries, so the list is printed without delay.
"""

import io
import os
import signal
import sys
from typing import Any

import click
from click.shell_completion import CompletionItem

from lathe_rc import __version__, allowed_code, extras
from lathe_rc.catalogue import COMMANDS
from lathe_rc.errors import LatheError, correctable, shown


class _Command(click.Command):
    """Command whose module is imported when it is called, not when it is listed."""

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """Return the Click context of the imported command."""
        return extras.command(str(self.name)).make_context(info_name, args, parent, **extra)


class Group(click.Group):
    """Command group that prints a lathe_rc error as one line and exits with the error's exit code."""

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete command names, including those of a checkout's launcher, listed in an environment variable."""
        also = os.environ.get("_LATHE_ALSO", "").split()
        own = [CompletionItem(name) for name in also if name.startswith(incomplete) and not incomplete.startswith("-")]
        return [*super().shell_complete(ctx, incomplete), *own]

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command; a lathe_rc error is printed as one line and sets the exit code."""
        # SIGTERM ends a command as Ctrl-C does: child processes are terminated and bags are closed.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="replace")  # for encodings without µ
        try:
            with extras.named(), allowed_code.call():
                return super().invoke(ctx)
        except (LatheError, OSError) as error:
            told = correctable(error)
            click.echo(f"lathe: {told}", err=True)
            ctx.exit(told.exit_code)
        except MemoryError as error:
            click.echo(f"lathe: not enough memory ({shown(error)})", err=True)
            ctx.exit(LatheError.exit_code)


@click.group(
    cls=Group,
    commands=[_Command(name, short_help=summary) for name, summary in COMMANDS.items()],
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="./lathe of a checkout also has: setup; test (linters and tests; --system: those that need privileges); "
    "docs (the documentation as a site); bench (how fast it is here); python SCRIPT (in its environment).",
)
@click.version_option(__version__)
def main() -> None:
    """Emulate the control cell of a lathe for non-circular turning."""
