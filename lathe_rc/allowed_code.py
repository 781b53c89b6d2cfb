# SPDX-License-Identifier: Apache-2.0
"""Permissions for code and files named by untrusted data: a bag, a scenario inside a bag, or a member's announcement.

Code is imported only if an installed package offers it through a lathe_rc entry point, or if the user has allowed its
package, either with ``--allow-code`` or through the user's own scenario in ``lathe run`` or in a Python program.
Untrusted data may only name files in its own folder.

This module holds the list of allowed packages, one list per command call; child processes are given the same list.
"""

import contextlib
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

from lathe_rc.errors import InputError, shown

OPTION = "--allow-code"
FILES = frozenset({"fmu_file"})  #: parameters whose files are machine code; only the user may name one

_STORAGES = {".mcap", ".db3"}
_METADATA, _HEAD = "metadata.yaml", b"rosbag2_bagfile_information"


@dataclass
class _Call:
    """Permissions of one command call.

    Attributes:
        allowed: packages that may be imported.
        here: allowed packages that are also searched for in the current folder, after all installed packages.
        folder: current folder when the first of these packages was allowed.
        own: whether packages named by the user's own scenarios are allowed.
        own_is_here: whether packages named by these scenarios are also searched for in the current folder.
        named: function that returns the strings of the user's parameter files and command line, including paths.
    """

    allowed: set[str] = field(default_factory=set)
    here: set[str] = field(default_factory=set)
    folder: str = ""
    own: bool = False
    own_is_here: bool = False
    named: Callable[[], Collection[str]] = tuple


_calls = [_Call(own=True)]  # the first entry is for Python programs outside a command


class _CurrentFolder(MetaPathFinder):
    """Import finder for allowed packages in the current folder.

    The folder itself is not added to Python's path: its other files would replace missing modules, metadata in the
    folder would count as that of an installed package, and a ``sitecustomize.py`` would run in child processes.
    """

    importing = False  #: whether an allowed package is being imported, so that the modules beside it are allowed too

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find an allowed module in the current folder (implements `importlib.abc.MetaPathFinder`)."""
        now = _calls[-1]
        if path is not None or not now.folder or not (self.importing or fullname in now.here):
            return None
        specs = (finder.find_spec(fullname, path, target) for finder in sys.meta_path if finder is not self)
        if any(spec.origin for spec in specs if spec):  # a folder of that name without __init__.py has none
            return None
        return PathFinder.find_spec(fullname, [now.folder], target)


_finder = _CurrentFolder()


@contextlib.contextmanager
def call(*, own: bool = False) -> Iterator[None]:
    """Begin a command call with an empty list of allowed packages; permissions granted in the block end with the block.

    Args:
        own: whether packages named by the user's own scenarios are allowed, as in a Python program.
    """
    _calls.append(_Call(own=own))
    try:
        yield
    finally:
        _calls.pop()


@contextlib.contextmanager
def importing(module: str) -> Iterator[None]:
    """Let an allowed package of the current folder import the modules beside it, within the block."""
    before, _finder.importing = _finder.importing, module.partition(".")[0] in _calls[-1].here
    try:
        yield
    finally:
        _finder.importing = before


def allow(package: str) -> None:
    """Allow a package, which may be in the current folder.

    Raises:
        InputError: the string is not a package name.
    """
    if not package.isidentifier():
        raise InputError(f"{OPTION} {shown(package)!r}; allowed: the name of a package, without dots, like my_law")
    _allow(package, here=True)


def allow_named(name: object) -> None:
    """Allow the package of a class ``package.module:Class`` named in a user's own scenario, if this call permits it."""
    module, colon, _ = str(name).partition(":")
    if colon and _calls[-1].own:
        _allow(module.partition(".")[0], here=_calls[-1].own_is_here)


def _allow(package: str, *, here: bool) -> None:
    now = _calls[-1]
    now.allowed.add(package)
    if here:
        now.here.add(package)
        now.folder = now.folder or str(Path.cwd())
        if _finder not in sys.meta_path:
            sys.meta_path.insert(0, _finder)


def allow_own_code() -> None:
    """Allow packages named by the user's own scenarios, also from the current folder unless this folder is in a bag."""
    _calls[-1].own, _calls[-1].own_is_here = True, bag_around(Path.cwd()) is None


def is_allowed(module: str) -> bool:
    """Return whether the user has allowed the package of a module."""
    return module.partition(".")[0] in _calls[-1].allowed


def arguments() -> list[str]:
    """Return the command-line options that allow the same packages in a child process."""
    return [word for package in sorted(_calls[-1].allowed) for word in (OPTION, package)]


def taken_from(words: Sequence[str]) -> list[str]:
    """Allow the packages of all ``--allow-code`` options, and return the command line without these options.

    Raises:
        InputError: an option names no package.
    """
    rest, waiting = list[str](), iter(words)
    for word in waiting:
        option, equals, package = word.partition("=")
        if option == OPTION:
            allow(package if equals else next(waiting, ""))
        else:
            rest.append(word)
    return rest


def interpreter(module: str) -> list[str]:
    """Return the command that runs a module as ``python -m`` does, but without the current folder on the path."""
    # Python 3.10 has no -P.
    run = "import sys; sys.path[:] = filter(None, sys.path); from runpy import run_module; "
    return [sys.executable, "-c", f"{run}run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)", module]


def bag_around(folder: Path) -> Path | None:
    """Return the bag that a folder is or belongs to; None if there is none.

    A folder counts as a bag if it contains storage files or metadata of a ROS 2 bag.
    """
    try:
        here = folder.resolve()
        if any(file.suffix in _STORAGES for file in here.iterdir()):
            return here
        return next((each for each in (here, *here.parents) if _is_bag(each / _METADATA)), None)
    except OSError:
        return None  # the error is reported when the folder is read


def _is_bag(metadata: Path) -> bool:
    if not metadata.is_file():
        return False
    with metadata.open("rb") as stream:
        return _HEAD in stream.read(len(_HEAD) + 64)


def user_names(texts: Callable[[], Collection[str]]) -> None:
    """Set the function that returns the strings of the user's parameter files and command line.

    Members may announce files that these strings name.
    """
    _calls[-1].named = texts


def is_named(path: str) -> bool:
    """Return whether the user's parameter files or command line name a file (see `user_names`)."""
    return path in _calls[-1].named()
