# SPDX-License-Identifier: Apache-2.0
"""The program of a cell: the steps of its stages, in order, block after block, as one compiled function.

The function stands in a module that is written for the structure of the cell (which steps, which topics between them)
and kept beside the compiled kernels; parameters are not part of it. It comes back where Python is needed: a stage asks
for it, an event is due, or a stage has no compiled step. It goes on at that stage and sample.
"""

import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numba
import numpy as np

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Samples, Signals
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.stage import DONE, PYTHON, Sparse, Stage
from lathe_rc.files import replacing
from lathe_rc.jit import kernel

_HEAD = '''"""Written by lathe_rc.cell.program; the steps of a cell as one compiled function."""

from lathe_rc.cell.program import passes
from lathe_rc.jit import kernel
'''
_RUN = '''

@kernel
def run(memories, floats, bytes_, late, due, turn, where, base, end, chunk):
    first, stage, start = where[0], where[1], where[2]
    while first < end:
        n = min(chunk, end - first)
        o = base + first
'''


class Tapes:
    """The samples of some topics, one piece after the other; of what is read late, those before the piece as well.

    Before sample 0 everything is zero.

    Args:
        topics: message type and, by field, the longest delay [sample] at which it is read, by relative topic.
        samples: length of a piece, at most.
    """

    def __init__(self, topics: Mapping[str, tuple[str, Mapping[str, int]]], samples: int) -> None:
        self._delays = {
            (topic, name): delays.get(name, 0)
            for topic, (kind, delays) in topics.items()
            for name in messages.sample_fields(kind)
        }
        self.history = max(self._delays.values(), default=0)
        self.arrays = {
            (topic, name): np.zeros(self.history + samples, dtype)
            for topic, (kind, _) in topics.items()
            for name, dtype in messages.sample_fields(kind).items()
        }
        self._fields = {topic: list(messages.sample_fields(kind)) for topic, (kind, _) in topics.items()}
        self.begin = 0  #: sample index with which the piece begins

    def view(self, topic: str, first: int, samples: int, delay: int = 0) -> Signals:
        """Views of what a reader with this delay sees at the samples ``first`` on."""
        start = self.history + first - self.begin - delay
        return {name: self.arrays[topic, name][start : start + samples] for name in self._fields[topic]}

    def advance(self, first: int) -> None:
        """Begin the next piece with sample ``first``."""
        shift = first - self.begin
        for key, delay in self._delays.items():
            if delay:
                array, kept = self.arrays[key], slice(self.history - delay, self.history)
                array[kept] = array[kept.start + shift : kept.stop + shift].copy()
        self.begin = first


