# SPDX-License-Identifier: Apache-2.0
"""State of a stage as plain data: what a run has changed since the stage was created.

A stage is a graph of objects that its parameters determine, in which a run changes little: arrays, numbers, random
generators, waiting events. `changes` compares the graph with that of a new stage and returns the differences;
`Restoring` makes them in another new stage, whose parameters may differ: what the run has not changed follows the
new parameters.

The differences consist of lists, dictionaries, text, numbers and arrays. They name classes, but only those that the
stage contains, or frozen dataclasses of lathe_rc; restoring calls no constructor and no other code of these.
"""

import copy
import dataclasses
import enum
import sys
import types
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from lathe_rc.cell.parameters import Table
from lathe_rc.errors import LatheError
from lathe_rc.extensions import is_ours

Change = list[Any]  #: kind of a difference and its content; see the functions that return it
_PLAIN = (type(None), bool, int, float, str)
_COLLECTIONS: dict[str, Callable[[Iterable[Any]], Any]] = {
    "list": list, "tuple": tuple, "set": set, "frozenset": frozenset, "deque": deque,
}  # fmt: skip
_CODE = (type, types.FunctionType, types.BuiltinFunctionType, types.ModuleType, np.ufunc)
_HOST = frozenset({"unheard"})  # attributes that a host sets


class UnkeptError(LatheError):
    """Part of a stage that cannot be expressed as data."""


class ClashError(LatheError):
    """Part of a stage that both the run and the new parameters have changed."""


def changes(now: Any, start: Any) -> Change | None:
    """Return the differences between a stage and a new stage with the same parameters; None if there are none.

    Raises:
        UnkeptError: the stage contains something that is neither an array, a number, text, a collection nor an object
            of these, and that has changed.
    """
    return _Comparison().change(now, start, "")


def _is_stateless(part: Any) -> bool:
    """Return whether stages with equal parameters share an object of this class."""
    return getattr(type(part), "stateless", False) is True


def _is_frozen(part: Any) -> bool:
    """Return whether an object never changes, although parts of it may."""
    params = getattr(type(part), "__dataclass_params__", None)
    is_read_only = isinstance(part, np.ndarray) and not part.flags.writeable
    return bool(params and params.frozen) or is_read_only or _is_stateless(part)


def _attributes(part: Any) -> dict[str, Any]:
    """Return the attributes of an object that are state."""
    own = any("__getstate__" in vars(kind) for kind in type(part).__mro__[:-1])
    found = part.__getstate__() if own else vars(part)
    kind = type(part)
    return {
        name: value
        for name, value in found.items()
        if name not in _HOST and not isinstance(getattr(kind, name, None), cached_property)
    }


def _is_same(now: Any, start: Any) -> bool:
    """Return whether two numbers, texts or arrays are equal to the bit."""
    if isinstance(now, np.ndarray | np.generic):
        return bool(now.dtype == start.dtype and now.shape == start.shape and now.tobytes() == start.tobytes())
    if isinstance(now, float):
        return bool(now.hex() == start.hex())
    return bool(now == start)


def _name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


