# SPDX-License-Identifier: Apache-2.0
"""Third-party plug-ins: registries of built-in classes and classes from other packages, by name.

A class is identified by a built-in name, by the name of an installed package's entry point, or by its location
``package.module:Class`` if an entry point offers that location or the user has allowed the package (see
`lathe_rc.allowed_code`).
"""

import ast
import hashlib
import importlib
import importlib.metadata
import importlib.util
import os
import pkgutil
import sys
import sysconfig
import traceback
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic_core import core_schema

from lathe_rc import allowed_code
from lathe_rc.catalogue import OURS
from lathe_rc.errors import InputError, LatheError, shown

T = TypeVar("T")
V = TypeVar("V")


class PluginRegistry(Mapping[str, V], Generic[V]):
    """Registry of objects of one kind by name, both built-in and from other packages.

    Iteration yields the built-in names and the entry points of installed packages; ``package.module:Name`` can be
    looked up as well if `permits` allows it.

    Args:
        what: description of one such object.
        own: built-in objects, or their locations ``package.module:Class``; a location is imported on first use.
        group: entry-point group.

    Attributes:
        group: see above.
        own: see above.
    """

    def __init__(self, what: str, own: Mapping[str, V | str], group: str) -> None:
        self._what, self.own, self.group = what, own, group
        self._found: dict[str, V] = {}

    def __iter__(self) -> Iterator[str]:
        yield from self.own
        yield from (name for name in _offered(self.group) if name not in self.own)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __getitem__(self, name: str) -> V:
        """Return the object with a given name.

        Raises:
            KeyError: no package offers the name.
            InputError: importing the object is not allowed or fails, or the object is not of this kind.
        """
        own = self.own.get(name)
        if own is not None and not isinstance(own, str):
            return own
        if not (own or self.permits(name)):
            raise InputError(f"{self._what} {shown(name)!r}: {self.why_not(name)}")
        if name not in self._found:
            self._found[name] = self._checked(name, pkgutil.resolve_name(own) if own else self._import(name))
        return self._found[name]

    def _import(self, name: str) -> Any:
        module, colon, place = name.partition(":")
        if colon:
            return attribute(module, place, f"{self._what} {shown(name)!r}")
        point = _offered(self.group)[name]
        return attribute(point.module, point.attr, f"{self._what} {name!r} of {_distribution(point.dist)}")

    def permits(self, name: str) -> bool:
        """Return whether a name may be looked up; a location must be offered by a package or allowed by the user."""
        module, colon, _ = name.partition(":")
        if not colon or allowed_code.is_allowed(module):
            return True
        return any(f"{point.module}:{point.attr}" == name for point in _offered(self.group).values())

    def why_not(self, name: str) -> str:
        """Return the reason why a name may not be looked up, with a remedy."""
        package = shown(name.partition(":")[0].partition(".")[0])
        return f"code that no installed package offers; allowed: install {package}, or {allowed_code.OPTION} {package}"

    @abstractmethod
    def _checked(self, name: str, found: Any) -> V:
        """Return an imported object after checking its type."""

    def _refused(self, name: str, found: Any, wanted: str) -> InputError:
        return InputError(f"{self._what} {shown(name)!r} is {shown(repr(found))}; allowed: {wanted}")

    def offered_by(self, name: str) -> str:
        """Return the distribution that offers a name, with its version; empty for built-in and unknown names."""
        if name in self.own or name not in _offered(self.group) or is_ours(_offered(self.group)[name].module):
            return ""
        return _distribution(_offered(self.group)[name].dist)


class Objects(PluginRegistry[V]):
    """Registry of instances of one class (see `PluginRegistry`).

    Args:
        what, own, group: see `PluginRegistry`.
        kind: class of the instances.
    """

    def __init__(self, what: str, kind: type[V], own: Mapping[str, V | str], group: str) -> None:
        super().__init__(what, own, group)
        self._kind = kind

    def _checked(self, name: str, found: Any) -> V:
        if not isinstance(found, self._kind):
            raise self._refused(name, found, f"a {self._kind.__module__}.{self._kind.__name__}")
        return found


