# SPDX-License-Identifier: Apache-2.0
"""Types of the printed C: scalars, arrays, tuples, and the structs that a step's memory consists of."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from lathe_rc.compiled.struct_view import StructView

Type = Any  #: a name of a scalar, or one of the classes below
INT, FLOAT, WORD, OCTET, BOOL, NONE = "int64_t", "double", "uint64_t", "uint8_t", "bool", "void"
COMPLEX = "complex_number"
_ORDER = (BOOL, OCTET, INT, FLOAT, COMPLEX)  # each is converted to any that follows
SHORT = {INT: "int", FLOAT: "real", WORD: "word", OCTET: "octet", BOOL: "bool", COMPLEX: "complex"}
_NUMBA = {numba.float64: FLOAT, numba.int64: INT, numba.uint64: WORD, numba.uint8: OCTET, numba.boolean: BOOL}


@dataclass(frozen=True)
class ArrayType:
    """Array of one to three dimensions, whose rows follow one another.

    Attributes:
        element: name of a scalar.
        dimensions: 1, 2 or 3.
    """

    element: str
    dimensions: int

    @property
    def name(self) -> str:
        """Name in C."""
        return f"{SHORT[self.element]}_{('array', 'matrix', 'cube')[self.dimensions - 1]}"

    @property
    def lengths(self) -> tuple[str, ...]:
        """Names of the lengths along the dimensions."""
        return ("size",) if self.dimensions == 1 else ("planes", "rows", "columns")[3 - self.dimensions :]


@dataclass(frozen=True)
class TupleType:
    """Tuple of any types."""

    parts: tuple[Type, ...]

    @property
    def alike(self) -> bool:
        """Whether all parts have one type, so that an index may vary."""
        return len(set(self.parts)) == 1

    @property
    def name(self) -> str:
        """Name in C."""
        parts = [_named(part) for part in self.parts]
        return f"{parts[0]}_{len(parts)}" if self.alike else "_".join(parts) + "_tuple"

    def part(self, place: int) -> str:
        """Return the name of a part."""
        return f"part[{place}]" if self.alike else f"part_{place}"


@dataclass(frozen=True)
class RecordType(TupleType):
    """NamedTuple that is passed by value.

    Attributes:
        kind: its class.
    """

    kind: Any = None

    @property
    def alike(self) -> bool:
        """No index may vary: the parts have names."""
        return False

    @property
    def name(self) -> str:
        """Name in C."""
        return str(self.kind.__name__)

    def part(self, place: int) -> str:
        """Return the name of a part."""
        return str(self.kind._fields[place])


@dataclass(frozen=True)
class PortsType:
    """Any number of arrays whose addresses follow one another (see `lathe_rc.compiled.struct_view.Ports`)."""

    name: str = "ports"


def _named(kind: Type) -> str:
    return SHORT[kind] if isinstance(kind, str) else kind.name.removesuffix("_array") + "s"


def of_numba(kind: Any) -> Type:
    """Return the type for a member of a `StructView`."""
    if isinstance(kind, numba.types.Array):
        return ArrayType(_NUMBA[kind.dtype], kind.ndim)
    return kind if isinstance(kind, StructView) else _NUMBA[kind]


def of_value(value: object) -> Type | None:
    """Return the type of a constant; None if it cannot be printed."""
    for kind, name in ((bool | np.bool_, BOOL), (np.uint64, WORD), (int | np.integer, INT), (float, FLOAT)):
        if isinstance(value, kind):
            return name
    if value is None:
        return NONE
    if isinstance(value, tuple) and value and all(of_value(part) for part in value):
        return TupleType(tuple(of_value(part) for part in value))
    return None


def joined(kinds: Iterable[Type]) -> Type:
    """Return the type to which all of some types are converted.

    Raises:
        TypeError: there is none.
    """
    found: Sequence[Type] = list(dict.fromkeys(kinds))
    if len(found) == 1:
        return found[0]
    if found and all(kind in _ORDER for kind in found):
        return max(found, key=_ORDER.index)
    if found and all(isinstance(kind, TupleType) and len(kind.parts) == len(found[0].parts) for kind in found):
        return TupleType(tuple(joined(parts) for parts in zip(*(kind.parts for kind in found), strict=True)))
    raise TypeError(f"values of types {', '.join(str(kind) for kind in found) or 'none'} in one place")
