# SPDX-License-Identifier: Apache-2.0
"""Structs at an address, for kernels: NamedTuples whose members are read only when used.

Numba passes a NamedTuple of arrays by value: each call copies seven words per array and counts references. A
`StructView` is a single word, the address of the layout described in `lathe_rc.compiled`. The caller that creates a
layout (`Struct`) must keep the arrays alive, and must not change any word during a call.

If a NamedTuple is `sized`, the shapes of its arrays are part of the type, so that the compiler unrolls the loops over
matrices of two or six rows. Use `sized` only for a few small arrays, since each shape is compiled separately.
"""

import ctypes
import itertools
import operator
import struct
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import intrinsic, models, overload, register_model
from numba.np.arrayobj import populate_array

_populate: Any = populate_array  # Numba has few types
_proxy: Any = cgutils.create_struct_proxy
_WORD = ir.IntType(64)
_ELEMENTS = {np.dtype(np.float64): types.float64, np.dtype(np.int64): types.int64, np.dtype(np.uint8): types.uint8}


T = TypeVar("T", bound=type)
_SIZED: set[type] = set()


def sized(kind: T) -> T:
    """Class decorator that makes the array shapes of a NamedTuple known to the compiler."""
    _SIZED.add(kind)
    return kind


class StructView(types.Type):
    """Numba type of a NamedTuple at an address.

    Attributes:
        members: type and offset [word] of each member, by name.
        shapes: array shapes that are part of the type, by name.
        size: size of the layout [word].
    """

    def __init__(
        self, kind: str, members: dict[str, tuple[types.Type, int]], shapes: dict[str, tuple[int, ...]], size: int
    ) -> None:
        self.members, self.shapes, self.size = members, shapes, size
        listed = ", ".join(f"{name}: {member}{shapes.get(name, '')}" for name, (member, _) in members.items())
        super().__init__(name=f"{kind}({listed})")


def explain_unfit(value: object, name: str = "") -> str:
    """Return the reason why a value cannot be laid out, with the name of the member; empty if it can be laid out.

    Args:
        value: NamedTuple of float64, int64 or uint8 arrays, constants, and NamedTuples of these.
        name: name of the value, for nested members.
    """
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        reasons = (
            explain_unfit(part, f"{name}.{each}".lstrip(".")) for each, part in zip(value._fields, value, strict=True)
        )
        return next(filter(None, reasons), "")
    if isinstance(value, np.ndarray):
        if value.dtype not in _ELEMENTS:
            return f"{name} is an array of {value.dtype}; allowed: float64, int64 or uint8"
        if not value.flags.c_contiguous:
            return f"{name} is an array with gaps or in Fortran's order; allowed: np.ascontiguousarray of it"
        return ""
    if isinstance(value, bool | int | float | np.bool_ | np.integer):
        return ""
    return f"{name or 'the memory'} is a {type(value).__name__}; allowed: arrays, int, float, bool and NamedTuples"


# ---- the layout ----------------------------------------------------------------------------------------------------


class _Layout(NamedTuple):
    """Layout common to all values of a type; ``words`` packs their arrays and constants."""

    kind: StructView
    words: struct.Struct


def _spread(value: tuple[Any, ...], sorts: list[Any], leaves: list[Any]) -> None:
    """Collect, in order, the properties that determine a NamedTuple's layout, and its arrays and constants."""
    kind = type(value)
    sorts.append(kind)
    known = kind in _SIZED
    for part in value:
        if isinstance(part, np.ndarray):
            # The shape is part of the type only where the NamedTuple is sized.
            sorts += (part.dtype, part.shape if known else part.ndim)
            leaves.append(part)
        elif isinstance(part, tuple):
            _spread(part, sorts, leaves)
        else:
            sorts.append(type(part))
            leaves.append(part)


@cache
def _layout(sorts: tuple[Any, ...]) -> _Layout:
    """Return the layout for the result of `_spread`, shared by all values with equal properties."""
    formats: list[str] = []
    kind = _view(iter(sorts), formats)
    return _Layout(kind, struct.Struct("=" + "".join(formats)))


