# SPDX-License-Identifier: Apache-2.0
"""NamedTuples that stand at an address, for kernels: their members are read where they are used.

A kernel takes a NamedTuple of arrays by value: each call hands over seven words an array and counts references to it. A
placed one is its address. It is laid out in words of 64 bits: of an array where it is and its shape, of a constant its
value, of a NamedTuple its members. The caller that lays it out keeps the arrays meanwhile, and changes no word during a
call.

Of a NamedTuple that is `sized` the shapes of the arrays are part of the type: the compiler then unrolls the loops over
matrices of two or six rows. That is for few and small arrays, since each shape is compiled by itself.
"""

import ctypes
import itertools
import operator
import struct
from collections.abc import Iterator
from functools import cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import intrinsic, models, overload, register_model
from numba.np.arrayobj import populate_array

Integers = npt.NDArray[np.int64]

_populate: Any = populate_array  # Numba has few types
_proxy: Any = cgutils.create_struct_proxy
_WORD = ir.IntType(64)
_KINDS = {np.dtype(np.float64): types.float64, np.dtype(np.int64): types.int64, np.dtype(np.uint8): types.uint8}


T = TypeVar("T", bound=type)
_SIZED: set[type] = set()


def sized(kind: T) -> T:
    """Let the compiler know the shapes of the arrays of a NamedTuple; decorates its class."""
    _SIZED.add(kind)
    return kind


class Placed(types.Type):
    """The type of a placed NamedTuple.

    Attributes:
        members: type and place [word] of each, by name.
        shapes: those that are known, by name.
        size: of all of them [word].
    """

    def __init__(
        self, kind: str, members: dict[str, tuple[types.Type, int]], shapes: dict[str, tuple[int, ...]], size: int
    ) -> None:
        self.members, self.shapes, self.size = members, shapes, size
        told = ", ".join(f"{name}: {member}{shapes.get(name, '')}" for name, (member, _) in members.items())
        super().__init__(name=f"{kind}({told})")


def placed(value: tuple[Any, ...]) -> Placed:
    """The type of a NamedTuple of arrays of float64, int64 or uint8, constants, and NamedTuples of those."""
    sorts: list[Any] = []
    _spread(value, sorts, [])
    return _layout(tuple(sorts)).kind


def unfit(value: object, name: str = "") -> str:
    """Which member of a NamedTuple cannot be placed, and why; empty if all can.

    Args:
        value: see `placed`.
        name: of it, for the members of others.
    """
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        members = (unfit(part, f"{name}.{each}".lstrip(".")) for each, part in zip(value._fields, value, strict=True))
        return next(filter(None, members), "")
    if isinstance(value, np.ndarray):
        if value.dtype not in _KINDS:
            return f"{name} is an array of {value.dtype}; allowed: float64, int64 or uint8"
        if not value.flags.c_contiguous:
            return f"{name} is an array with gaps or in Fortran's order; allowed: np.ascontiguousarray of it"
        return ""
    if isinstance(value, bool | int | float | np.bool_ | np.integer):
        return ""
    return f"{name or 'the memory'} is a {type(value).__name__}; allowed: arrays, int, float, bool and NamedTuples"


def _spread(value: tuple[Any, ...], sorts: list[Any], leaves: list[Any]) -> None:
    """Collect what the layout of a NamedTuple depends on, and its arrays and constants, in order."""
    kind = type(value)
    sorts.append(kind)
    known = kind in _SIZED
    for part in value:
        if isinstance(part, np.ndarray):
            sorts += (part.dtype, part.shape if known else part.ndim)
            leaves.append(part)
        elif isinstance(part, tuple):
            _spread(part, sorts, leaves)
        else:
            sorts.append(type(part))
            leaves.append(part)


class _Layout:
    """How all NamedTuples of a type are laid out.

    Attributes:
        kind: the type.
        words: writes the words of all arrays and constants.
    """

    def __init__(self, sorts: tuple[Any, ...]) -> None:
        formats: list[str] = []
        self.kind = _placed(iter(sorts), formats)
        self.words = struct.Struct("=" + "".join(formats))


@cache
def _layout(sorts: tuple[Any, ...]) -> _Layout:
    """Of what `_spread` has collected; made once for all that are alike."""
    return _Layout(sorts)


