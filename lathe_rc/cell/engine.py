# SPDX-License-Identifier: Apache-2.0
"""The offline host: all stages of a cell in one program."""

import gc
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np

from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.program import Program, Tapes, chunk_of, wired
from lathe_rc.cell.stage import Sparse, compile_kernels
from lathe_rc.cell.track import longest_delays
from lathe_rc.cell.wiring import Cell
from lathe_rc.messages import MAX_BLOCK, Signals


class Sink(Protocol):
    """A sink for the results of a run, piece by piece, in order."""

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Take the samples ``first`` on of every topic and the sparse messages among them, by relative topic."""


class Engine:
    """Runs a cell as fast as it goes.

    A stage computes as much in one go as the shortest feedback allows, whatever ``block_size`` says; sinks get whole
    numbers of blocks, which can be cut into the messages of any other host. No bit depends on either.

    Args:
        cell: the wired cell; must have passed its check.
        heard: topics whose sparse messages the sinks take; None: all.

    Raises:
        InputError: the run has no end.
    """

    def __init__(self, cell: Cell, heard: Collection[str] | None = None) -> None:
        self.samples = cell.samples
        self._stages = list(cell.stages.values())
        if heard is not None:
            for stage in self._stages:
                stage.unheard = {topic for topic in stage.sparse_topics if remapped(stage.shared, topic) not in heard}
        chunk = chunk_of(cell.master.shared.block_size, [cell.shortest_feedback or 0])
        self._piece = MAX_BLOCK // chunk * chunk
        topics = {topic: (source.type, longest_delays(cell.inputs(topic))) for topic, source in cell.dense.items()}
        self._tapes = Tapes(topics, self._piece)
        for stage in self._stages:
            compile_kernels(stage)
        self._wired = [wired(stage) for stage in self._stages]
        self._program = Program(self._wired, self._tapes, chunk)

    def run(self, sinks: Iterable[Sink]) -> None:
        """Run to the end."""
        # Freeze existing objects so that the garbage collector skips them.
        gc.freeze()
        try:
            # What is not finite is named by a sink, see `lathe_rc.cell.collect.Finite`; NumPy need not warn of it too.
            with np.errstate(over="ignore", invalid="ignore"):
                for _ in self.steps(list(sinks)):
                    pass
        finally:
            gc.unfreeze()

    def steps(self, sinks: Sequence[Sink]) -> Iterator[int]:
        """Run piece by piece; the sample index after each."""
        for first in range(0, self.samples, self._piece):
            self._tapes.advance(first)
            try:
                self._program.run(min(first + self._piece, self.samples))
            finally:
                self._hand_over(first, self._program.reached, sinks)
            yield self._program.reached

    def _hand_over(self, first: int, end: int, sinks: Sequence[Sink]) -> None:
        """Give a piece to the sinks."""
        if first == end:
            return
        dense: dict[str, Signals] = {}
        sparse: dict[str, list[Sparse]] = {}
        for number, (stage, _, topics) in enumerate(self._wired):
            outputs = [self._tapes.view(topic, first, end - first) for topic in topics]
            dense.update(zip(topics, outputs, strict=True))
            # Where a stage has failed, those before it have gone on.
            said = self._program.said(number, end)
            for message in stage.conclude(first, said, outputs, last=end == self.samples):
                sparse.setdefault(remapped(stage.shared, message.topic), []).append(message)
        for sink in sinks:
            sink.chunk(first, end - first, dense, sparse)
