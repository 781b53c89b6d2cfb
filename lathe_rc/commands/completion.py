# SPDX-License-Identifier: Apache-2.0
"""Command ``lathe completion``: shell scripts for command-line completion.

Click computes the completions, see `lathe_rc.commands.completers`. Click's own scripts append a blank to every word,
even to a node whose parameter is still missing, and those for zsh and fish call the `lathe` on the PATH instead of
./lathe.
"""

import os
import shlex
from pathlib import Path

import click
import platformdirs

from lathe_rc.errors import InputError, shown

_MARK = "# completion of lathe_rc"
_POSIX, _FISH = "[ ! -r {0} ] || . {0}", "test -r {0}; and source {0}"  # line in a start-up file
_SHELLS = ("bash", "zsh", "fish")


def _startup(shell: str) -> Path:
    """Return the start-up file of a shell."""
    home = Path.home()
    if shell == "fish":
        return Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config") / "fish" / "config.fish"
    return Path((shell == "zsh" and os.environ.get("ZDOTDIR")) or home) / f".{shell}rc"


@click.command()
@click.argument("shell", type=click.Choice(_SHELLS), required=False)
@click.option("--install", is_flag=True, help="put it into the file that the shell reads when it starts")
@click.option("--remove", is_flag=True, help="take it out of there")
def completion(shell: str | None, *, install: bool, remove: bool) -> None:
    """Print or install the shell script that completes commands, options, scenarios, nodes and parameters.

    SHELL defaults to that of $SHELL.
    """
    if install and remove:
        raise InputError("--install with --remove; allowed: one of them")
    name = shell or Path(os.environ.get("SHELL", "")).name
    if name not in _SHELLS:
        raise InputError(f"no shell {name!r}; allowed: {', '.join(_SHELLS)}")
    text = Path(__file__).with_suffix(f".{name}").read_text(encoding="utf-8")
    if not install and not remove:
        click.echo(text, nl=False)
        return
    script, startup = platformdirs.user_data_path("lathe_rc") / f"completion.{name}", _startup(name)
    place = shlex.quote(str(script))
    line = f"{(_FISH if name == 'fish' else _POSIX).format(place)}  {_MARK}\n"
    try:
        before = startup.read_text(encoding="utf-8") if startup.exists() else ""
        others = "".join(each for each in before.splitlines(keepends=True) if not each.rstrip().endswith(_MARK))
        if install:
            script.parent.mkdir(parents=True, exist_ok=True)
            script.write_text(text, encoding="utf-8")
            startup.parent.mkdir(parents=True, exist_ok=True)
            click.echo(f"script: {script}")
            if line in before:
                click.echo(f"{startup} has its line already")
                return
            startup.write_text(others + ("\n" if others and not others.endswith("\n") else "") + line, encoding="utf-8")
            click.echo(f"{startup}: one line added; it holds for shells that begin from now on, in this one: . {place}")
            return
        if others != before:
            startup.write_text(others, encoding="utf-8")
            click.echo(f"{startup}: the line is gone")
        if script.exists():
            script.unlink()
            click.echo(f"{script}: gone")
        elif others == before:
            click.echo(f"nothing to remove: {startup} has no line of lathe_rc")
    except (OSError, UnicodeError) as error:
        raise InputError(f"{startup} or {script}: {shown(error)}") from None
