# SPDX-License-Identifier: Apache-2.0
"""Memory of a step as one relocatable block: the words of its layout, followed by its arrays.

Addresses in the words (see `lathe_rc.compiled`) become offsets from the beginning of the block. Arrays that share
memory, as a view does with its base, share it in the block too.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import types

from lathe_rc.compiled.struct_view import Struct, StructView, address

_ALIGNED = 64  # [B] alignment of each array, as the vector code of a step expects at best


class MemoryImage:
    """Copy of a step's memory.

    Args:
        memory: memory of the step (see `lathe_rc.cell.stage.Stage.memory`).

    Attributes:
        content: the block, shape (bytes,), with offsets in place of addresses.
        relocations: offsets of the words that hold addresses [B].
    """

    def __init__(self, memory: tuple[Any, ...]) -> None:
        layout = Struct(memory)
        self._arrays = list(_arrays(layout.kind, 0, memory))
        self._spans = _merged([(address(array), array.nbytes) for _, array in self._arrays])
        end, self._places = _up(layout.words.nbytes), list[int]()
        for begin, stop in self._spans:
            self._places.append(end)
            end = _up(end + stop - begin)
        self.content = np.zeros(end, np.uint8)
        words = self.content[: layout.words.nbytes].view(np.int64)
        words[:] = layout.words
        self.relocations: list[int] = []
        for place, array in self._arrays:
            if array.nbytes:
                words[place] = at = self.offset(array)
                self.content[at : at + array.nbytes] = array.reshape(-1).view(np.uint8)
                self.relocations.append(8 * place)

    def offset(self, array: npt.NDArray[Any], index: int = 0) -> int:
        """Return the offset of an element of an array of the memory [B].

        Args:
            array: an array, also a view or the base of one in the memory.
            index: index of the element in the flattened array.
        """
        at = address(array) + index * array.itemsize
        for (begin, stop), place in zip(self._spans, self._places, strict=True):
            if begin <= at < stop:
                return place + at - begin
        raise AssertionError("it is no array of the memory")


def _arrays(kind: StructView, begin: int, value: tuple[Any, ...]) -> Iterator[tuple[int, npt.NDArray[Any]]]:
    """Yield the arrays of a memory, with the numbers of the words that hold their addresses."""
    for (member, place), part in zip(kind.members.values(), value, strict=True):
        if isinstance(member, StructView):
            yield from _arrays(member, begin + place, part)
        elif isinstance(member, types.Array):
            yield begin + place, part


def _merged(arrays: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the spans of memory of some arrays, given by address and size, where arrays that overlap share one."""
    spans: list[tuple[int, int]] = []
    for begin, size in sorted(each for each in arrays if each[1]):
        if spans and begin < spans[-1][1]:
            spans[-1] = spans[-1][0], max(spans[-1][1], begin + size)
        else:
            spans.append((begin, begin + size))
    # In the order of the members, so that equal memories have equal images, wherever their arrays lie.
    return sorted(spans, key=lambda span: next(k for k, (begin, _) in enumerate(arrays) if span[0] <= begin < span[1]))


def _up(size: int) -> int:
    return -(-size // _ALIGNED) * _ALIGNED