class _Comparison:
    """Comparison of a stage with a new one, place by place."""

    def __init__(self) -> None:
        self._starts: dict[int, tuple[Any, Any]] = {}  # by address of an object: the object, and its start
        self._taken: dict[int, Any] = {}  # by address of a start: the start

    def change(self, now: Any, start: Any, path: str) -> Change | None:
        """Return the differences of the part at ``path``; None if there are none."""
        if now is start:
            return None
        if type(now) is not type(start):
            return self._whole(now, path)
        way = next(way for kinds, way in self._WAYS if isinstance(now, kinds))
        return way(self, now, start, path)

    def _code(self, now: Any, start: Any, path: str) -> Change | None:
        if getattr(now, "__qualname__", now) != getattr(start, "__qualname__", start):
            raise UnkeptError(f"{path}: another {type(now).__name__} than at the start")
        return None

    def _constant(self, now: Any, start: Any, path: str) -> Change | None:
        if isinstance(now, np.ndarray) and (now.shape, now.dtype) != (start.shape, start.dtype):
            return ["resized", self._whole(now, path)[1]]
        return None if _is_same(now, start) else self._whole(now, path)

    def _table(self, now: Any, start: Any, path: str) -> Change | None:
        before = vars(start)
        told = {name: value for name, value in vars(now).items() if value != before[name]}
        return ["table", told] if told else None

    def _method(self, now: Any, start: Any, path: str) -> Change | None:
        return self.change(now.__self__, start.__self__, f"{path}.__self__")

    def _items(self, now: Any, start: Any, path: str) -> Change | None:
        if len(now) != len(start):
            return self._whole(now, path)
        names = getattr(now, "_fields", range(len(now)))
        parts = [(k, self.change(a, b, f"{path}.{names[k]}")) for k, (a, b) in enumerate(zip(now, start, strict=True))]
        told = [[k, change] for k, change in parts if change]
        return ["items", told] if told else None

    def _own(self, now: Any, start: Any, path: str) -> Change | None:
        """Return the differences of an object; one that can change must occur at the same places as at the start."""
        if not _is_frozen(now):
            if id(now) in self._starts:
                if self._starts[id(now)][1] is not start:
                    raise UnkeptError(f"{path}: shared with another part since the start")
                return None
            if id(start) in self._taken:
                raise UnkeptError(f"{path}: no longer shared with another part since the start")
            self._starts[id(now)], self._taken[id(start)] = (now, start), start
        way = next(way for kinds, way in self._OWN_WAYS if isinstance(now, kinds))
        return way(self, now, start, path)

    def _random(self, now: Any, start: Any, path: str) -> Change | None:
        state = now.bit_generator.state
        return None if state == start.bit_generator.state else ["random", self._whole(state, path)]

    def _entries(self, now: Any, start: Any, path: str) -> Change | None:
        gone = [self._whole(key, path) for key in start if key not in now]
        parts = [
            (key, self.change(part, start[key], f"{path}[{key!r}]") if key in start else self._whole(part, path))
            for key, part in now.items()
        ]
        told = [[self._whole(key, path), change] for key, change in parts if change]
        return ["entries", gone, told] if gone or told else None

    def _attributes(self, now: Any, start: Any, path: str) -> Change | None:
        if not hasattr(now, "__dict__"):
            raise UnkeptError(f"{path}: a {type(now).__name__}")
        before = _attributes(start)
        found = {
            name: self.change(part, before[name], f"{path}.{name}") if name in before else self._whole(part, path)
            for name, part in _attributes(now).items()
        }
        told = {name: change for name, change in found.items() if change}
        return ["attributes", told] if told else None

    def _list(self, now: list[Any], start: list[Any], path: str) -> Change | None:
        """Return the differences of a list: removed and appended elements, such as events, or changed ones."""
        if all(isinstance(part, tuple | str) or _is_frozen(part) for part in now + start):
            gone, new = [part for part in start if part not in now], [part for part in now if part not in start]
            if [part for part in start if part not in gone] + new == now:
                told = [[self._whole(part, path) for part in parts] for parts in (gone, new)]
                return ["list", *told] if gone or new else None
        return self._items(now, start, path)

    def _whole(self, now: Any, path: str) -> Change:
        """Return a part as data, independent of its start."""
        kind = type(now)
        found: Change | None = None
        if isinstance(now, _PLAIN):
            found = ["value", now]
        elif isinstance(now, enum.Enum):
            found = ["enum", _name(kind), now.value]
        elif isinstance(now, np.ndarray | np.generic) and not now.dtype.hasobject:
            found = ["array" if isinstance(now, np.ndarray) else "number", np.array(now)]
        elif isinstance(now, tuple) and hasattr(now, "_fields"):
            found = ["named", _name(kind), [self._whole(part, path) for part in now]]
        elif kind in _COLLECTIONS.values():
            parts = sorted(now, key=repr) if kind in (set, frozenset) else now
            found = [kind.__name__, [self._whole(part, path) for part in parts]]
        elif kind is dict:
            found = ["dict", [[self._whole(key, path), self._whole(part, path)] for key, part in now.items()]]
        elif kind is np.random.Generator:
            found = ["generator", self._whole(now.bit_generator.state, path)]
        elif hasattr(now, "__dict__") and not isinstance(now, (*_CODE, types.MethodType, Table)):
            found = ["object", _name(kind), {name: self._whole(p, path) for name, p in _attributes(now).items()}]
        if found is None:
            raise UnkeptError(f"{path}: a {kind.__name__}")
        return found

    _WAYS: ClassVar[tuple[tuple[Any, Callable[..., Change | None]], ...]] = (
        (_CODE, _code),
        ((*_PLAIN, np.generic, enum.Enum), _constant),
        (Table, _table),
        (types.MethodType, _method),
        (tuple, _items),
        (object, _own),
    )
    _OWN_WAYS: ClassVar[tuple[tuple[Any, Callable[..., Change | None]], ...]] = (
        ((np.ndarray, set, frozenset, deque), _constant),
        (np.random.Generator, _random),
        (list, _list),
        (dict, _entries),
        (object, _attributes),
    )