def _view(sorts: Iterator[Any], formats: list[str]) -> StructView:
    """Return the type of the next NamedTuple; append the formats of its words to ``formats``."""
    kind = next(sorts)
    members: dict[str, tuple[types.Type, int]] = {}
    shapes: dict[str, tuple[int, ...]] = {}
    place = 0
    for name in kind._fields:
        sort = next(sorts)
        member: types.Type
        if isinstance(sort, np.dtype):
            shape = next(sorts)
            if kind in _SIZED:
                shapes[name] = shape
            member = types.Array(_ELEMENTS[sort], len(shape) if kind in _SIZED else shape, "C")
            formats.append(f"{1 + member.ndim}q")
        elif issubclass(sort, tuple):
            member = _view(itertools.chain((sort,), sorts), formats)
        elif sort in (bool, np.bool_):
            member = types.boolean
            formats.append("?7x")
        else:
            member = types.float64 if issubclass(sort, float) else types.int64
            formats.append("d" if member == types.float64 else "q")
        members[name] = member, place
        place += _words_of(member)
    return StructView(f"{kind.__module__}.{kind.__qualname__}", members, shapes, place)


def _words_of(member: types.Type) -> int:
    if isinstance(member, StructView):
        return member.size
    return 1 + member.ndim if isinstance(member, types.Array) else 1


class Struct:
    """NamedTuple laid out in words at an address.

    Args:
        value: see `explain_unfit`.

    Attributes:
        kind: type of the NamedTuple.
        words: words of the layout, shape (size,).
    """

    def __init__(self, value: tuple[Any, ...]) -> None:
        sorts, leaves, words = list[Any](), list[Any](), list[Any]()
        _spread(value, sorts, leaves)
        for part in leaves:
            words += _words(part) if isinstance(part, np.ndarray) else (part,)
        self.kind, pack = _layout(tuple(sorts))
        # A struct without members also needs an address.
        self.words = np.frombuffer(bytearray(pack.pack(*words)) or bytearray(8), np.int64)
        self._floats = self.words.view(np.float64)
        self._value = value  # keeps the arrays alive

    def update(self, value: tuple[Any, ...]) -> None:
        """Update the words of the members that have been replaced by other objects of the same types."""
        self._update(self.kind, 0, value, self._value)
        self._value = value

    def _update(self, kind: StructView, begin: int, value: tuple[Any, ...], known: tuple[Any, ...]) -> None:
        for (member, place), part, before in zip(kind.members.values(), value, known, strict=True):
            at = begin + place
            # A stage creates a new tuple each time, mostly of the same arrays, which need not be written again.
            if part is before:
                continue
            if isinstance(member, StructView):
                self._update(member, at, part, before)
            elif isinstance(part, np.ndarray):
                self.words[at : at + 1 + part.ndim] = _words(part)
            elif isinstance(part, float):
                self._floats[at] = part
            else:
                self.words[at] = part


def address(array: npt.NDArray[Any]) -> int:
    """Return the address of a contiguous array, 10 times as fast as NumPy."""
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]  # it is a buffer
    except (TypeError, ValueError):  # the array is read-only or empty
        return array.ctypes.data


def _words(array: npt.NDArray[Any]) -> tuple[int, ...]:
    assert array.flags.c_contiguous, "kernels take it for contiguous"
    return address(array) if array.size else 0, *array.shape


# ---- Numba's side --------------------------------------------------------------------------------------------------


@register_model(StructView)
class _StructModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: StructView) -> None:
        super().__init__(manager, kind, _WORD)  # type: ignore[no-untyped-call]  # Numba has few types


@infer_getattr
class _Members(AttributeTemplate):
    key = StructView

    def generic_resolve(self, kind: StructView, name: str) -> types.Type | None:  # type: ignore[override]  # Numba has none
        return kind.members[name][0] if name in kind.members else None


def _load(builder: Any, address: Any, kind: ir.Type) -> Any:
    """Load the value at an address, marked as constant during a call so that it can be read once for a whole loop."""
    loaded = builder.load(builder.inttoptr(address, kind.as_pointer()))
    loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
    return loaded


def _entry(builder: Any, table: Any, number: Any) -> Any:
    """Load the word with a given number from a table."""
    return _load(builder, builder.add(table, builder.mul(number, _WORD(8))), _WORD)


def _array(context: Any, builder: Any, kind: types.Array, address: Any, shape: list[Any]) -> Any:
    """Return an array at an address, whose memory is owned by another array."""
    array = context.make_array(kind)(context, builder)
    itemsize = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    strides = [_WORD(itemsize)]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    data = builder.inttoptr(address, context.get_data_type(kind.dtype).as_pointer())
    _populate(array, data=data, shape=shape, strides=strides, itemsize=itemsize, meminfo=None)
    return array._getvalue()  # noqa: SLF001 - there is no other way


