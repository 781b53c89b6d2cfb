# SPDX-License-Identifier: Apache-2.0
"""What others add to the cell without a change of it: classes by name, ours and theirs.

A class is named by a name of ours, by a name that an installed package offers as an entry point, or, without any
installation, by where it stands: ``package.module:Class``. A module is looked for where Python looks for it, and then
in the current folder.
"""

import hashlib
import importlib
import importlib.metadata
import os
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic_core import core_schema

from lathe_rc.errors import InputError, shown

T = TypeVar("T")


class Registry(Mapping[str, type[T]], Generic[T]):
    """Classes of one sort by name.

    Iteration gives our names and those that installed packages offer; any ``package.module:Class`` is found as well.

    Args:
        what: one of them, in words.
        base: class that all of them derive from.
        own: ours.
        group: of the entry points.

    Attributes:
        group: see above.
        own: see above.
    """

    def __init__(self, what: str, base: type[T], own: Mapping[str, type[T]], group: str) -> None:
        self._what, self._base, self.own, self.group = what, base, own, group
        self._found: dict[str, type[T]] = {}

    def __iter__(self) -> Iterator[str]:
        yield from self.own
        yield from (name for name in _offered(self.group) if name not in self.own)

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __getitem__(self, name: str) -> type[T]:
        """The class of a name.

        Raises:
            KeyError: nobody offers it.
            InputError: it cannot be imported, or is none of these.
        """
        if name in self.own:
            return self.own[name]
        if name not in self._found:
            self._found[name] = self._checked(name, self._import(name))
        return self._found[name]

    def _import(self, name: str) -> Any:
        module, colon, attribute = name.partition(":")
        if colon:
            return _attribute(module, attribute, f"{self._what} {shown(name)!r}")
        point = _offered(self.group)[name]
        return _attribute(point.module, point.attr, f"{self._what} {name!r} of {_distribution(point.dist)}")

    def _checked(self, name: str, found: Any) -> type[T]:
        if not (isinstance(found, type) and issubclass(found, self._base)):
            wanted = f"a class that derives from {self._base.__module__}.{self._base.__name__}"
            raise InputError(f"{self._what} {shown(name)!r} is {shown(repr(found))}; allowed: {wanted}")
        return found

    def allowed(self) -> str:
        """The names, in words."""
        return f"{', '.join(self)}, or PACKAGE.MODULE:CLASS"

    def origin(self, name: str) -> Mapping[str, str] | None:
        """Where a class of others comes from: distribution, version, hash of its source; None: it is ours."""
        if name in self.own:
            return None
        module = self[name].__module__
        return {"class": f"{module}:{self[name].__qualname__}", **_origin(module)}


def _attribute(module: str, attribute: str, what: str) -> Any:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        found = importlib.import_module(module)
    except Exception as error:  # whatever a module of others does when it is imported
        raise InputError(f"{what} cannot be imported: {type(error).__name__}: {shown(error)}") from error
    for part in attribute.split("."):
        if not hasattr(found, part):
            raise InputError(f"{what}: {module} has no {attribute!r}")
        found = getattr(found, part)
    return found


@cache
def _offered(group: str) -> Mapping[str, importlib.metadata.EntryPoint]:
    """What installed packages offer, by name.

    Raises:
        InputError: two packages offer the same name.
    """
    found: dict[str, importlib.metadata.EntryPoint] = {}
    for point in importlib.metadata.entry_points(group=group):
        other = found.setdefault(point.name, point)
        if other.value != point.value:
            both = f"{_distribution(other.dist)} and {_distribution(point.dist)}"
            raise InputError(f"{both} offer {point.name!r} ({group}); allowed: one of them; uninstall the other")
    return found


def _distribution(dist: importlib.metadata.Distribution | None) -> str:
    return f"{dist.name} {dist.version}" if dist else "an unknown distribution"


def search_path() -> str:
    """Where Python looks for modules here, for the ``PYTHONPATH`` of another interpreter."""
    return os.pathsep.join(str(Path(folder).absolute()) for folder in sys.path)


@cache
def source_hash(module: str) -> str:
    """Hash of the source that a module stands in: of all files of its package, or of the file alone.

    Raises:
        InputError: it has no file.
    """
    digest = hashlib.sha256()
    for path in _sources(module):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def _sources(module: str) -> list[Path]:
    top = sys.modules[module.partition(".")[0]]
    if paths := [Path(each) for each in getattr(top, "__path__", ())]:
        return sorted(path for folder in paths for path in folder.rglob("*.py"))
    if module == "__main__" or not top.__file__:
        raise InputError(f"{module} is no module that other processes can import; put the class into a file of its own")
    return [Path(top.__file__)]


def _origin(module: str) -> Mapping[str, str]:
    names = importlib.metadata.packages_distributions().get(module.partition(".")[0], [])
    dist = importlib.metadata.distribution(names[0]) if names else None
    told = {"distribution": dist.name, "version": dist.version} if dist else {}
    return {**told, "source": source_hash(module)}


class Named(Generic[T]):
    """Marks a parameter that names a class of a registry: ``Annotated[str, Named(REGISTRY)]``.

    Args:
        registry: where it is looked up, when the value is read.
        special: names beside those of the registry.
    """

    def __init__(self, registry: Registry[T], special: tuple[str, ...] = ()) -> None:
        self.registry, self.special = registry, special

    @property
    def choices(self) -> tuple[str, ...]:
        """Names that need no import."""
        return (*self.special, *self.registry.own)

    def allowed(self) -> str:
        """What the parameter accepts, in words."""
        return f"one of {', '.join((*self.special, self.registry.allowed()))}"

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> core_schema.CoreSchema:
        """Check the name where a value is read."""
        return core_schema.no_info_after_validator_function(self._check, handler(source))

    def _check(self, name: str) -> str:
        if name not in self.special and name not in self.registry:
            raise ValueError(name)
        return name
