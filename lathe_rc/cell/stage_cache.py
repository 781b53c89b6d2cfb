# SPDX-License-Identifier: Apache-2.0
"""Reuse of stages in a batch, by resetting everything that a run may change in a stage.

A cell of a batch differs from the previous one in a few tables. Creating the other stages would take longer than
copying the state that a run has changed, and their memory stays in the caches: without this module, a cell of the batch
benchmark takes 10 % longer (full cell, in which three of twelve nodes differ) or 3 % longer (two-channel cell, four of
seven).
"""

import contextlib
import enum
import operator
import types
from collections.abc import Callable, Iterable
from functools import cached_property, partial
from itertools import compress
from pathlib import PurePath
from typing import Any

import numpy as np
from numba.core.types import Type

from lathe_rc.cell.parameters import NodeParameters, Table
from lathe_rc.cell.stage import Stage
from lathe_rc.compiled.step import Entry
from lathe_rc.extensions import is_ours

#: types of objects that are never changed; compiler types and entries are shared with stages in other threads
_CONSTANT = (
    type(None), bool, int, float, complex, str, bytes, range, slice, type, enum.Enum, PurePath, np.generic, np.dtype,
    types.BuiltinFunctionType, types.ModuleType, Table, Entry, Type,
)  # fmt: skip


class _Plain:
    """Reference class with nothing but attributes; an object with a different layout may have hidden state."""


class UnknownPartError(Exception):
    """Error for an object that this module cannot reset."""


class Start:
    """Initial state of a stage, recorded before its run.

    Args:
        stage: stage that has not run yet.

    Raises:
        UnknownPartError: the stage contains an object that cannot be reset, such as an open file.
    """

    def __init__(self, stage: Stage) -> None:
        self._seen: dict[int, Any] = {id(stage.room): stage.room}  # by address; the step's scratch memory is skipped
        self._back: list[Callable[[], object]] = []
        self._look(stage)

    def rewind(self) -> None:
        """Reset the stage to its initial state."""
        for back in self._back:
            back()

    def _look(self, part: Any) -> None:
        """Record a part of the stage and everything that the part references."""
        if isinstance(part, _CONSTANT) or id(part) in self._seen:
            return
        if isinstance(part, types.FunctionType) and part.__closure__ is None:
            return
        self._seen[id(part)] = part
        parts: Iterable[Any] = ()
        if type(part) is np.ndarray and not part.dtype.hasobject:
            # A read-only array cannot have changed.
            if part.flags.writeable:
                self._back.append(partial(np.copyto, part, part.copy()))
        elif isinstance(part, tuple | frozenset) and not hasattr(part, "__dict__"):
            parts = part
        elif type(part) in (list, dict, set):
            parts = part.values() if type(part) is dict else part
            self._back.append(partial(_refill, part, part.copy()))
        elif isinstance(part, np.random.Generator):
            # The generator object must be kept, since it may be referenced elsewhere.
            bits = part.bit_generator
            self._back.append(partial(setattr, bits, "state", bits.state))
        elif isinstance(part, types.MethodType):
            parts = (part.__self__,)
        elif type(part) is partial:
            parts = (part.func, *part.args, *part.keywords.values())
        elif type(part).__basicsize__ == _Plain.__basicsize__ and hasattr(part, "__dict__"):
            attributes = {name: value for name, value in vars(part).items() if not _is_cache(part, name)}
            parts = attributes.values()
            self._back.append(partial(_reset, part, attributes))
        else:
            raise UnknownPartError(f"a {type(part).__name__}")
        for each in [*parts]:
            self._look(each)


def _is_cache(part: object, name: str) -> bool:
    """Return whether an attribute is computed once from constant attributes."""
    return isinstance(getattr(type(part), name, None), cached_property)


def _reset(part: Any, attributes: dict[str, Any]) -> None:
    """Restore the attributes of an object."""
    there = vars(part)
    for name, value in attributes.items():
        if name not in there or there[name] is not value:
            there[name] = value
    if len(there) > len(attributes):
        for name in [*there.keys() - attributes.keys()]:
            if not _is_cache(part, name):
                del there[name]


def _refill(part: Any, content: Any) -> None:
    """Restore the content of a list, dictionary or set.

    An unchanged dictionary or set is skipped, since another thread may be reading it.
    """
    if isinstance(part, list):
        part[:] = content
    elif [*part] != [*content] or (
        isinstance(part, dict) and not all(map(operator.is_, part.values(), content.values()))
    ):
        part.clear()
        part.update(content)


class StageCache:
    """Cache of the newest stage of each name with its initial state, for cells that run one after another."""

    def __init__(self) -> None:
        self._stages: dict[str, Stage] = {}
        self._starts: dict[str, Start | None] = {}  # of stages requested again; None if not resettable
        self._new: object = None

    def take(self, name: str, table: NodeParameters, new: Callable[[str, NodeParameters], Stage]) -> Stage:
        """Return the stage of a node: the cached one if its table is equal, otherwise a ``new`` one.

        The first stage with a table is not cached, since the next cell may have a different table.
        """
        if new != self._new:  # stages from another checkpoint have another state
            self._new = new
            self._stages.clear()
            self._starts.clear()
        before = self._stages.get(name)
        again = before is not None and _same(before, table)
        if before is not None and again and (start := self._starts.get(name)):
            start.rewind()
            return before
        made = self._stages[name] = new(name, table)
        if before is not None:
            made.take_room(before)
        if not again:
            self._starts.pop(name, None)
        elif name not in self._starts:
            self._starts[name] = None
            with contextlib.suppress(UnknownPartError):
                if made.is_compiled:
                    # This precedes the recording of the initial state, so that the step's words are reset as well.
                    made.native()
                self._starts[name] = Start(made)
        return made


def _same(stage: Stage, table: NodeParameters) -> bool:
    """Return whether a stage has an equal table; for third-party stages, the run ID is compared as well."""
    before = stage.shared
    if before is table:
        return True
    if type(before) is not type(table):
        return False
    old, new = vars(before), vars(table)
    differing = [*compress(new, map(operator.is_not, map(old.get, new), new.values()))]
    return not differing or (differing == ["run_id"] and is_ours(type(stage).__module__))