def _placed(sorts: Iterator[Any], formats: list[str]) -> Placed:
    """The type of the NamedTuple that comes next; ``formats`` gets those of its words."""
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
            member = types.Array(_KINDS[sort], len(shape) if kind in _SIZED else shape, "C")
            formats.append(f"{1 + member.ndim}q")
        elif issubclass(sort, tuple):
            member = _placed(itertools.chain((sort,), sorts), formats)
        elif sort in (bool, np.bool_):
            member = types.boolean
            formats.append("?7x")
        else:
            member = types.float64 if issubclass(sort, float) else types.int64
            formats.append("d" if member == types.float64 else "q")
        members[name] = member, place
        place += _words_of(member)
    return Placed(f"{kind.__module__}.{kind.__qualname__}", members, shapes, place)


def _words_of(member: types.Type) -> int:
    if isinstance(member, Placed):
        return member.size
    return 1 + member.ndim if isinstance(member, types.Array) else 1


class Words:
    """A NamedTuple laid out in words.

    Args:
        value: see `placed`.

    Attributes:
        kind: its type.
        words: shape (size,).
    """

    def __init__(self, value: tuple[Any, ...]) -> None:
        sorts, leaves, words = list[Any](), list[Any](), list[Any]()
        _spread(value, sorts, leaves)
        layout = _layout(tuple(sorts))
        for part in leaves:
            words += _of(part) if isinstance(part, np.ndarray) else (part,)
        self.kind = layout.kind
        self.words = np.frombuffer(bytearray(layout.words.pack(*words)) or bytearray(8), np.int64)
        self._floats = self.words.view(np.float64)
        self._value = value  # keeps the arrays

    def update(self, value: tuple[Any, ...]) -> None:
        """Lay out anew what has been replaced in the value, which must be of the same type."""
        for place, part in _replaced(self.kind, 0, value, self._value):
            if isinstance(part, np.ndarray):
                self.words[place : place + 1 + part.ndim] = _of(part)
            elif isinstance(part, float):
                self._floats[place] = part
            else:
                self.words[place] = part
        self._value = value


def address(array: npt.NDArray[Any]) -> int:
    """Where a contiguous array begins; NumPy takes ten times as long to say so."""
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]  # it is a buffer
    except (TypeError, ValueError):  # nobody may write to it, or it is empty
        return array.ctypes.data


def _of(array: npt.NDArray[Any]) -> tuple[int, ...]:
    """The words of an array."""
    assert array.flags.c_contiguous, "kernels take it for contiguous"
    return address(array) if array.size else 0, *array.shape


def _replaced(kind: Placed, begin: int, value: tuple[Any, ...], known: tuple[Any, ...]) -> Iterator[tuple[int, Any]]:
    """Places and values of the members that are not what is known."""
    for (member, place), part, before in zip(kind.members.values(), value, known, strict=True):
        if part is before:
            continue
        if isinstance(member, Placed):
            yield from _replaced(member, begin + place, part, before)
        else:
            yield begin + place, part


# ---- what Numba has to know of it ------------------------------------------------------------------------------------


@register_model(Placed)
class _PlacedModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Placed) -> None:
        super().__init__(manager, kind, _WORD)  # type: ignore[no-untyped-call]  # Numba has few types


@infer_getattr
class _Members(AttributeTemplate):
    key = Placed

    def generic_resolve(self, kind: Placed, name: str) -> types.Type | None:  # type: ignore[override]  # Numba has none
        return kind.members[name][0] if name in kind.members else None


def _load(builder: Any, address: Any, kind: ir.Type) -> Any:
    """The value at an address; it does not change during a call, so that it may be read once for a whole loop."""
    loaded = builder.load(builder.inttoptr(address, kind.as_pointer()))
    loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
    return loaded


def _array(context: Any, builder: Any, kind: types.Array, address: Any, shape: list[Any]) -> Any:
    """An array at an address, whose memory another one keeps."""
    array = context.make_array(kind)(context, builder)
    itemsize = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    strides = [_WORD(itemsize)]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    data = builder.inttoptr(address, context.get_data_type(kind.dtype).as_pointer())
    _populate(array, data=data, shape=shape, strides=strides, itemsize=itemsize, meminfo=None)
    return array._getvalue()  # noqa: SLF001 - there is no other way


def _member(context: Any, builder: Any, kind: Placed, address: Any, name: str) -> Any:
    member, place = kind.members[name]
    words = [builder.add(address, _WORD(8 * (place + k))) for k in range(_words_of(member) or 1)]
    if isinstance(member, Placed):
        return words[0]
    if isinstance(member, types.Array):
        where, *shape = (_load(builder, word, _WORD) for word in words)
        if name in kind.shapes:
            shape = [_WORD(length) for length in kind.shapes[name]]
        return _array(context, builder, member, where, shape)
    if member == types.float64:
        return _load(builder, words[0], ir.DoubleType())
    loaded = _load(builder, words[0], _WORD)
    return builder.icmp_signed("!=", loaded, _WORD(0)) if member == types.boolean else loaded


