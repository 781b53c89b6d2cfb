# SPDX-License-Identifier: Apache-2.0
"""NamedTuples that stand at an address, for kernels: their members are read where they are used.

A kernel takes a NamedTuple of arrays by value: each call hands over seven words an array and counts references to it.
A placed one is its address. It is laid out in words of 64 bits: of an array where it is and its shape, of a constant
its value, of a NamedTuple its members. Who lays it out keeps the arrays meanwhile, and changes no word during a call.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import intrinsic, models, register_model
from numba.np.arrayobj import populate_array

Integers = npt.NDArray[np.int64]

_WORD = ir.IntType(64)
_KINDS = {np.dtype(np.float64): types.float64, np.dtype(np.int64): types.int64, np.dtype(np.uint8): types.uint8}


class Placed(types.Type):
    """The type of a placed NamedTuple.

    Attributes:
        members: type and place [word] of each, by name.
        size: of all of them [word].
    """

    def __init__(self, kind: str, members: dict[str, tuple[types.Type, int]], size: int) -> None:
        self.members, self.size = members, size
        told = ", ".join(f"{name}: {member}" for name, (member, _) in members.items())
        super().__init__(name=f"{kind}({told})")


def placed(value: tuple[Any, ...]) -> Placed:
    """The type of a NamedTuple of arrays of float64, int64 or uint8, constants, and NamedTuples of those."""
    members, place = {}, 0
    for name, part in zip(getattr(value, "_fields"), value, strict=True):  # noqa: B009 - tuple does not tell mypy of it
        member: types.Type
        if isinstance(part, tuple):
            member = placed(part)
        elif isinstance(part, np.ndarray):
            member = types.Array(_KINDS[part.dtype], part.ndim, "C")
        elif isinstance(part, bool | np.bool_):
            member = types.boolean
        else:
            member = types.float64 if isinstance(part, float) else types.int64
        members[name] = member, place
        place += _words_of(member)
    return Placed(f"{type(value).__module__}.{type(value).__qualname__}", members, place)


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
        self.kind = placed(value)
        self.words = np.zeros(max(self.kind.size, 1), np.int64)
        self._floats = self.words.view(np.float64)
        self._value: tuple[Any, ...] = ()  # keeps the arrays
        self.update(value)

    def update(self, value: tuple[Any, ...]) -> None:
        """Lay out anew what has been replaced in the value, which must be of the same type."""
        for place, part in _replaced(self.kind, 0, value, self._value):
            if isinstance(part, np.ndarray):
                assert part.flags.c_contiguous, "kernels take it for contiguous"
                self.words[place] = part.ctypes.data
                self.words[place + 1 : place + 1 + part.ndim] = part.shape
            elif isinstance(part, float):
                self._floats[place] = part
            else:
                self.words[place] = part
        self._value = value


def _replaced(kind: Placed, begin: int, value: tuple[Any, ...], known: tuple[Any, ...]) -> Iterator[tuple[int, Any]]:
    """Places and values of the members that are not what is known; if nothing is known, of all."""
    for number, (member, place) in enumerate(kind.members.values()):
        part, before = value[number], known[number] if known else None
        if known and part is before:
            continue
        if isinstance(member, Placed):
            yield from _replaced(member, begin + place, part, before or ())
        else:
            yield begin + place, part


# ---- what Numba has to know of it ------------------------------------------------------------------------------------


@register_model(Placed)
class _PlacedModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Placed) -> None:
        super().__init__(manager, kind, _WORD)


@infer_getattr
class _Members(AttributeTemplate):
    key = Placed

    def generic_resolve(self, kind: Placed, name: str) -> types.Type | None:
        return kind.members[name][0] if name in kind.members else None


def _load(builder: Any, address: Any, kind: ir.Type) -> Any:
    """What stands at an address; it does not change during a call, so that it may be read once for a whole loop."""
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
    populate_array(array, data=data, shape=shape, strides=strides, itemsize=itemsize, meminfo=None)
    return array._getvalue()  # noqa: SLF001 - there is no other way


@lower_getattr_generic(Placed)
def _member(context: Any, builder: Any, kind: Placed, address: Any, name: str) -> Any:
    member, place = kind.members[name]
    at = [builder.add(address, _WORD(8 * (place + k))) for k in range(_words_of(member) or 1)]
    if isinstance(member, Placed):
        return at[0]
    if isinstance(member, types.Array):
        return _array(context, builder, member, *_split([_load(builder, word, _WORD) for word in at]))
    if member == types.float64:
        return _load(builder, at[0], ir.DoubleType())
    loaded = _load(builder, at[0], _WORD)
    return builder.icmp_signed("!=", loaded, _WORD(0)) if member == types.boolean else loaded


def _split(words: list[Any]) -> tuple[Any, list[Any]]:
    return words[0], words[1:]


@intrinsic
def at(_context: object, _address: Any, kind: Any) -> Any:
    """The NamedTuple of a type that is placed at an address."""

    def code(_context: Any, _builder: Any, _signature: Any, arguments: Any) -> Any:
        return arguments[0]

    return kind.instance_type(types.int64, kind), code


def _field_of(element: types.Type) -> Any:
    """What reads an array of some element type, as Numba wants it."""

    def field(_context: object, _addresses: Any, _number: Any, _samples: Any) -> Any:
        kind = types.Array(element, 1, "C")

        def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            addresses, number, samples = arguments
            address = _load(builder, builder.add(addresses, builder.mul(number, _WORD(8))), _WORD)
            return _array(context, builder, kind, address, [samples])

        return kind(types.int64, types.int64, types.int64), code

    return intrinsic(field)


floats: Any = _field_of(types.float64)  #: the array of so many float64 whose address stands at a number of a table
octets: Any = _field_of(types.uint8)  #: the same of uint8
integers: Any = _field_of(types.int64)  #: the same of int64


@intrinsic
def store(_context: object, _address: Any, _value: Any) -> Any:
    """Write a whole number to an address."""

    def code(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        builder.store(arguments[1], builder.inttoptr(arguments[0], _WORD.as_pointer()))
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), code


@intrinsic
def call(_context: object, _address: Any, _a: Any, _b: Any, _c: Any, _d: Any, _e: Any, _f: Any) -> Any:
    """Call an `entry` by its address."""

    def code(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        function = builder.inttoptr(values[0], ir.FunctionType(_WORD, [_WORD] * 6).as_pointer())
        return builder.call(function, values[1:])

    return types.int64(*[types.int64] * 7), code


#: a function of six addresses and whole numbers that returns one
entry: Callable[[Any], Any] = numba.cfunc(
    types.int64(*[types.int64] * 6), cache=True, error_model="numpy", nopython=True
)
