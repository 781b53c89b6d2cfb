# SPDX-License-Identifier: Apache-2.0
"""Offline host: all stages of a cell in one program."""

import gc
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NoReturn, Protocol, TypeVar

import numpy as np

from lathe_rc import messages
from lathe_rc.blocks.block import NotFiniteError, check_finite
from lathe_rc.blocks.delay_buffer import longest_delays
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.program import Program, Tapes, chunk_of, wired
from lathe_rc.cell.stage import compile_kernels
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import DivergedError
from lathe_rc.jit import check_compiler
from lathe_rc.messages import MAX_BLOCK, Samples, Signals

K = TypeVar("K")


class Sink(Protocol):
    """Sink that receives the results of a run in order, chunk by chunk."""

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Process the samples of each requested topic from ``first`` on, and the sparse messages at these samples."""


class Engine:
    """Engine that runs a cell offline, as fast as possible.

    A stage computes as many samples per call as the shortest feedback allows, independent of ``block_size``; sinks
    receive whole blocks, which can be divided into the messages of any other host. The results depend neither on the
    number of samples per call nor on ``block_size``.

    Args:
        cell: the wired cell; must have passed its check.
        heard: relative topics requested by the sinks, or ``TOPIC.FIELD`` for a single field of a topic; None: all.
            Other signals are not kept, and other sparse messages are not created.

    Attributes:
        stages: the stages of the cell.
        first: index of the first sample of the run.
        samples: index after its last sample.
        piece: largest number of samples that the sinks receive at a time.

    Raises:
        InputError: the run is endless.
    """

    def __init__(self, cell: Cell, heard: Collection[str] | None = None) -> None:
        check_compiler()
        self._chunk = chunk_of(cell.master.shared.block_size, [cell.shortest_feedback or 0])
        # Whole chunks, and thus whole blocks: no sink receives a partial block.
        self.piece = MAX_BLOCK // self._chunk * self._chunk
        self._heard = _heard(cell, heard)
        self._take(cell)
        for stage in self._stages:
            compile_kernels(stage)
        wires = [wired(stage) for stage in self._stages]
        topics = {topic: (source.type, longest_delays(cell.inputs(topic))) for topic, source in cell.dense.items()}
        fields = {topic: list(messages.sample_fields(kind)) for topic, (kind, _) in topics.items()}
        # Joint states are generated from the samples of a stage's outputs.
        whole = self._heard.union(*(each.outputs for each in wires if each.stage.tells_joints))
        kept = {
            topic: [name for name in names if topic in whole or f"{topic}.{name}" in self._heard]
            for topic, names in fields.items()
        }
        self._kept = [{topic: kept[topic] for topic in each.outputs if kept[topic]} for each in wires]
        passing = [(topic, name) for topic, names in fields.items() for name in names if name not in kept[topic]]
        self._tapes = Tapes(topics, self.piece, passing, self._chunk)
        self._program = Program(wires, self._tapes, self._chunk)
        self._restart(cell)

    @property
    def reached(self) -> int:
        """Number of samples that all stages have computed."""
        return self._program.reached

    @property
    def past(self) -> dict[str, Signals]:
        """Samples before the one reached that delayed readers need, by relative topic and field (copies)."""
        return self._tapes.past(self._program.reached)

    def _take(self, cell: Cell) -> None:
        """Load the stages of a cell."""
        self.first, self.samples = cell.first, cell.samples
        self._wiring, self._block = cell.wiring, cell.master.shared.block_size
        self.stages, self._stages = cell.stages, list(cell.stages.values())
        for stage in self._stages:
            names = {remapped(stage.shared, topic): topic for topic in stage.sparse_topics}
            stage.unheard = {topic for name, topic in names.items() if name not in self._heard}

    def begin(self, cell: Cell, heard: Collection[str] | None = None) -> bool:
        """Restart with another cell, which must have passed its check.

        Returns:
            Whether the restart is possible: wiring, block size and requested topics must equal those of the previous
            cell.
        """
        block = cell.master.shared.block_size
        # Cells with equal ports share one `Wiring`, so that comparing identities suffices.
        if cell.wiring is not self._wiring or block != self._block or _heard(cell, heard) != self._heard:
            return False
        self._take(cell)
        self._restart(cell)
        return True

    def _restart(self, cell: Cell) -> None:
        """Start at the first sample of a cell."""
        self._tapes.restart(self.first, cell.begun.past if cell.begun else {})
        self._program.begin(self._stages, self.first)

    def run(self, sinks: Iterable[Sink], stops: Mapping[int, Callable[[], object]] = MappingProxyType({})) -> None:
        """Run the cell to completion.

        Args:
            sinks: receivers of the results.
            stops: functions to call when all samples before a given one have been computed.

        Raises:
            DivergedError: a requested sample is NaN or infinite; the message names the first.
            LatheError: a stage cannot continue.
        """
        # Freeze existing objects so that the garbage collector skips them.
        gc.freeze()
        try:
            # NaN and infinity are reported here, so NumPy's warnings are redundant.
            with np.errstate(over="ignore", invalid="ignore"):
                for _ in self.steps(list(sinks), stops):
                    pass
        finally:
            gc.unfreeze()

    def steps(
        self, sinks: Sequence[Sink], stops: Mapping[int, Callable[[], object]] = MappingProxyType({})
    ) -> Iterator[int]:
        """Run chunk by chunk, yielding the sample index after each chunk; raise the same errors as `run`."""
        while self.reached < self.samples:
            self.advance(min(self.reached + self.piece, self.samples), sinks, stops)
            yield self.reached

    def advance(
        self, end: int, sinks: Sequence[Sink], stops: Mapping[int, Callable[[], object]] = MappingProxyType({})
    ) -> None:
        """Compute the samples before ``end``, at most a `piece` after those reached; raise the same errors as `run`.

        Args:
            end: index after the last sample; if it is not the end of the run, the end of a block.
            sinks: see `run`.
            stops: see `run`.
        """
        first = self._program.reached
        self._tapes.advance(first)
        broken = False
        try:
            for stop in sorted({end, *(sample for sample in stops if first < sample < end)}):
                self._begun = self._program.reached
                broken = self._program.run(stop, finite=bool(sinks))
                if broken:
                    break
                if stop in stops:
                    stops[stop]()
        finally:
            # A chunk with a NaN or infinite sample is useless to sinks, unlike the samples before another error.
            if not broken:
                self._hand_over(first, self._program.reached, sinks)
        if broken:
            self._break_off()

    def _break_off(self) -> NoReturn:
        """Raise the error that a node would raise: it names the first NaN or infinite sample, in the newest chunk."""
        found: list[tuple[int, int, str]] = []
        end = self._program.reached
        first = self._begun + (end - 1 - self._begun) // self._chunk * self._chunk
        for topic, source in self._wiring.dense.items():
            for name, array in self._tapes.view(topic, first, end - first).items():
                try:
                    check_finite(f"/{source.node}", name, array, first)
                except NotFiniteError as error:
                    found.append((error.index, len(found), f"/{topic}: {error}"))
        raise DivergedError(min(found)[2])

    def _hand_over(self, first: int, end: int, sinks: Sequence[Sink]) -> None:
        """Pass a chunk to the sinks."""
        if first == end:
            return
        dense = _Kept[Signals]({})
        sparse: dict[str, list[Sparse]] = {}
        for number, (stage, kept) in enumerate(zip(self._stages, self._kept, strict=True)):
            outputs = [
                _Kept[Samples](self._tapes.view(topic, first, end - first, names=names), of=f"{topic}.")
                for topic, names in kept.items()
            ]
            dense.update(zip(kept, outputs, strict=True))
            # If a stage has failed, the stages before it have advanced further.
            said, last = self._program.said(number, end), end == self.samples
            if said or last or stage.tells_joints:
                for message in stage.conclude(first, end, said, outputs, last=last):
                    sparse.setdefault(remapped(stage.shared, message.topic), []).append(message)
        for sink in sinks:
            sink.chunk(first, end - first, dense, sparse)


class _Kept(dict[str, K]):
    """Signals kept for sinks, by name."""

    def __init__(self, content: Mapping[str, K], of: str = "") -> None:
        super().__init__(content)
        self._of = of

    def __missing__(self, name: str) -> NoReturn:
        raise KeyError(f"{self._of}{name} is not kept: `heard` of the sink has to name it")


def _heard(cell: Cell, heard: Collection[str] | None) -> frozenset[str]:
    """Return the topics and fields requested by the sinks of a cell (see `Engine`)."""
    return frozenset((*cell.dense, *cell.sparse) if heard is None else heard)