class Program:
    """Some stages that compute in one go.

    Args:
        stages: in the order in which they compute; none may read what a later one writes without a delay.
        tapes: of all topics that they read and write.
        chunk: samples that a stage computes in one go: at most the shortest feedback between them.
    """

    def __init__(self, stages: Sequence[Stage], tapes: Tapes, chunk: int) -> None:
        self._stages, self._tapes, self._chunk = list(stages), tapes, chunk
        self._floats = tuple(array for array in tapes.arrays.values() if array.dtype == np.float64)
        self._bytes = tuple(array for array in tapes.arrays.values() if array.dtype == np.uint8)
        self._bytes = self._bytes or (np.empty(0, np.uint8),)
        assert all(array.dtype in (np.float64, np.uint8) for array in tapes.arrays.values()), "float64 and uint8 are all that blocks have"
        self._late = np.array([port.delay for stage in self._stages for port in stage.inputs] or [0], np.int64)
        self._due, self._turn = np.empty(len(self._stages), np.int64), np.empty(len(self._stages))
        self._where = np.zeros(3, np.int64)
        self._told = [0] * len(self._stages)
        self._sparse: list[list[Sparse]] = [[] for _ in self._stages]
        self._run = cast("Callable[..., int]", _module("\n".join(self._source())).run)
        self._load()
        self._call(0)  # compiles

    # ---- the module ---------------------------------------------------------------------------------

    def _source(self) -> Iterator[str]:
        """The text of the module."""
        steps = [stage.step for stage in self._stages]
        modules = sorted({step.__module__ for step in steps if step is not None})
        yield _HEAD + "\n".join(f"import {module}" for module in modules) + _RUN.rstrip("\n")
        place = 0
        for number, (stage, step) in enumerate(zip(self._stages, steps, strict=True)):
            places, place = range(place, place + len(stage.inputs)), place + len(stage.inputs)
            yield f"        if stage <= {number}:  # {stage.kind}"
            if step is None:
                yield f"            where[:] = first, {number}, 0"
                yield f"            return {PYTHON}"
                continue
            read = [self._read(stage, port, at) for port, at in zip(range(stage.own_inputs), places, strict=False)]
            fields = [one for some in read for one in some]
            written = [
                f"{self._array(remapped(stage.shared, output.topic), name)}[o : o + n]"
                for output in stage.outputs
                for name in messages.sample_fields(output.type)
            ]
            begins = f"due[{number}] < first + n"
            angle = stage.angle_input
            if angle is not None:
                seen = self._array(remapped(stage.shared, stage.inputs[angle].topic), "angle")
                begins += f" or passes({seen}[o : o + n], turn[{number}])"
            yield f"            if start == 0 and ({begins}):"
            yield f"                where[:] = first, {number}, 0"
            yield f"                return {PYTHON}"
            yield f"            start, reason = {step.__module__}.{step.__name__}("
            yield f"                memories[{number}], first, start,"
            yield f"                {_tuple([one for one in fields if one.startswith('floats')])},"
            yield f"                {_tuple([one for one in fields if one.startswith('bytes')] or ['bytes_[0][:0]'])},"
            yield f"                {_tuple(written)},"
            yield "            )"
            yield f"            if reason != {DONE}:"
            yield f"                where[:] = first, {number}, start"
            yield "                return reason"
            yield "            start = 0"
        yield "        stage = start = 0"
        yield "        first += n"
        yield "    where[:] = first, 0, 0"
        yield f"    return {DONE}"
        yield ""

    def _read(self, stage: Stage, port: int, place: int) -> list[str]:
        topic = remapped(stage.shared, stage.inputs[port].topic)
        begin = f"o - late[{place}]" if stage.inputs[port].delay else "o"
        return [f"{self._array(topic, name)}[{begin} : {begin} + n]" for name in stage.inputs[port].fields]

    def _array(self, topic: str, name: str) -> str:
        """How the function calls an array."""
        array = self._tapes.arrays[topic, name]
        of, all_ = ("floats", self._floats) if array.dtype == np.float64 else ("bytes_", self._bytes)
        return f"{of}[{next(place for place, other in enumerate(all_) if other is array)}]"

    # ---- running ------------------------------------------------------------------------------------

    def _load(self) -> None:
        """Take what stages have in their memories now, and when they want Python next."""
        self._memories = tuple(stage.memory for stage in self._stages)
        for number, stage in enumerate(self._stages):
            self._due[number], self._turn[number] = stage.due

    def _call(self, end: int) -> int:
        base = self._tapes.history - self._tapes.begin
        return self._run(
            self._memories, self._floats, self._bytes, self._late, self._due, self._turn, self._where, base, end,
            self._chunk,
        )  # fmt: skip

    def run(self, end: int) -> None:
        """Compute up to sample ``end``, which must lie within the piece of the tapes.

        Raises:
            LatheError: a stage cannot go on; names it. What was computed before is on the tapes, see `reached`.
        """
        for stage in self._stages:
            stage.prepare(self.reached, end - self.reached)
        self._load()
        while (reason := self._call(end)) != DONE:
            first, number, reached = self._where.tolist()
            self._serve(reason, first, number, reached, min(self._chunk, end - first))
            self._load()
        for number in range(len(self._stages)):
            self._tell(number, end)

    @property
    def reached(self) -> int:
        """Sample up to which all stages have computed."""
        return int(self._where[0])

    def _serve(self, reason: int, first: int, number: int, reached: int, samples: int) -> None:
        """Do in Python what a stage needs."""
        stage, tapes = self._stages[number], self._tapes
        inputs = [tapes.view(remapped(stage.shared, p.topic), first, samples, p.delay) for p in stage.inputs]
        outputs = [tapes.view(remapped(stage.shared, p.topic), first, samples) for p in stage.outputs]
        with stage.named():
            if reason == PYTHON:
                self._tell(number, first)
                self._sparse[number] += stage.compute(first, inputs, outputs)
                self._told[number] = first + samples
                self._where[:] = first, number + 1, 0
            else:
                self._tell(number, first + reached)
                self._sparse[number] += stage.serve(reason, first, reached, inputs, outputs)

    def _tell(self, number: int, end: int) -> None:
        """Collect what a stage has to say of what it has computed."""
        if self._told[number] < end:
            self._sparse[number] += self._stages[number].tell(self._told[number], end)
            self._told[number] = end

    def said(self, number: int) -> list[Sparse]:
        """What a stage has said since the last call."""
        said, self._sparse[number] = self._sparse[number], []
        return said


@kernel
def passes(angle: Samples, turn: float) -> bool:
    """Whether an angle of rising samples, shape (n,), reaches ``turn`` [rad]; the search is that of NumPy."""
    if turn == np.inf:
        return False
    low, high = 0, angle.size
    while low < high:
        middle = low + ((high - low) >> 1)
        if angle[middle] < turn:
            low = middle + 1
        else:
            high = middle
    return low < angle.size


def _tuple(items: Sequence[str]) -> str:
    return f"({', '.join(items)}{',' if len(items) == 1 else ''})" if items else "()"


def _module(text: str) -> Any:
    """The module of a text, kept in a file: Numba keeps what it has compiled for a file."""
    name = f"cell_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    full = f"lathe_rc_programs.{name}"
    if full not in sys.modules:
        folder = Path(os.environ.get("NUMBA_CACHE_DIR") or numba.config.CACHE_DIR) / "programs"
        path = folder / f"{name}.py"
        if not path.exists():
            folder.mkdir(parents=True, exist_ok=True)
            with replacing(path) as file:
                file.write(text.encode())
        spec = importlib.util.spec_from_file_location(full, path)
        assert spec is not None, "it is a Python file"
        assert spec.loader is not None, "it is a Python file"
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        sys.modules[full] = module
    return sys.modules[full]