class Restoring:
    """Restoration of a stage's state in a new stage.

    Args:
        start: new stage with the parameters of the stage whose state was kept; None: they are those of the new stage.
    """

    def __init__(self, start: Any = None) -> None:
        self._start = start

    def restore(self, change: Change | None, fresh: Any) -> None:
        """Make the changes in a new stage.

        Args:
            change: result of `changes`.
            fresh: the new stage.

        Raises:
            ClashError: parameters have changed something that the run has changed as well, such as the size of a memory
                or the start of a random stream.
            ValueError, TypeError, LookupError, AttributeError: the changes are those of another stage.
        """
        if change:
            start = fresh if self._start is None else self._start
            if self._made(change, fresh, start, "") is not fresh:
                raise TypeError("not the state of a stage")

    def _made(self, change: Change, fresh: Any, start: Any, path: str) -> Any:
        """Return the part at ``path`` with its changes: the same object, unless it is immutable."""
        kind, *content = change
        if way := self._WAYS.get((kind, len(content))):
            return way(self, *content, fresh, start, path)
        if kind == "array" and isinstance(fresh, np.ndarray):
            return self._with_elements(content[0], fresh, start, path)
        if isinstance(fresh, (*_PLAIN, np.generic, np.ndarray)) and not (
            type(fresh) is type(start) and _is_same(fresh, start)
        ):
            raise ClashError(path)
        return _new(change)

    def _with_items(self, told: Any, fresh: Any, start: Any, path: str) -> Any:
        if len(fresh) != len(start):
            raise ClashError(path)
        parts = {k: self._made(part, fresh[k], start[k], f"{path}[{k}]") for k, part in told}
        found = [parts.get(k, part) for k, part in enumerate(fresh)]
        if isinstance(fresh, list):
            fresh[:] = found
        elif any(part is not fresh[k] for k, part in parts.items()):
            return type(fresh)._make(found) if hasattr(fresh, "_fields") else tuple(found)
        return fresh

    def _with_entries(self, gone: Any, told: Any, fresh: Any, start: Any, path: str) -> Any:
        for key in map(_new, gone):
            fresh.pop(key, None)
        for name, part in told:
            key = _new(name)
            both = key in fresh and key in start
            fresh[key] = self._made(part, fresh[key], start[key], f"{path}[{key!r}]") if both else _new(part)
        return fresh

    def _with_parts(self, gone: Any, new: Any, fresh: Any, start: Any, path: str) -> Any:
        left_out = [_new(part) for part in gone]
        fresh[:] = [part for part in fresh if part not in left_out] + [_new(part) for part in new]
        return fresh

    def _with_random(self, state: Any, fresh: Any, start: Any, path: str) -> Any:
        if fresh.bit_generator.state != start.bit_generator.state:
            raise ClashError(path)
        fresh.bit_generator.state = _new(state)
        return fresh

    def _with_attributes(self, told: Mapping[str, Change], fresh: Any, start: Any, path: str) -> Any:
        fresh = copy.deepcopy(fresh) if _is_stateless(fresh) else fresh
        target = copy.copy(fresh) if _is_frozen(fresh) else fresh
        there, before = vars(fresh), vars(start)
        for name, change in told.items():
            if isinstance(getattr(type(fresh), name, None), property | types.FunctionType):
                raise TypeError(f"no attribute {name!r}")
            both = name in there and name in before
            made = self._made(change, there[name], before[name], f"{path}.{name}") if both else _new(change)
            if not both or made is not there[name]:
                vars(target)[name] = made
        return target

    def _with_values(self, told: Mapping[str, Any], fresh: Any, start: Any, path: str) -> Any:
        for name in told:
            if getattr(fresh, name) != getattr(start, name):
                raise ClashError(f"{path}.{name}")
        return fresh.model_copy(update=dict(told))

    def _with_elements(self, found: np.ndarray, fresh: np.ndarray, start: np.ndarray, path: str) -> Any:
        """Return an array whose elements are those of the run, unless only the parameters have changed them."""
        if found.shape != fresh.shape or found.dtype != fresh.dtype:
            raise ClashError(path)
        if fresh is not start:
            words = f"V{fresh.dtype.itemsize}"
            run, own = found.view(words) != start.view(words), fresh.view(words) != start.view(words)
            if (run & own).any():
                raise ClashError(path)
            found = np.where(run, found, fresh)
        if not fresh.flags.writeable:
            return found.copy()
        np.copyto(fresh, found)
        return fresh

    _WAYS: ClassVar[Mapping[tuple[str, int], Callable[..., Any]]] = {
        ("attributes", 1): _with_attributes,
        ("items", 1): _with_items,
        ("entries", 2): _with_entries,
        ("list", 2): _with_parts,
        ("table", 1): _with_values,
        ("random", 1): _with_random,
    }


