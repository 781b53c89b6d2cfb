# SPDX-License-Identifier: Apache-2.0
"""Steps as functions of addresses: what a program calls without Python, and a stage alone with little of it.

A step takes a memory, a NamedTuple of many arrays and constants, and the arrays of its ports. To hand them over one by
one would take longer than most steps. So for each kind of memory a function is written that takes addresses alone,
makes the memory and the arrays of what it finds there, and calls the step. It stands in a module of its own, which is
kept beside the compiled kernels: it depends on how the memory and the ports are made, not on what is in them.
"""

import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numba
import numpy as np
import numpy.typing as npt

from lathe_rc.files import replacing
from lathe_rc.jit import call, kernel

Integers = npt.NDArray[np.int64]
Step = Callable[..., tuple[int, int]]

_KINDS = {np.dtype(np.float64): "floats", np.dtype(np.int64): "integers", np.dtype(np.uint8): "octets"}
_ENTRY = '''"""Written by lathe_rc.cell.native: {step} as a function of addresses."""

{imports}
from lathe_rc.jit import entry, floats, integers, octets


@entry
def enter(words_at, first, start, samples, fields_at, reached_at):
    w, f, p = integers(words_at, {words}), floats(words_at, {words}), integers(fields_at, {fields})
    reached, reason = {step}(
        {memory},
        first, start,
        {inputs},
        {flags},
        {outputs},
    )
    integers(reached_at, 1)[0] = reached
    return reason
'''


def _leaves(value: Any) -> Iterator[Any]:
    """Arrays and constants of a memory, in order."""
    if isinstance(value, tuple):
        for part in value:
            yield from _leaves(part)
    else:
        yield value


class Words:
    """A memory as 64-bit words: of an array where it is and its shape, of a constant its value.

    Args:
        memory: NamedTuple of arrays and constants.

    Attributes:
        words: for the function of addresses.
    """

    def __init__(self, memory: tuple[Any, ...]) -> None:
        self._leaves = list(_leaves(memory))
        self._places, size = [], 0
        for leaf in self._leaves:
            self._places.append(size)
            size += 1 + leaf.ndim if isinstance(leaf, np.ndarray) else 1
        self.words = np.zeros(max(size, 1), np.int64)
        self._floats = self.words.view(np.float64)
        for number, leaf in enumerate(self._leaves):
            self._write(number, leaf)

    def update(self, memory: tuple[Any, ...]) -> None:
        """Take what has been replaced in the memory."""
        known = self._leaves
        for number, leaf in enumerate(_leaves(memory)):
            if leaf is not known[number]:
                self._write(number, leaf)

    def _write(self, number: int, leaf: Any) -> None:
        self._leaves[number], place = leaf, self._places[number]
        if isinstance(leaf, np.ndarray):
            assert leaf.flags.c_contiguous, "kernels take it for contiguous"
            self.words[place] = leaf.ctypes.data
            self.words[place + 1 : place + 1 + leaf.ndim] = leaf.shape
        elif isinstance(leaf, float):
            self._floats[place] = leaf
        else:
            self.words[place] = leaf


class Native:
    """A step with its memory as a function of addresses.

    Args:
        step: see `lathe_rc.cell.stage`.
        memory: that it works on.
        inputs, outputs: element types of the arrays of all fields of all ports.

    Attributes:
        address: of the function.
        words: of the memory, see `Words`.
        order: the fields as the function takes them, inputs before outputs.
    """

    def __init__(
        self,
        step: Step,
        memory: tuple[Any, ...],
        inputs: Sequence[np.dtype[Any]],
        outputs: Sequence[np.dtype[Any]],
    ) -> None:
        module = _module(_text(step, memory, inputs, outputs))
        self.address: int = module.enter.address
        self._words = Words(memory)
        self.words = self._words.words
        self._reached, self._fields = np.zeros(1, np.int64), np.zeros(len(inputs) + len(outputs), np.int64)

    def update(self, memory: tuple[Any, ...]) -> None:
        """See `Words`."""
        self._words.update(memory)

    def __call__(self, first: int, start: int, fields: Sequence[npt.NDArray[Any]], samples: int) -> tuple[int, int]:
        """Call the step for the arrays of all fields, shape (samples,)."""
        for place, array in enumerate(fields):
            assert array.flags.c_contiguous, "kernels take it for contiguous"
            self._fields[place] = array.ctypes.data
        reason = _call(self.address, self.words, first, start, samples, self._fields, self._reached)
        return int(self._reached[0]), reason


@kernel
def _call(
    address: int, words: Integers, first: int, start: int, samples: int, fields: Integers, reached: Integers
) -> int:
    return call(address, words.ctypes.data, first, start, samples, fields.ctypes.data, reached.ctypes.data)


# ---- the module ----------------------------------------------------------------------------------------------------


def _text(
    step: Step, memory: tuple[Any, ...], inputs: Sequence[np.dtype[Any]], outputs: Sequence[np.dtype[Any]]
) -> str:
    """The text of the module."""
    modules = {step.__module__}
    place = 0

    def made(value: Any) -> str:
        nonlocal place
        if isinstance(value, tuple):
            kind = type(value)
            modules.add(kind.__module__)
            return f"{kind.__module__}.{kind.__qualname__}({', '.join(made(part) for part in value)})"
        begin, place = place, place + (1 + value.ndim if isinstance(value, np.ndarray) else 1)
        if isinstance(value, np.ndarray):
            shape = ", ".join(f"w[{begin + 1 + axis}]" for axis in range(value.ndim))
            return f"{_KINDS[value.dtype]}(w[{begin}], {shape if value.ndim == 1 else f'({shape})'})"
        if isinstance(value, float):
            return f"f[{begin}]"
        return f"w[{begin}] != 0" if isinstance(value, bool | np.bool_) else f"w[{begin}]"

    def arrays(fields: Sequence[tuple[int, np.dtype[Any]]]) -> str:
        return "(" + "".join(f"{_KINDS[dtype]}(p[{number}], samples), " for number, dtype in fields).rstrip() + ")"

    read = list(enumerate(inputs))
    text = made(memory)
    return _ENTRY.format(
        step=f"{step.__module__}.{step.__name__}",
        imports="\n".join(f"import {module}" for module in sorted(modules)),
        words=max(place, 1),
        fields=len(inputs) + len(outputs),
        memory=text,
        inputs=arrays([field for field in read if field[1] == np.float64]),
        flags=arrays([field for field in read if field[1] == np.uint8]).replace("()", "(octets(0, 0),)"),
        outputs=arrays(list(enumerate(outputs, len(inputs)))),
    )


@cache
def _module(text: str) -> ModuleType:
    """The module of a text, kept in a file: Numba keeps what it has compiled for a file."""
    name = f"step_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    folder = Path(os.environ.get("NUMBA_CACHE_DIR") or numba.config.CACHE_DIR) / "steps"
    path = folder / f"{name}.py"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(text.encode())
    spec = importlib.util.spec_from_file_location(f"lathe_rc_steps.{name}", path)
    assert spec is not None, "it is a Python file"
    assert spec.loader is not None, "it is a Python file"
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    spec.loader.exec_module(module)
    return module