class Registry(PluginRegistry[type[T]], Generic[T]):
    """Registry of classes with a common base class (see `PluginRegistry`).

    Args:
        what, own, group: see `PluginRegistry`.
        base: base class of all registered classes.
    """

    def __init__(self, what: str, base: Any, own: Mapping[str, type[T] | str], group: str) -> None:
        super().__init__(what, own, group)
        self._base = base

    def _checked(self, name: str, found: Any) -> type[T]:
        if isinstance(found, type) and issubclass(found, self._base):
            return found
        raise self._refused(name, found, f"a class that derives from {self._base.__module__}.{self._base.__name__}")

    def allowed(self) -> str:
        """Return the allowed names as readable text."""
        return in_words(self)

    def origin(self, name: str) -> Mapping[str, str] | None:
        """Return a third-party class's origin: distribution, version and source hash; None for a built-in class."""
        if name in self.own:
            return None
        module = self[name].__module__
        return {"class": f"{module}:{self[name].__qualname__}", **origin(module)}


@contextmanager
def code_of_others(what: str) -> Iterator[None]:
    """Convert any exception from third-party code into a one-line error.

    Args:
        what: purpose of the code, in words.

    Raises:
        InputError: the code raised an exception; the message states the exception, the file and the line.
    """
    try:
        yield
    except LatheError as error:
        raise InputError(f"{what}: {error}") from error
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}, line {last.lineno}"
        raise InputError(f"{what}: {type(error).__name__} in {where}: {shown(error)}") from error


def attribute(module: str, name: str, what: str) -> Any:
    """Import an object of a third-party module.

    Args:
        module: the module.
        name: name of the object in it.
        what: the object in words, for messages.

    Raises:
        InputError: the module cannot be imported, or has no such object.
    """
    try:
        with allowed_code.importing(module):
            found = importlib.import_module(module)
    except Exception as error:  # importing a third-party module can raise anything
        told = f"{what} cannot be imported: {type(error).__name__}: {shown(error)}"
        if isinstance(error, ModuleNotFoundError) and error.name == module.partition(".")[0]:
            told += (
                f"; allowed: install it, or {allowed_code.OPTION} {shown(error.name)} if it lies in the current folder"
            )
        raise InputError(told) from error
    for part in name.split("."):
        if not hasattr(found, part):
            raise InputError(f"{what}: {module} has no {name!r}")
        found = getattr(found, part)
    return found


def _offered(group: str) -> Mapping[str, importlib.metadata.EntryPoint]:
    """Return the entry points that installed packages offer in a group, by name.

    Raises:
        InputError: two packages offer the same name.
    """
    return _offered_along(group, tuple(sys.path))


@cache
def _offered_along(group: str, path: tuple[str, ...]) -> Mapping[str, importlib.metadata.EntryPoint]:  # noqa: ARG001 - the key
    """Return the entry points found along ``sys.path``; cached, since a search takes 0.1 s."""
    found: dict[str, importlib.metadata.EntryPoint] = {}
    for point in importlib.metadata.entry_points(group=group):
        other = found.setdefault(point.name, point)
        if other.value != point.value:
            both = f"{_distribution(other.dist)} and {_distribution(point.dist)}"
            raise InputError(f"{both} offer {point.name!r} ({group}); allowed: one of them; uninstall the other")
    return found


def in_words(names: Iterable[str]) -> str:
    """Return known names and the form of third-party names as readable text."""
    listed = ", ".join(names)
    return f"{listed}, or PACKAGE.MODULE:CLASS" if listed else "PACKAGE.MODULE:CLASS"


def _distribution(dist: importlib.metadata.Distribution | None) -> str:
    return f"{dist.name} {dist.version}" if dist else "an unknown distribution"


def search_path() -> str:
    """Return this interpreter's module search path as a ``PYTHONPATH`` value; existing entries stay first."""
    given = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    return os.pathsep.join(dict.fromkeys([*given, *(str(Path(folder).absolute()) for folder in sys.path)]))


def is_ours(module: str) -> bool:
    """Return whether a module belongs to this distribution.

    The name of the compiled-code folder contains a hash of lathe_rc's own source. The source of third-party modules is
    covered by the cache of their steps instead (`lathe_rc.compiled.step`).
    """
    return module.partition(".")[0] in OURS


