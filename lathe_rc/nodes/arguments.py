# SPDX-License-Identifier: Apache-2.0
"""Command line of a node's executable: help, and the errors that ROS does not report; imports no ROS."""

import atexit
import ctypes
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, NoReturn

from lathe_rc import allowed_code
from lathe_rc.cell import ros_yaml
from lathe_rc.cell.parameters import Table
from lathe_rc.errors import InputError, LatheError

ROS = "--ros-args"  #: the arguments after it are for ROS
_TAKEN = f"allowed: --help, or {ROS} and what ROS takes: --params-file FILE, -p PARAM:=VALUE, -r OLD:=NEW"

_LONGEST_END = 10  # [s] that destructors may take
_THREAD = 2  # SIGEV_THREAD: a timer calls a function


class Rule(NamedTuple):
    """Parameter rule (``-p``) on the command line.

    Attributes:
        text: rule as given, ``NODE:PARAM:=VALUE``.
        node: name of the target node; empty: all nodes.
        parameter: name of the parameter.
        value: value in YAML.
    """

    text: str
    node: str
    parameter: str
    value: str


def ask_for_help(words: Sequence[str]) -> bool:
    """Return True if a command line asks for help."""
    return "--help" in words or "-h" in words


def split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split a command line into the arguments before ``--ros-args`` and the rest."""
    end = list(words).index(ROS) if ROS in words else len(words)
    return list(words[:end]), list(words[end:])


def help_or_refusal(program: str, name: str, table: type[Table], words: Sequence[str]) -> bool:
    """Show a node's help if requested; otherwise check its command line.

    Args:
        program: command that starts the node.
        name: name of the node.
        table: parameter table of the node.
        words: command line.

    Returns:
        True if the help was shown.

    Raises:
        InputError: an argument that ROS would ignore.
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
        # as Text: rich would parse the unit in brackets as markup
        default = Text(json.dumps(row.default, ensure_ascii=False))
        parameters.add_row(row.name, default, Text(row.allowed()), Text(row.doc))
    Console().print(parameters)


def executable(name: str, table: type[Table], run: Callable[[list[str]], int]) -> NoReturn:
    """Run the executable of a node: show its help, report errors of its command line or run the node, and exit.

    Args:
        name: name of the node and its executable.
        table: parameter table of the node.
        run: function that runs the node with a ROS command line and returns the exit code.
    """

    def work() -> int:
        words = allowed_code.taken_from(sys.argv[1:])
        return 0 if help_or_refusal(f"ros2 run lathe_rc {name}", name, table, words) else run(words)

    exit_with(work)


def exit_with(work: Callable[[], int]) -> NoReturn:
    """Exit with the exit code of a function; print a `LatheError` in one line and exit with its code."""
    try:
        code = work()
    except LatheError as error:
        print(f"lathe: {error}", file=sys.stderr)
        code = error.exit_code
    atexit.register(_bound_the_end, code)
    sys.exit(code)


class _Notification(ctypes.Structure):
    """``struct sigevent`` of glibc with a function: its value, signal, kind, function and attributes."""

    _fields_ = (
        ("value", ctypes.c_long),
        ("signal", ctypes.c_int),
        ("kind", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("rest", ctypes.c_char * 40),
    )


def _bound_the_end(code: int) -> None:
    """Let a timer end this process if its exit hangs: about one in some hundred exits of Fast DDS deadlocks.

    The timer calls ``_exit`` with the exit code in a thread of its own. A handler in Python would need the
    interpreter, which waits for the destructor that hangs; a signal alone would lose the exit code.
    """
    libc = ctypes.CDLL(None)
    end = ctypes.cast(libc["_exit"], ctypes.c_void_p)
    timer = ctypes.c_void_p()
    libc.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(_Notification(code, 0, _THREAD, end)), ctypes.byref(timer))
    libc.timer_settime(timer, 0, (ctypes.c_long * 4)(0, 0, _LONGEST_END, 0), None)  # interval and first time: s, ns


def rules(words: Sequence[str]) -> Iterator[Rule]:
    """Yield each ``-p`` rule of a valid ROS command line."""
    is_ros = False
    for word, following in pairwise([*words, ""]):
        if word in (ROS, "--"):
            is_ros = word == ROS
        elif is_ros and word in ("-p", "--param"):
            target, _, value = following.partition(":=")
            node, _, parameter = target.rpartition(":")
            yield Rule(following, node, parameter, value)


def check_namespaces(words: Sequence[str]) -> None:
    """Reject a namespace without a slash in front, for which rcl has a message about lexemes.

    Raises:
        InputError: a remapping rule gives such a namespace.
    """
    for rule in words:
        place, assigns, namespace = rule.partition("__ns:=")
        if assigns and not namespace.startswith("/"):
            raise InputError(f"-r {rule}: no absolute namespace; write -r {place}__ns:=/{namespace}")


def parameter_files(words: Sequence[str]) -> list[Path]:
    """Return the parameter files of a ROS command line."""
    return [Path(following) for word, following in pairwise([*words, ""]) if word == "--params-file"]


def texts(words: Sequence[str]) -> set[str]:
    """Return all string values of parameters on a ROS command line and in its parameter files.

    Raises:
        InputError: a parameter file cannot be read.
    """
    values = [ros_yaml.parse_value(rule.value, f"-p {rule.text}") for rule in rules(words)]
    values += [
        value for path in parameter_files(words) for own in ros_yaml.read(path).values() for value in own.values()
    ]
    return {value for value in values if isinstance(value, str)}
