# SPDX-License-Identifier: Apache-2.0
"""Program of a cell: the steps of its stages, in order, block after block, as one compiled loop.

The loop returns when Python is needed (a stage requests it, an event is due, or a step is not compiled), and later
continues at that stage and sample.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from lathe_rc import messages
from lathe_rc.arrays import Integers
from lathe_rc.blocks.delay_buffer import past_of
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.stage import DONE, PYTHON, Stage
from lathe_rc.compiled.step import BROKEN, AddressTable, broken
from lathe_rc.compiled.struct_view import address, call, floats
from lathe_rc.extensions import is_ours
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples, Signals

_CHUNK = 1024  # largest number of samples per call of a stage, so that signals between stages stay in the cache


class Tapes:
    """Tapes: sample buffers of topics, filled chunk by chunk, with the past samples needed by delayed readers.

    Before sample 0 everything is zero. For fields used only within a chunk, a single chunk is buffered, which stays in
    the cache.

    Args:
        topics: by relative topic, the message type and, by field, the longest delay [sample] with which it is read.
        samples: maximum length of the buffered interval.
        passing: fields, with their topics, whose samples are not needed after the chunk in which they are computed,
            unless a reader has a delay.
        chunk: maximum length of a chunk.
    """

    def __init__(
        self,
        topics: Mapping[str, tuple[str, Mapping[str, int]]],
        samples: int,
        passing: Collection[tuple[str, str]] = (),
        chunk: int = 0,
    ) -> None:
        self._delays = {
            (topic, name): delays.get(name, 0)
            for topic, (kind, delays) in topics.items()
            for name in messages.sample_fields(kind)
        }
        self.history = max(self._delays.values(), default=0)
        self._passing = {key for key in passing if not self._delays[key]}
        self._arrays = {
            (topic, name): np.zeros(chunk if (topic, name) in self._passing else self.history + samples, dtype)
            for topic, (kind, _) in topics.items()
            for name, dtype in messages.sample_fields(kind).items()
        }
        self._fields = {topic: list(messages.sample_fields(kind)) for topic, (kind, _) in topics.items()}
        self.begin = 0  #: sample index at which the buffered interval begins

    def view(
        self, topic: str, first: int, samples: int, delay: int = 0, names: Collection[str] | None = None
    ) -> Signals:
        """Return views of samples from ``first`` on for a delayed reader; of ``passing`` fields, one chunk at most.

        Args:
            topic: relative name.
            first: sample index.
            samples: number of samples.
            delay: delay of the reader [sample].
            names: names of the fields; None: all.
        """
        start = self.history + first - self.begin - delay
        whole, passing = slice(start, start + samples), slice(samples)
        return {
            name: self._arrays[topic, name][passing if (topic, name) in self._passing else whole]
            for name in (self._fields[topic] if names is None else names)
        }

    def place(self, topic: str, name: str, delay: int) -> tuple[int, int]:
        """Return the base address of a field for a reader with a delay, and the address increment per sample."""
        array = self._arrays[topic, name]
        # The address counts from the start of the history; a passing field has a fixed address.
        return address(array) - delay * array.itemsize, 0 if (topic, name) in self._passing else array.itemsize

    def advance(self, first: int) -> None:
        """Begin the next buffered interval at sample ``first``."""
        shift = first - self.begin
        for key, delay in self._delays.items():
            if delay:
                array, kept = self._arrays[key], slice(self.history - delay, self.history)
                # Copied, because the slices may overlap.
                array[kept] = array[kept.start + shift : kept.stop + shift].copy()
        self.begin = first

    def rewind(self) -> None:
        """Reset to the state before sample 0."""
        for array in self._arrays.values():
            array.fill(0)
        self.begin = 0

    def blank(self, topic: str) -> None:
        """Make all numbers of a topic NaN, so that a field that its stage does not fill is found out."""
        for name in self._fields[topic]:
            array = self._arrays[topic, name]
            if array.dtype == np.float64:
                array[0 if (topic, name) in self._passing else self.history :] = np.nan

    def past(self, end: int) -> dict[str, Signals]:
        """Return copies of the samples before ``end`` that delayed readers need, by topic and field."""
        found: dict[str, Signals] = {}
        for (topic, name), delay in self._delays.items():
            if delay:
                found.setdefault(topic, {})[name] = self.view(topic, end, delay, delay, [name])[name].copy()
        return found

    def restart(self, first: int, past: Mapping[str, Signals]) -> None:
        """Reset to the state before sample ``first``.

        Args:
            first: sample index.
            past: the samples before it, as returned by `past`; there may be more than needed.

        Raises:
            InputError: a reader needs older samples.
        """
        self.rewind()
        self.begin = first
        for (topic, name), delay in self._delays.items():
            kept = past_of(past.get(topic, {}), f"/{topic.lstrip('/')}", name, delay, first)
            self._arrays[topic, name][self.history - kept.size : self.history] = kept


NOT_FINITE = -3  #: reason why a program has stopped: a number is not finite
_NOBODY = np.empty(0, np.int64)

# Columns of the plan, which has a row for each stage: address of the step or 0, address of its memory, first field,
# field with the spindle angle or -1, and the sample from which the stage needs Python.
_STEP, _WORDS, _FIELD, _ANGLE, _DUE = range(5)


@kernel
def _run(
    plan: Integers, turn: Samples, fields: Integers, where: Integers, base: int, end: int, chunk: int, told: Integers
) -> int:
    """Compute from `where` (block, stage, sample in the block) to sample ``end`` (see `Program`).

    Args:
        plan: plan of the loop, terminated by an additional row.
        turn: spindle angle from which each stage needs Python [rad].
        fields: for each field, the address of its first sample on the tape minus the delay, the increment per sample,
            and the address of the current block, shape (3, fields); the addresses of a stage form its `AddressTable`.
        where: current position; updated.
        base: position of sample 0 on the tape.
        end: index after the last sample.
        chunk: number of samples that a stage computes per call.
        told: indices of the fields that must be finite.

    Returns:
        Reason for stopping: `DONE` at the end, `NOT_FINITE` after a chunk with a NaN or infinite sample.
    """
    first, stage, start = where[0], where[1], where[2]
    origin, size, at = fields[0], fields[1], fields[2]
    while first < end:
        n = min(chunk, end - first)
        for field in range(at.size):
            at[field] = origin[field] + (base + first) * size[field]
        while stage < plan.shape[0] - 1:
            row = plan[stage]
            block = at.ctypes.data + 8 * row[_FIELD]
            # Events are searched for at the start of a chunk; there are none where a step resumes within a chunk.
            waits = row[_STEP] == 0 or (start == 0 and row[_DUE] < first + n)
            if start == 0 and turn[stage] < np.inf and row[_ANGLE] >= 0:
                waits = waits or _passes(floats(block, row[_ANGLE] - row[_FIELD], n), turn[stage])
            where[0], where[1], where[2] = first, stage, start
            if waits:
                return PYTHON
            # Numba prints and swallows an exception in a step; in that case the step does not write this word.
            where[2] = BROKEN
            reason: int = call(row[_STEP], row[_WORDS], first, start, n, block, where.ctypes.data + 16)
            if where[2] == BROKEN:
                return BROKEN
            if reason != DONE:
                return reason
            stage += 1
            start = 0
        stage = 0
        first += n
        where[0], where[1], where[2] = first, 0, 0
        for field in told:
            if not _finite(floats(at.ctypes.data, field, n)):
                return NOT_FINITE
    return DONE


@kernel
def _finite(samples: Samples) -> bool:
    """Return whether no sample is NaN or infinite."""
    count = 0
    for k in range(samples.size):
        # All samples are counted, because the compiler vectorises a loop only if it has no early exit.
        count += not abs(samples[k]) < np.inf
    return count == 0


@kernel
def _passes(angle: Samples, turn: float) -> bool:
    """Return whether an increasing angle, shape (n,), reaches ``turn`` [rad]; the search is the same as in NumPy."""
    low, high = 0, angle.size
    while low < high:
        middle = low + ((high - low) >> 1)
        if angle[middle] < turn:
            low = middle + 1
        else:
            high = middle
    return low < angle.size


def compile_loop() -> None:
    """Compile the loop, which is common to all programs."""
    none, fields, where = np.zeros((1, 5), np.int64), np.zeros((3, 0), np.int64), np.zeros(3, np.int64)
    assert _run(none, np.empty(0), fields, where, 0, 0, 1, _NOBODY) == DONE, "it has no stage, and nothing to compute"


def chunk_of(block: int, delays: Iterable[int]) -> int:
    """Return the chunk size [sample]: whole blocks, up to the shortest feedback delay, where 0 means no feedback."""
    most = min([_CHUNK, *(delay for delay in delays if delay)])
    return most // block * block or block


class Wired(NamedTuple):
    """Stage with the tapes that it reads and writes.

    Attributes:
        stage: the stage.
        inputs: tape and delay [sample] of each input.
        outputs: tape of each output.
    """

    stage: Stage
    inputs: Sequence[tuple[str, int]]
    outputs: Sequence[str]


def wired(stage: Stage) -> Wired:
    """Return a stage with tapes named after its topics."""
    inputs = [(remapped(stage.shared, port.topic), port.delay) for port in stage.inputs]
    return Wired(stage, inputs, [remapped(stage.shared, port.topic) for port in stage.outputs])


class Program:
    """Program that computes several stages in one compiled loop.

    Args:
        stages: stages in order of computation; none may read the output of a later one without a delay.
        tapes: tapes that the stages read and write.
        chunk: samples that a stage computes per call: at most the shortest feedback delay between the stages.

    Attributes:
        number: index of the failed stage if `run` has raised an error.
        ends: sample up to which each stage has computed; after an error, the stages before the failed one may be
            a chunk ahead.
    """

    def __init__(self, stages: Sequence[Wired], tapes: Tapes, chunk: int) -> None:
        self._tapes, self._chunk = tapes, chunk
        self._inputs, self._outputs = [each.inputs for each in stages], [each.outputs for each in stages]
        self._turn = np.empty(len(stages))
        self._plan = np.zeros((len(stages) + 1, 5), np.int64)
        fields: list[tuple[int, int, int]] = []
        told: list[int] = []
        # The plan has an additional row with the end of the last stage's fields.
        for row, (stage, inputs, outputs) in zip(self._plan, stages, strict=False):
            begin, angle, table = len(fields), stage.angle_input, AddressTable(*stage.field_types)
            row[_FIELD], row[_ANGLE] = begin, -1
            fields += [(table.floats, 0, 0)] + [(0, 0, 0)] * (table.size - 1)
            places = iter(begin + place for place in table.places)
            for number, port in enumerate(stage.inputs[: stage.own_inputs]):
                for name in port.fields:
                    place = next(places)
                    fields[place] = self._field(*inputs[number], name)
                    if number == angle and name == "angle":
                        row[_ANGLE] = place
            for tape, output in zip(outputs, stage.outputs, strict=True):
                for name, dtype in messages.sample_fields(output.type).items():
                    place = next(places)
                    told += [place] if dtype == np.float64 else []
                    fields[place] = self._field(tape, 0, name)
            if angle is not None and angle >= stage.own_inputs:
                row[_ANGLE] = len(fields)
                fields.append(self._field(*inputs[angle], "angle"))
        self._plan[-1, _FIELD] = len(fields)
        self._fields = np.ascontiguousarray(np.array(fields, np.int64).T)
        self._told_of = np.array(told, np.int64)
        self._where = np.zeros(3, np.int64)
        self.begin([each.stage for each in stages])

    def begin(self, stages: Sequence[Stage], first: int = 0) -> None:
        """Restart at sample ``first`` with other stages that have the same ports."""
        self._stages = stages
        self.number, self.ends = 0, [first] * len(stages)
        self._where[:] = first, 0, 0
        self._told = [first] * len(stages)
        self._sparse: list[list[Sparse]] = [[] for _ in stages]
        for number, stage in enumerate(stages):
            self._load(number)
            for tape in self._outputs[number] if not is_ours(type(stage).__module__) else ():
                self._tapes.blank(tape)

    def _field(self, tape: str, delay: int, name: str) -> tuple[int, int, int]:
        return *self._tapes.place(tape, name, delay), 0

    def _load(self, number: int) -> None:
        """Load the current memory of a stage, and the point at which it next needs Python."""
        stage, row = self._stages[number], self._plan[number]
        row[_STEP] = row[_WORDS] = 0
        if stage.is_compiled:
            native = stage.native()
            row[_STEP], row[_WORDS] = native.address, address(native.words)
        row[_DUE], self._turn[number] = stage.due

    def run(self, end: int, *, finite: bool = False) -> bool:
        """Compute up to sample ``end``, which must lie within the buffered interval of the tapes.

        Args:
            end: index after the last sample.
            finite: whether to stop after a chunk with a NaN or infinite sample.

        Returns:
            Whether the run was stopped because of a NaN or infinite sample.

        Raises:
            LatheError: a stage cannot continue; the message names the stage. Earlier results are on the tapes (see
                `reached`).
        """
        self.number = 0
        try:
            return self._compute(end, self._told_of if finite else _NOBODY)
        finally:
            first = self.reached
            # Only the stages before the failed one have computed the current chunk.
            ahead = min(first + self._chunk, end)
            self.ends = [ahead if number < self._where[1] else first for number in range(len(self._stages))]
            for number, reached in enumerate(self.ends):
                self._tell(number, reached)

    def _compute(self, end: int, told: Integers) -> bool:
        first = self.reached
        for number, stage in enumerate(self._stages):
            self.number = number
            with stage.named():
                stage.prepare(first, end - first)
            self._plan[number, _DUE], self._turn[number] = stage.due
        base = self._tapes.history - self._tapes.begin
        plan, turn, fields, where = self._plan, self._turn, self._fields, self._where
        while (reason := _run(plan, turn, fields, where, base, end, self._chunk, told)) != DONE:
            if reason == NOT_FINITE:
                return True
            first, self.number, reached = self._where.tolist()
            self._serve(reason, first, self.number, reached, min(self._chunk, end - first))
            # Python code may have replaced the step's memory, or its next event.
            self._load(self.number)
        return False

    @property
    def reached(self) -> int:
        """Sample up to which all stages have computed."""
        return int(self._where[0])

    def _serve(self, reason: int, first: int, number: int, reached: int, samples: int) -> None:
        """Handle in Python the reason why a stage has stopped the loop."""
        stage, tapes = self._stages[number], self._tapes
        inputs = [tapes.view(tape, first, samples, delay) for tape, delay in self._inputs[number]]
        outputs = [tapes.view(tape, first, samples) for tape in self._outputs[number]]
        with stage.named():
            if reason == BROKEN:
                raise broken()
            if reason == PYTHON:
                self._tell(number, first)
                self._sparse[number] += stage.compute(first, inputs, outputs)
                self._told[number] = first + samples
                self._where[:] = first, number + 1, 0
            else:
                self._tell(number, first + reached)
                self._sparse[number] += stage.serve(reason, first, reached, inputs, outputs)

    def _tell(self, number: int, end: int) -> None:
        """Collect the messages of a stage about the samples that it has computed."""
        if self._told[number] < end:
            self._sparse[number] += self._stages[number].tell(self._told[number], end)
            self._told[number] = end

    def said(self, number: int, end: int) -> list[Sparse]:
        """Return a stage's sparse messages since the last call, for samples before ``end``."""
        said = self._sparse[number]
        if not said:
            return []
        self._sparse[number] = []
        return [message for message in said if message.index < end]