def _new(change: Change) -> Any:
    """Return a new part from data."""
    kind, *content = change
    return _NEW[kind](*content)


def _plain(value: Any) -> Any:
    if not isinstance(value, _PLAIN):
        raise TypeError("not a number or a text")
    return value


def _object(name: str, attributes: Mapping[str, Change]) -> Any:
    made = object.__new__(_class(name, object))
    vars(made).update({name: _new(part) for name, part in attributes.items()})
    return made


def _generator(state: Change) -> np.random.Generator:
    made = np.random.default_rng(0)
    made.bit_generator.state = _new(state)
    return made


_NEW: dict[str, Callable[..., Any]] = {
    "value": _plain,
    "array": np.ndarray.copy,
    "resized": np.ndarray.copy,
    "number": lambda content: content[()],
    "dict": lambda content: {_new(key): _new(part) for key, part in content},
    "enum": lambda name, value: _class(name, enum.Enum)(value),
    "named": lambda name, parts: _class(name, tuple)._make(map(_new, parts)),
    "object": _object,
    "generator": _generator,
    **{name: lambda parts, kind=kind: kind(map(_new, parts)) for name, kind in _COLLECTIONS.items()},
}


def _class(name: str, base: type) -> Any:
    """Return a class of data by its name.

    Raises:
        TypeError: it is no frozen dataclass, NamedTuple or enumeration of a loaded module of lathe_rc.
    """
    module, _, path = name.partition(":")
    found: Any = sys.modules.get(module) if is_ours(module) else None
    for part in path.split("."):
        found = getattr(found, part, None)
    is_data = dataclasses.is_dataclass(found) or (isinstance(found, type) and issubclass(found, tuple | enum.Enum))
    if not isinstance(found, type) or not is_data or not issubclass(found, base):
        raise TypeError(f"no class of data {name!r:.80}")
    return found
