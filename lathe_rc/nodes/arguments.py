# SPDX-License-Identifier: Apache-2.0
"""The command line of a node's executable: what ROS does not answer or refuse; this module imports no ROS."""

import json
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, NoReturn

from lathe_rc import allowed_code
from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import Table
from lathe_rc.errors import InputError, LatheError

ROS = "--ros-args"  #: what follows is for ROS
_TAKEN = f"allowed: --help, or {ROS} and what ROS takes: --params-file FILE, -p PARAM:=VALUE, -r OLD:=NEW"

_LONGEST_END = 20  # [s] that destructors may take


class Rule(NamedTuple):
    """A parameter on the command line.

    Attributes:
        text: ``NODE:PARAM:=VALUE``, as it was given.
        node: whom it is for; empty: everybody.
        parameter: its name.
        value: as YAML.
    """

    text: str
    node: str
    parameter: str
    value: str


def ask_for_help(words: Sequence[str]) -> bool:
    """Whether a command line does."""
    return "--help" in words or "-h" in words


def split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The arguments before ``--ros-args``, and the rest."""
    end = list(words).index(ROS) if ROS in words else len(words)
    return list(words[:end]), list(words[end:])


def help_or_refusal(program: str, name: str, table: type[Table], words: Sequence[str]) -> bool:
    """Show a node's help if it is asked for.

    Args:
        program: how the node is started.
        name: of the node.
        table: its parameters.
        words: the command line.

    Returns:
        Whether it was shown.

    Raises:
        InputError: something that ROS would pass over.
    """
    if ask_for_help(words):
        _show(program, name, table)
        return True
    if before := split(words)[0]:
        raise InputError(f"{name}: {before[0]!r}; {_TAKEN}")
    return False


def _show(program: str, name: str, table: type[Table]) -> None:
    from rich.console import Console
    from rich.table import Table as RichTable
    from rich.text import Text

    print(
        f"usage: {program} [{ROS} --params-file FILE -p {name}:PARAM:=VALUE -r OLD:=NEW ...]\n\n"
        f"Write -p behind --params-file: what comes later wins. -p PARAM:=VALUE, without {name}:, is for /**; if the\n"
        f"file has a /**, it takes that place, and an entry of {name} below wins. A -p that loses is refused.\n"
    )
    parameters = RichTable(title=f"parameters of {name}", title_justify="left", show_edge=False, header_style="bold")
    for column in ("name", "default", "allowed", "description"):
        parameters.add_column(column, overflow="fold")
    for row in table.rows().values():
        # as Text: rich would take the unit in brackets for markup
        default = Text(json.dumps(row.default, ensure_ascii=False))
        parameters.add_row(row.name, default, Text(row.allowed()), Text(row.doc))
    Console().print(parameters)


def executable(name: str, table: type[Table], run: Callable[[list[str]], int]) -> NoReturn:
    """Be the executable of a node: answer or refuse its command line, or run it, and exit.

    Args:
        name: of the node and its executable.
        table: its parameters.
        run: what it does with a command line of ROS; returns the exit code.
    """

    def work() -> int:
        words = allowed_code.taken_from(sys.argv[1:])
        return 0 if help_or_refusal(f"ros2 run lathe_rc {name}", name, table, words) else run(words)

    exit_with(work)


def exit_with(work: Callable[[], int]) -> NoReturn:
    """Exit with the code of some work, or with that of its error after one line."""
    try:
        code = work()
    except LatheError as error:
        print(f"lathe: {error}", file=sys.stderr)
        code = error.exit_code
    bound_the_end()
    sys.exit(code)


def bound_the_end() -> None:
    """Let SIGALRM end this process if it does not leave: in one of some hundred ends Fast DDS waits for itself."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(_LONGEST_END)


def rules(words: Sequence[str]) -> Iterator[Rule]:
    """Each ``-p`` of a command line that ROS has accepted."""
    is_ros = False
    for word, following in pairwise([*words, ""]):
        if word in (ROS, "--"):
            is_ros = word == ROS
        elif is_ros and word in ("-p", "--param"):
            target, _, value = following.partition(":=")
            node, _, parameter = target.rpartition(":")
            yield Rule(following, node, parameter, value)


def parameter_files(words: Sequence[str]) -> list[Path]:
    """The parameter files of a command line of ROS."""
    return [Path(following) for word, following in pairwise([*words, ""]) if word == "--params-file"]


def texts(words: Sequence[str]) -> set[str]:
    """All texts that are values of parameters on a command line of ROS and in its files.

    Raises:
        InputError: a file cannot be read.
    """
    values = [ros_yaml.parse_value(rule.value, f"-p {rule.text}") for rule in rules(words)]
    values += [
        value for path in parameter_files(words) for own in ros_yaml.read(path).values() for value in own.values()
    ]
    return {value for value in values if isinstance(value, str)}
