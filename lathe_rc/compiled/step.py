# SPDX-License-Identifier: Apache-2.0
"""Steps as functions that take addresses: called by a program without Python, or by one stage with little overhead.

The function for a kind of step is in a separate generated module, whose compiled code is cached; the code depends on
the types of the memory and the ports, not on their values.
"""

import hashlib
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache, cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
from numba.core.errors import NumbaError

from lathe_rc.arrays import Integers
from lathe_rc.compiled.struct_view import Struct, StructView, address, call
from lathe_rc.errors import InputError, LatheError, shown
from lathe_rc.extensions import is_ours, source_hash
from lathe_rc.jit import cache_folder, kernel, read_kept

Step = Callable[..., tuple[int, int]]

_FIELDS = {np.dtype(np.float64): "floats", np.dtype(np.uint8): "octets"}
_MODULE = '''"""Written by lathe_rc.compiled.step: {step} as a function of addresses.

The memory is {memory}.
The source is {source}.
"""

import {module}
from lathe_rc.jit import entry
from lathe_rc.compiled.struct_view import at, floats, octets, ports, store, word

STEP = {step}


@entry
def enter(memory, first, start, samples, fields, reached):
    sample, reason = STEP(
        at(memory, MEMORY),
        first,
        start,
        {inputs},
        {flags},
        {outputs},
    )
    store(reached, sample)
    return reason
'''


_PLACE = re.compile(r'File "([^"]+)", line (\d+)')
_WRONG = ("Unknown attribute", "No implementation", "Cannot unify", "Cannot", "Untyped global", "Invalid use", "Use of")
BROKEN = -2  #: sample reached by a step that raised an exception, which Numba prints; the function returns 0


def broken() -> LatheError:
    """Return the error for a step that has raised an exception."""
    return LatheError(
        "the step has raised an exception, which Numba has printed on the error stream of its process; "
        "without @kernel Python says where"
    )


class AddressTable:
    """Layout of the address table of a step: positions of the addresses of the step's arrays.

    The table contains the number of float64 inputs; the uint8 inputs, where a zero address represents no input; the
    outputs; and finally the float64 inputs, so that their number does not affect the other positions.

    Args:
        inputs, outputs: element types of the arrays of all fields of all ports.

    Attributes:
        places: positions of the arrays, in order.
        size: size of the table.
        flags: number of positions for uint8 inputs.
        floats: number of float64 inputs.
        first: position of the first float64 input.
    """

    def __init__(self, inputs: Sequence[np.dtype[Any]], outputs: Sequence[np.dtype[Any]]) -> None:
        self.floats = sum(kind == np.float64 for kind in inputs)
        self.flags = max(len(inputs) - self.floats, 1)
        self.first = 1 + self.flags + len(outputs)
        self.size = self.first + self.floats
        flags, floats = iter(range(1, self.first)), iter(range(self.first, self.size))
        read = [next(floats if kind == np.float64 else flags) for kind in inputs]
        self.places = [*read, *range(1 + self.flags, self.first)]


class CompiledStep:
    """Step with its memory, as a function that takes addresses.

    Args:
        step: step function (see `lathe_rc.cell.stage`).
        memory: memory of the step.
        inputs, outputs: element types of the arrays of all fields of all ports.

    Attributes:
        name: name of the generated module.
        words: words of the memory (see `lathe_rc.compiled.struct_view.Struct`).
        view: type of the memory.
        update: updates the layout of the memory (see `lathe_rc.compiled.struct_view.Struct.update`).
    """

    def __init__(
        self,
        step: Step,
        memory: tuple[Any, ...],
        inputs: Sequence[np.dtype[Any]],
        outputs: Sequence[np.dtype[Any]],
    ) -> None:
        layout = Struct(memory)
        self.words, self.update, self.view = layout.words, layout.update, layout.kind
        self._entry = _entry(step, layout.kind, tuple(inputs), tuple(outputs))
        self.name, table = self._entry.name, self._entry.table
        self._places, self._reached, self._fields = table.places, np.zeros(1, np.int64), np.zeros(table.size, np.int64)
        self._fields[0] = table.floats

    @property
    def address(self) -> int:
        """Address of the function, which is compiled on first use.

        Raises:
            InputError: the function cannot be compiled.
        """
        return self._entry.address

    @property
    def table(self) -> AddressTable:
        """Layout of the address table."""
        return self._entry.table

    def __call__(self, first: int, start: int, fields: Sequence[npt.NDArray[Any]], samples: int) -> tuple[int, int]:
        """Call the step with the arrays of all fields, each of shape (samples,)."""
        for place, array in zip(self._places, fields, strict=True):
            assert array.flags.c_contiguous, "kernels take it for contiguous"
            assert array.size == samples, "and as long as the block"
            self._fields[place] = address(array)
        self._reached[0] = BROKEN
        reason = _call(self.address, self.words, first, start, samples, self._fields, self._reached)
        if self._reached[0] == BROKEN:
            raise broken()
        return int(self._reached[0]), reason


