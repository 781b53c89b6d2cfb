# SPDX-License-Identifier: Apache-2.0
"""Memory of a step as C: tables, which are read-only arrays in Python, and the state, which holds all other arrays."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from lathe_export.c_library.c_expressions import number, safe
from lathe_export.c_library.c_types import FLOAT, INT, OCTET
from lathe_rc.compiled.struct_view import StructView, address
from lathe_rc.errors import LatheError

Path = tuple[str, ...]  #: names of members, from the memory inwards
Place = tuple[Path, int | None]  #: a number of a memory: the member, and for an array the flat index


_ELEMENTS = {np.dtype(np.float64): FLOAT, np.dtype(np.int64): INT, np.dtype(np.uint8): OCTET}


class StepMemory:
    """Memory of a step.

    Args:
        kind: type of the memory.
        memory: the memory (see `lathe_rc.cell.stage.Stage.memory`).
        tuned: for each parameter, the numbers that it is stored as; the state holds these too.
        real: size of a real number in C [B].
        rows: other lengths of the rows of some arrays, by their addresses.

    Attributes:
        size: size of the state [B].

    Raises:
        LatheError: arrays share a part of their memory; the whole of it is fine.
    """

    def __init__(
        self,
        kind: StructView,
        memory: tuple[Any, ...],
        tuned: Mapping[str, Sequence[Place]],
        real: int,
        rows: Mapping[int, int],
    ) -> None:
        self._kind, self._memory, self._tuned = kind, memory, tuned
        self._known, self._bytes = dict(leaves(memory)), {"f": real, "i": 8, "u": 1}
        arrays = {_named(path): part for path, part in self._known.items() if isinstance(part, np.ndarray)}
        self._names = {address(part): name for name, part in reversed(arrays.items())}
        ends = sorted({(address(part), address(part) + part.nbytes) for part in arrays.values() if part.size})
        if any(end > begin for (_, end), (begin, _) in pairwise(ends)):
            raise LatheError("arrays of a step's memory that share a part of it cannot be printed as C")
        own = {name: part for name, part in arrays.items() if part.size and self._names[address(part)] == name}
        self._tables = {name: part for name, part in own.items() if not part.flags.writeable}
        self._rows = rows
        self._arrays = {name: self._cut(part) for name, part in own.items() if part.flags.writeable}
        self._offsets: dict[str, int] = {}
        self.size = 0
        numbers = [path for places in tuned.values() for path, index in places if index is None]
        self._numbers = {_named(path): self._known[path] for path in numbers}
        state = [(name, np.zeros(1)) for name in self._numbers] + [*self._arrays.items()]
        for name, part in sorted(state, key=lambda each: -self._bytes[each[1].dtype.kind]):  # no gaps
            self._offsets[name] = self.size
            self.size += part.size * self._bytes[part.dtype.kind]
        self.size = -(-self.size // 8) * 8

    def _cut(self, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return array[..., : self._rows.get(address(array))]

    def offset(self, array: npt.NDArray[Any], index: int = 0) -> int:
        """Return the offset in the state of an element of an array [B]."""
        return self._offsets[self._names[address(array)]] + index * self._bytes[array.dtype.kind]

    def offsets(self, parameter: str) -> list[int]:
        """Return the offsets in the state of the numbers that a parameter is stored as [B]."""
        places = self._tuned[parameter]
        found = [self._offsets[_named(path)] for path, index in places if index is None]
        return found + [self.offset(self._known[path], index) for path, index in places if index is not None]

    def tables(self) -> Iterator[str]:
        """Yield the lines of the tables, and of what arrays of the state begin with where that is not 0."""
        starts = {name: np.trim_zeros(part.reshape(-1), "b") for name, part in self._arrays.items()}
        named = {f"table_{name}": part for name, part in self._tables.items()}
        named |= {f"start_{name}": part for name, part in starts.items() if part.size}
        for name, part in named.items():
            yield f"static const {_ELEMENTS[part.dtype]} {name}[{part.size}] = {{"
            yield from (f"    {listed(map(number, part.reshape(-1).tolist()), 4)}", "};", "")

    def state(self) -> Iterator[str]:
        """Yield the members of the state."""
        for name in self._offsets:
            part = self._arrays.get(name)
            yield f"double {name};" if part is None else f"{_ELEMENTS[part.dtype]} {name}[{part.size}];"
        if not self._offsets:
            yield "int64_t none;"

    def start(self) -> Iterator[str]:
        """Yield the statements that write the state before sample 0 where that is not 0."""
        yield from (f"state->{name} = {number(value)};" for name, value in self._numbers.items())
        for name, part in self._arrays.items():
            if part.any():
                yield f"(void)memcpy(state->{name}, start_{name}, sizeof start_{name});"

    def members(self) -> Iterator[str]:
        """Yield the lines of the initialiser of the memory: constants, and addresses of tables and state."""
        yield from self._members(self._kind, self._memory, ())

    def _members(self, kind: StructView, value: tuple[Any, ...], above: Path) -> Iterator[str]:
        for (name, (member, _)), part in zip(kind.members.items(), value, strict=True):
            path = (*above, name)
            if isinstance(member, StructView):
                yield f".{safe(name)} = {{"
                yield from (f"    {line}" for line in self._members(member, part, path))
                yield "},"
            elif isinstance(part, np.ndarray):
                yield f".{safe(name)} = {{{self._pointer(part)}, {', '.join(map(str, self._cut(part).shape))}}},"
            else:
                known = _named(path) in self._numbers
                yield f".{safe(name)} = {f'state->{_named(path)}' if known else number(part)},"
        if not kind.members:
            yield ".none = 0,"

    def _pointer(self, array: npt.NDArray[Any]) -> str:
        name = self._names[address(array)]
        if not array.size:
            return "NULL"
        return f"state->{name}" if name in self._arrays else f"({_ELEMENTS[array.dtype]} *)table_{name}"


def leaves(memory: tuple[Any, ...], above: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Yield the arrays and numbers of a memory with the names of their members."""
    for name, part in zip(memory._fields, memory, strict=True):  # type: ignore[attr-defined]  # a NamedTuple
        if isinstance(part, tuple):
            yield from leaves(part, (*above, name))
        else:
            yield (*above, name), part


def listed(texts: Iterable[str], columns: int) -> str:
    """Return an initialiser with so many elements in a line."""
    all_of = list(texts)
    return ",\n    ".join(", ".join(all_of[k : k + columns]) for k in range(0, len(all_of), columns))


def _named(path: Path) -> str:
    return safe("_".join(path))
