# SPDX-License-Identifier: Apache-2.0
"""Code and files that data may name: data is a bag, a scenario that lies in one, the announcement of a member.

Code runs where an installed package offers it by an entry point of ours, or where the user has allowed its package:
with ``--allow-code``, or by a scenario of the user's own in ``lathe run`` or in a Python program. Data names files in
its own folder alone.

Here is the list of packages, one for a call of a command; its child processes are given the same.
"""

import contextlib
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

from lathe_rc.errors import InputError, shown

OPTION = "--allow-code"
REPLAYED = "lathe-replay-"  #: begins the name of a temporary folder with the files of a bag that is replayed

_STORAGES = {".mcap", ".db3"}
_METADATA, _HEAD = "metadata.yaml", b"rosbag2_bagfile_information"


@dataclass
class _Call:
    """A call of a command.

    Attributes:
        allowed: packages that may be imported.
        here: those of them that are looked for in the current folder as well, behind all that is installed.
        folder: the current folder, when the first of these was named.
        own: packages that a scenario of the user's own names are allowed.
        own_is_here: they are looked for in the current folder as well.
        named: gives the texts of the user's parameter files and command line, paths among them.
    """

    allowed: set[str] = field(default_factory=set)
    here: set[str] = field(default_factory=set)
    folder: str = ""
    own: bool = False
    own_is_here: bool = False
    named: Callable[[], Collection[str]] = tuple


_calls = [_Call(own=True)]  # the first is a Python program's own


class _CurrentFolder(MetaPathFinder):
    """Finds allowed packages in the current folder.

    The folder itself does not come to Python's path: its other files would take the place of modules that are missing,
    metadata in it would count as that of an installed package, and a ``sitecustomize.py`` would run in child processes.
    """

    importing = False  #: an allowed package is being imported: modules beside it are found as well

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """See `importlib.abc.MetaPathFinder`."""
        now = _calls[-1]
        if path is not None or not now.folder or not (self.importing or fullname in now.here):
            return None
        return PathFinder.find_spec(fullname, [now.folder], target)


_finder = _CurrentFolder()


@contextlib.contextmanager
def call() -> Iterator[None]:
    """Begin a call of a command: nothing is allowed yet, and what gets allowed is so until its end."""
    _calls.append(_Call())
    try:
        yield
    finally:
        _calls.pop()


@contextlib.contextmanager
def importing(module: str) -> Iterator[None]:
    """Let what an allowed package of the current folder imports be found beside it."""
    before, _finder.importing = _finder.importing, module.partition(".")[0] in _calls[-1].here
    try:
        yield
    finally:
        _finder.importing = before


def allow(package: str) -> None:
    """Allow a package, which may lie in the current folder.

    Raises:
        InputError: it is no name of one.
    """
    if not package.isidentifier():
        raise InputError(f"{OPTION} {shown(package)!r}; allowed: the name of a package, without dots, like my_law")
    _allow(package, here=True)


def allow_named(name: object) -> None:
    """Allow the package of a class ``package.module:Class`` in a scenario of the user's own, if this call takes it."""
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
            sys.meta_path.append(_finder)


def allow_own_code() -> None:
    """Allow what a scenario of the user's own names, in the current folder as well unless that is a bag's."""
    _calls[-1].own, _calls[-1].own_is_here = True, bag_around(Path.cwd()) is None


def is_allowed(module: str) -> bool:
    """Whether the user has allowed the package of a module."""
    return module.partition(".")[0] in _calls[-1].allowed


def arguments() -> list[str]:
    """The options that allow a child process the same packages."""
    return [word for package in sorted(_calls[-1].allowed) for word in (OPTION, package)]


def taken_from(words: Sequence[str]) -> list[str]:
    """A command line without these options, whose packages are allowed then.

    Raises:
        InputError: an option has no package.
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
    """The command that runs a module as ``python -m`` does, without the current folder on its path."""
    # Python 3.10 has no -P.
    run = "import sys; sys.path[:] = filter(None, sys.path); from runpy import run_module; "
    return [sys.executable, "-c", f"{run}run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)", module]


def bag_around(folder: Path) -> Path | None:
    """The bag that a folder is, or lies in; None: none. Storage files of ROS 2 make a bag, or its metadata."""
    try:
        here = folder.resolve()
        if any(file.suffix in _STORAGES for file in here.iterdir()):
            return here
        return next((each for each in (here, *here.parents) if _is_bag(each / _METADATA)), None)
    except OSError:
        return None  # reading what is in it tells why it cannot be


def _is_bag(metadata: Path) -> bool:
    if not metadata.is_file():
        return False
    with metadata.open("rb") as stream:
        return _HEAD in stream.read(len(_HEAD) + 64)


def user_names(texts: Callable[[], Collection[str]]) -> None:
    """Tell what gives the texts of the user's parameter files and command line: members may announce the same files."""
    _calls[-1].named = texts


def may_announce(path: str) -> bool:
    """Whether the announcement of a member may name a file: as the user does, lathe_rc's own, or one of a replay."""
    if path in _calls[-1].named():
        return True
    from lathe_rc import resources

    place = resources.find(Path(path)).resolve()
    temporary = Path(tempfile.gettempdir()).resolve()
    replayed = any(each.parent == temporary and each.name.startswith(REPLAYED) for each in place.parents)
    return replayed or resources.is_own(place)