def _cause(told: str) -> str:
    """Return Numba's reason for a compilation error as one line: the innermost location, and the error there."""
    places = [found for found in _PLACE.findall(told) if not Path(found[0]).name.startswith("step_")]
    words = [line.strip() for line in told.splitlines()]
    why = next((line for line in reversed(words) if line.startswith(_WRONG)), next(filter(None, words), "no reason"))
    where = f" at {Path(places[0][0]).name}, line {places[0][1]}" if places else ""
    return f"a step cannot be compiled{where}: {shown(why)}"


@kernel
def _call(
    address: int, words: Integers, first: int, start: int, samples: int, fields: Integers, reached: Integers
) -> int:
    reason: int = call(address, words.ctypes.data, first, start, samples, fields.ctypes.data, reached.ctypes.data)
    return reason


# ---- the module ----------------------------------------------------------------------------------------------------


class Entry:
    """Function that takes addresses, for one kind of step, memory and ports (see `CompiledStep`)."""

    def __init__(
        self, step: Step, memory: StructView, inputs: Sequence[np.dtype[Any]], outputs: Sequence[np.dtype[Any]]
    ) -> None:
        self.table = AddressTable(inputs, outputs)
        self._memory, self._text = memory, _text(step, memory, self.table, outputs)
        self.name = f"step_{hashlib.sha256(self._text.encode()).hexdigest()[:16]}"

    @cached_property
    def address(self) -> int:
        """Address of the function, which is compiled on first use."""
        try:
            return int(_module(self.name, self._text, self._memory).enter.address)
        except NumbaError as error:
            raise InputError(_cause(str(error))) from error


_entry = cache(Entry)  # one entry for all calls with equal arguments


def _text(step: Step, memory: StructView, table: AddressTable, outputs: Sequence[np.dtype[Any]]) -> str:
    """Return the source code of the generated module."""

    def arrays(begin: int, kinds: Iterable[np.dtype[Any]]) -> str:
        return "".join(f"{_FIELDS[kind]}(fields, {place}, samples), " for place, kind in enumerate(kinds, begin))

    # A third-party step gets a tuple, which it may unpack; a built-in step is compiled once for any number of inputs.
    read = f"ports(fields + {8 * table.first}, word(fields, 0), samples)"
    return _MODULE.format(
        step=f"{step.__module__}.{step.__qualname__}",
        source=_source(step.__module__),
        module=step.__module__,
        memory=memory,
        inputs=read if is_ours(step.__module__) else f"({arrays(table.first, [np.dtype(np.float64)] * table.floats)})",
        flags=f"({arrays(1, [np.dtype(np.uint8)] * table.flags)})",
        outputs=f"({arrays(1 + table.flags, outputs)})",
    )


def is_compiled(function: object) -> bool:
    """Return whether a function is a kernel."""
    return hasattr(function, "py_func")


def step_of(stage: type, loop: Step, sample: object) -> Step:
    """Return a loop function as the step of a stage class, compiled if the function that it calls is a kernel."""
    loop.__module__, loop.__qualname__ = stage.__module__, f"{stage.__qualname__}.step"
    return kernel(loop) if is_compiled(sample) else loop


def _source(module: str) -> str:
    """Return the text that distinguishes versions of a step; each version of the built-in steps has its own cache."""
    return "that of lathe_rc" if is_ours(module) else source_hash(module)


def is_kept(name: str) -> bool:
    """Return whether the cache of this computer contains the compiled code of a module, undamaged."""
    files = list(cache_folder().glob(f"*/{name}.*"))
    # Reading verifies the files: a damaged file is removed and compiled again.
    return any(path.suffix == ".nbi" for path in files) and None not in [read_kept(path) for path in files]


@cache
def _module(name: str, text: str, memory: StructView) -> ModuleType:
    """Create a module from source code, without a file; only its compiled code is stored."""
    module = ModuleType(f"lathe_rc_steps.{name}")
    vars(module)["MEMORY"] = memory
    # Numba looks up a function's module by name when it loads compiled code.
    sys.modules[module.__name__] = module
    exec(compile(text, f"/lathe_rc_steps/{name}.py", "exec"), vars(module))  # noqa: S102 - generated here
    return module
