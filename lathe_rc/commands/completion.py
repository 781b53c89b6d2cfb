# SPDX-License-Identifier: Apache-2.0
"""The command ``lathe completion``: what makes a shell complete the command line."""

import os
import shlex
from pathlib import Path
from typing import NamedTuple

import click
import platformdirs

from lathe_rc import completing
from lathe_rc.errors import InputError, shown

_MARK = "# completion of lathe_rc"


class _Shell(NamedTuple):
    """A shell.

    Attributes:
        rc: the file that it reads when it starts.
        line: its line in that file; {} is the script.
    """

    rc: Path
    line: str


_BASH = """\
_lathe_complete() {
    local IFS=$'\\n' told kind value
    told=$(COMP_WORDS="${COMP_WORDS[*]}" COMP_CWORD=$COMP_CWORD _LATHE_COMPLETE=bash_complete \\
        "${1/#\\~/$HOME}" 2>/dev/null)
    COMPREPLY=()
    for each in $told; do
        IFS=',' read -r kind value <<< "$each"
        case $kind in
            dir) compopt -o dirnames ;;
            file) compopt -o default ;;
            plain) COMPREPLY+=("$value") ;;
        esac
    done
    # A node or a parameter goes on behind its point or equals sign.
    if [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *[.=] ]]; then compopt -o nospace; fi
}
complete -o nosort -F _lathe_complete lathe
"""

_ZSH = """\
if ! (( $+functions[compdef] )); then autoload -Uz compinit && compinit; fi
_lathe_complete() {
    local -a described plain open told
    local kind value about
    export COMP_WORDS="${words[*]}" COMP_CWORD=$((CURRENT-1))
    told=("${(@f)$(_LATHE_COMPLETE=zsh_complete ${~words[1]} 2>/dev/null)}")
    unset COMP_WORDS COMP_CWORD
    for kind value about in $told; do
        case $kind in
            dir) _path_files -/ ;;
            file) _path_files -f ;;
            plain)
                # A node or a parameter goes on behind its point or equals sign.
                if [[ $value == *[.=] ]]; then open+=($value)
                elif [[ $about == _ ]]; then plain+=($value)
                else described+=("${value//:/\\\\:}:$about"); fi ;;
        esac
    done
    (( $#described )) && _describe -V lathe described -U
    (( $#plain )) && compadd -U -V lathe -a plain
    (( $#open )) && compadd -U -S '' -V lathe -a open
    return 0
}
compdef _lathe_complete lathe
"""

_FISH = """\
function _lathe_complete
    set -l words (commandline -opc)
    set -l command (string replace -r '^~' $HOME $words[1])
    for each in (env _LATHE_COMPLETE=fish_complete COMP_WORDS=(commandline -cp | string collect) \\
            COMP_CWORD=(commandline -t | string collect) $command 2>/dev/null)
        set -l told (string split -m 1 , $each)
        switch $told[1]
            case dir
                __fish_complete_directories $told[2]
            case file
                __fish_complete_path $told[2]
            case plain
                echo $told[2]
        end
    end
end
complete --no-files --command lathe --arguments '(_lathe_complete)'
"""

_SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}


def _shells() -> dict[str, _Shell]:
    home = Path.home()
    zsh = Path(os.environ.get("ZDOTDIR") or home)
    config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    return {
        "bash": _Shell(home / ".bashrc", "[ ! -r {} ] || . {}"),
        "zsh": _Shell(zsh / ".zshrc", "[ ! -r {} ] || . {}"),
        "fish": _Shell(config / "fish" / "config.fish", "test -r {}; and source {}"),
    }


@click.command()
@click.argument("shell", type=click.Choice(list(_SCRIPTS)), required=False)
@click.option("--install", is_flag=True, help="put it into the file that the shell reads when it starts")
@click.option("--remove", is_flag=True, help="take it out of there")
def completion(shell: str | None, *, install: bool, remove: bool) -> None:
    """Make the shell complete commands, options, scenarios, nodes, parameters: print the script, or install it.

    SHELL is that of $SHELL if none is given.
    """
    if install and remove:
        raise InputError("--install with --remove; allowed: one of them")
    name = shell or Path(os.environ.get("SHELL", "")).name
    if name not in _SCRIPTS:
        raise InputError(f"no shell {name!r}; allowed: {', '.join(_SCRIPTS)}")
    if not install and not remove:
        click.echo(_SCRIPTS[name], nl=False)
        return
    rc, line = _shells()[name]
    script = platformdirs.user_data_path("lathe_rc") / f"completion.{name}"
    try:
        if install:
            _install(name, script, rc, line)
        else:
            _remove(script, rc)
    except (OSError, UnicodeError) as error:
        raise InputError(f"{rc} or {script}: {shown(error)}") from None


def _lines(rc: Path) -> list[str]:
    return rc.read_text(encoding="utf-8").splitlines(keepends=True) if rc.exists() else []


def _install(name: str, script: Path, rc: Path, line: str) -> None:
    script.parent.mkdir(parents=True, exist_ok=True)
    script.write_text(_SCRIPTS[name], encoding="utf-8")
    completing.known()  # so that the first completion need not look
    click.echo(f"script: {script}")
    place = shlex.quote(str(script))
    wanted = f"{line.format(place, place)}  {_MARK}\n"
    lines = _lines(rc)
    if wanted in lines:
        click.echo(f"{rc} has its line already")
        return
    kept = "".join(each for each in lines if not each.rstrip().endswith(_MARK))
    rc.parent.mkdir(parents=True, exist_ok=True)
    rc.write_text(kept + ("\n" if kept and not kept.endswith("\n") else "") + wanted, encoding="utf-8")
    click.echo(f"{rc}: one line added; it holds for shells that begin from now on, in this one: . {place}")


def _remove(script: Path, rc: Path) -> None:
    lines = _lines(rc)
    kept = [each for each in lines if not each.rstrip().endswith(_MARK)]
    if kept != lines:
        rc.write_text("".join(kept), encoding="utf-8")
        click.echo(f"{rc}: the line is gone")
    if script.exists():
        script.unlink()
        click.echo(f"{script}: gone")
    elif kept == lines:
        click.echo(f"nothing to remove: {rc} has no line of lathe_rc")