def _member(context: Any, builder: Any, kind: StructView, address: Any, name: str) -> Any:
    member, place = kind.members[name]
    words = [builder.add(address, _WORD(8 * (place + k))) for k in range(_words_of(member) or 1)]
    if isinstance(member, StructView):
        return words[0]
    if isinstance(member, types.Array):
        where, *shape = (_load(builder, word, _WORD) for word in words)
        # Constants instead of loads, so that the compiler can unroll loops over them.
        if name in kind.shapes:
            shape = [_WORD(length) for length in kind.shapes[name]]
        return _array(context, builder, member, where, shape)
    if member == types.float64:
        return _load(builder, words[0], ir.DoubleType())
    loaded = _load(builder, words[0], _WORD)
    return builder.icmp_signed("!=", loaded, _WORD(0)) if member == types.boolean else loaded


_lower: Any = lower_getattr_generic
_lower(StructView)(_member)


class Ports(types.Type):
    """Type of any number of input arrays of a step: consecutive entries in an address table.

    A kernel uses ``len`` and indexing as with a tuple, but a tuple would have a different type for each length.
    """

    def __init__(self) -> None:
        super().__init__(name="Ports")


@register_model(Ports)
class _PortsModel(models.StructModel):
    def __init__(self, manager: Any, kind: Ports) -> None:
        members = [("table", types.int64), ("count", types.int64), ("samples", types.int64)]
        super().__init__(manager, kind, members)  # type: ignore[no-untyped-call]  # Numba has few types


_PORTS, _ARRAY, _INT = Ports(), types.Array(types.float64, 1, "C"), types.int64


def _at(_context: object, _address: Any, kind: Any) -> Any:
    return kind.instance_type(_INT, kind), lambda _context, _builder, _signature, arguments: arguments[0]


def _array_of(element: types.Type) -> Any:
    """Return the Numba implementation that reads an array of a given element type."""
    kind = types.Array(element, 1, "C")

    def array(_context: object, _table: Any, _number: Any, _samples: Any) -> Any:
        def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            table, number, samples = arguments
            return _array(context, builder, kind, _entry(builder, table, number), [samples])

        return kind(_INT, _INT, _INT), code

    return intrinsic(array)


def _ports(_context: object, _table: Any, _count: Any, _samples: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        made = _proxy(signature.return_type)(context, builder)
        made.table, made.count, made.samples = arguments
        return made._getvalue()  # noqa: SLF001 - there is no other way

    return _PORTS(_INT, _INT, _INT), code


def _count(_context: object, _ports: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _proxy(signature.args[0])(context, builder, value=arguments[0]).count

    return _INT(_PORTS), code


def _port(_context: object, _ports: Any, _number: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        known = _proxy(signature.args[0])(context, builder, value=arguments[0])
        return _array(context, builder, _ARRAY, _entry(builder, known.table, arguments[1]), [known.samples])

    return _ARRAY(_PORTS, _INT), code


def _word(_context: object, _table: Any, _number: Any) -> Any:
    return _INT(_INT, _INT), lambda _context, builder, _signature, arguments: _entry(builder, *arguments)


def _store(_context: object, _address: Any, _value: Any) -> Any:
    def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        builder.store(arguments[1], builder.inttoptr(arguments[0], _WORD.as_pointer()))
        return context.get_dummy_value()

    return types.void(_INT, _INT), code


def _call(_context: object, _address: Any, _a: Any, _b: Any, _c: Any, _d: Any, _e: Any, _f: Any) -> Any:
    def code(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        function = builder.inttoptr(values[0], ir.FunctionType(_WORD, [_WORD] * 6).as_pointer())
        return builder.call(function, values[1:])

    return _INT(*[_INT] * 7), code


at: Any = intrinsic(_at)  #: (address, type): the NamedTuple of a `StructView` type at an address
floats: Any = _array_of(types.float64)  #: (table, number, size): the float64 array whose address is in a table
octets: Any = _array_of(types.uint8)  #: the same for a uint8 array
word: Any = intrinsic(_word)  #: (table, number): the integer in a table
ports: Any = intrinsic(_ports)  #: (table, count, size): the `Ports` whose addresses are in a table
store: Any = intrinsic(_store)  #: (address, value): write an integer
call: Any = intrinsic(_call)  #: (address, six integers): call a `lathe_rc.jit.entry`
_counted: Any = intrinsic(_count)
_numbered: Any = intrinsic(_port)


@overload(len, strict=False)
def _length(ports: object) -> Any:
    def count(ports: Any) -> Any:
        return _counted(ports)

    return count if isinstance(ports, Ports) else None


@overload(operator.getitem, strict=False)
def _one(ports: object, number: object) -> Any:
    def take(ports: Any, number: int) -> Any:
        return _numbered(ports, number if number >= 0 else number + _counted(ports))

    return take if isinstance(ports, Ports) and isinstance(number, types.Integer) else None