@cache
def source_hash(module: str) -> str:
    """Hash the source of a module and of what it imports.

    The hash covers all files of the module's package, or its single file, and likewise the packages that these import,
    except lathe_rc and the dependencies of kernels; of other installed packages it covers the version.

    Raises:
        InputError: the module is ``__main__``, which other processes cannot import.
    """
    if module == "__main__":
        raise InputError("__main__ is no module that other processes can import; put the class into a file of its own")
    digest, seen = hashlib.sha256(), set[str]()
    waiting = [module.partition(".")[0]]
    while waiting:
        top = waiting.pop()
        if top in seen or top in COMMON:
            continue
        seen.add(top)
        with allowed_code.importing(module):  # for a module beside it that it imports later
            paths = _files(top)
        if len(seen) > 1 and paths and paths[0].is_relative_to(_INSTALLED):
            versions = [f"{name} {importlib.metadata.version(name)}" for name in sorted(set(_packages().get(top, [])))]
            digest.update(" ".join(versions).encode())
            continue
        for path in paths:
            text = path.read_bytes()
            digest.update(path.name.encode() + text)
            waiting += sorted(_imports(text))
    return digest.hexdigest()


_INSTALLED = sysconfig.get_path("purelib")
#: packages whose versions do not change within an installation, the first two with a separate hash, or which only draw
COMMON = {
    *OURS,
    *("numpy", "scipy", "numba", "annotated_types", "pydantic", "matplotlib", "rich"),
    *sys.stdlib_module_names,
}


def _files(top: str) -> list[Path]:
    """Return the source files of a package or module, whether it is imported or not."""
    if module := sys.modules.get(top):
        folders, file = getattr(module, "__path__", ()), getattr(module, "__file__", None)
    elif spec := importlib.util.find_spec(top):
        folders, file = spec.submodule_search_locations or (), spec.origin
    else:
        return []
    if paths := [Path(each) for each in folders]:
        return sorted(path for folder in paths for path in folder.rglob("*.py"))
    return [Path(file)] if file and file.endswith(".py") else []


def _imports(text: bytes) -> set[str]:
    """Return the packages that a source file imports."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found.update(alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
    return found


@cache
def _packages() -> Mapping[str, list[str]]:
    """Return the distributions by package; cached, since a full scan takes 0.5 s."""
    return importlib.metadata.packages_distributions()


def origin(module: str) -> Mapping[str, str]:
    """Return the origin of an imported module: its distribution and version, if any, and the hash of its source."""
    names = _packages().get(module.partition(".")[0], [])
    dist = importlib.metadata.distribution(names[0]) if names else None
    told = {"distribution": dist.name, "version": dist.version} if dist else {}
    return {**told, "source": source_hash(module)}


class Named(Generic[T]):
    """Annotation for a parameter whose value names a registry entry: ``Annotated[str, Named(REGISTRY)]``.

    Args:
        registry: registry in which the value is looked up when it is read.
        special: further allowed names.
    """

    def __init__(self, registry: Registry[T], special: tuple[str, ...] = ()) -> None:
        self.registry, self.special = registry, special

    @property
    def choices(self) -> tuple[str, ...]:
        """Names that can be listed without importing anything."""
        return (*self.special, *self.registry.own)

    def allowed(self) -> str:
        """Return the allowed values of the parameter as readable text."""
        names = [*(name or "''" for name in self.special), *self.registry]
        return f"one of {in_words(names)}" if names else in_words(names)

    def others(self, value: object) -> list[str]:
        """Return the third-party class names in a parameter's value, which is a name or a list of names."""
        names = value if isinstance(value, list) else [value]
        return [str(name) for name in names if name not in self.choices]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> core_schema.CoreSchema:
        """Return the Pydantic schema that checks the name when a value is read."""
        return core_schema.no_info_after_validator_function(self._check, handler(source))

    def _check(self, name: str) -> str:
        try:
            known = name in self.special or name in self.registry
        except InputError as error:
            raise ValueError(str(error)) from None
        if not known:
            raise ValueError
        return name