_lower: Any = lower_getattr_generic
_lower(Placed)(_member)


def _at(_context: object, _address: Any, kind: Any) -> Any:
    def code(_context: Any, _builder: Any, _signature: Any, arguments: Any) -> Any:
        return arguments[0]

    return kind.instance_type(types.int64, kind), code


def _array_of(element: types.Type) -> Any:
    """The reader of an array of some element type, as Numba wants it."""

    def array(_context: object, _addresses: Any, _number: Any, _samples: Any) -> Any:
        kind = types.Array(element, 1, "C")

        def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            addresses, number, samples = arguments
            address = _load(builder, builder.add(addresses, builder.mul(number, _WORD(8))), _WORD)
            return _array(context, builder, kind, address, [samples])

        return kind(types.int64, types.int64, types.int64), code

    return intrinsic(array)


class Ports(types.Type):
    """The type of the arrays of a step's inputs, however many there are: one after the other in a table of addresses.

    A kernel counts them and takes one by its number, as of a tuple; a tuple would be another type for each number.
    """

    def __init__(self) -> None:
        super().__init__(name="Ports")


_PORTS, _ARRAY = Ports(), types.Array(types.float64, 1, "C")


@register_model(Ports)
class _PortsModel(models.StructModel):
    def __init__(self, manager: Any, kind: Ports) -> None:
        members = [("table", types.int64), ("count", types.int64), ("samples", types.int64)]
        super().__init__(manager, kind, members)  # type: ignore[no-untyped-call]  # Numba has few types


def _ports(_context: object, _table: Any, _count: Any, _samples: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        made = _proxy(signature.return_type)(context, builder)
        made.table, made.count, made.samples = arguments
        return made._getvalue()  # noqa: SLF001 - there is no other way

    return _PORTS(types.int64, types.int64, types.int64), code


def _count(_context: object, _ports: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _proxy(signature.args[0])(context, builder, value=arguments[0]).count

    return types.int64(_PORTS), code


def _port(_context: object, _ports: Any, _number: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        known = _proxy(signature.args[0])(context, builder, value=arguments[0])
        word = builder.add(known.table, builder.mul(arguments[1], _WORD(8)))
        return _array(context, builder, _ARRAY, _load(builder, word, _WORD), [known.samples])

    return _ARRAY(_PORTS, types.int64), code


_counted: Any = intrinsic(_count)
_numbered: Any = intrinsic(_port)


@overload(len, strict=False)
def _length(ports: object) -> Any:
    def count(ports: Any) -> int:
        found: int = _counted(ports)
        return found

    return count if isinstance(ports, Ports) else None


@overload(operator.getitem, strict=False)
def _one(ports: object, number: object) -> Any:
    def take(ports: Any, number: int) -> Any:
        return _numbered(ports, number if number >= 0 else number + _counted(ports))

    return take if isinstance(ports, Ports) and isinstance(number, types.Integer) else None


def _word(_context: object, _table: Any, _number: Any) -> Any:
    def code(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return _load(builder, builder.add(arguments[0], builder.mul(arguments[1], _WORD(8))), _WORD)

    return types.int64(types.int64, types.int64), code


def _store(_context: object, _address: Any, _value: Any) -> Any:
    def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        builder.store(arguments[1], builder.inttoptr(arguments[0], _WORD.as_pointer()))
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), code


def _call(_context: object, _address: Any, _a: Any, _b: Any, _c: Any, _d: Any, _e: Any, _f: Any) -> Any:
    def code(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        function = builder.inttoptr(values[0], ir.FunctionType(_WORD, [_WORD] * 6).as_pointer())
        return builder.call(function, values[1:])

    return types.int64(*[types.int64] * 7), code


at: Any = intrinsic(_at)  #: (address, type): the NamedTuple of a `Placed` type that stands there
floats: Any = _array_of(types.float64)  #: (table, number, size): the float64 whose address stands in a table
octets: Any = _array_of(types.uint8)  #: the same of uint8
word: Any = intrinsic(_word)  #: (table, number): the whole number that stands in a table
ports: Any = intrinsic(_ports)  #: (table, count, size): the `Ports` whose addresses stand in a table
store: Any = intrinsic(_store)  #: (address, value): write a whole number
call: Any = intrinsic(_call)  #: (address, six whole numbers): call an `lathe_rc.jit.entry`
