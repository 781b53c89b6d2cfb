# SPDX-License-Identifier: Apache-2.0
"""The offline host: all stages of a cell in one loop."""

from collections.abc import Iterable, Mapping
from typing import Protocol

from lathe_rc.cell.messages import MAX_BLOCK, Signals, sample_fields
from lathe_rc.cell.stage import Sparse, Stage, compile_kernels
from lathe_rc.cell.track import Track
from lathe_rc.cell.wiring import Cell, remapped
from lathe_rc.errors import InputError


class Sink(Protocol):
    """What takes the results of a run, chunk by chunk, in order."""

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Take the samples ``first`` on of every topic and the sparse messages among them, by relative topic."""


class Engine:
    """Runs a cell as fast as it goes.

    It computes in chunks as long as the shortest feedback allows, whatever ``block_size`` says: no bit depends on
    that, and chunks that are whole numbers of blocks can be cut into the messages of any other host.

    Args:
        cell: the wired cell; must have passed its check.

    Raises:
        InputError: the run has no end.
    """

    def __init__(self, cell: Cell) -> None:
        if cell.master.samples is None:
            raise InputError(f"{cell.master.name}.revolutions = 0; an offline run needs an end: allowed above 0")
        self.samples: int = cell.master.samples
        self._cell = cell
        block = cell.master.shared.block_size
        self._chunk = max(block, min(cell.shortest_feedback or MAX_BLOCK, MAX_BLOCK) // block * block)
        self._tracks = {
            topic: Track(source.type, sample_fields(source.type), cell.longest_delay(topic), self._chunk)
            for topic, source in cell.dense.items()
        }
        for stage in cell.stages.values():
            compile_kernels(stage)

    def run(self, sinks: Iterable[Sink]) -> None:
        """Run to the end."""
        receivers = list(sinks)
        for first in range(0, self.samples, self._chunk):
            samples = min(self._chunk, self.samples - first)
            dense: dict[str, Signals] = {}
            sparse: dict[str, list[Sparse]] = {}
            for stage in self._cell.stages.values():
                self._advance(stage, first, samples, dense, sparse)
            for sink in receivers:
                sink.chunk(first, samples, dense, sparse)

    def _advance(
        self,
        stage: Stage,
        first: int,
        samples: int,
        dense: dict[str, Signals],
        sparse: dict[str, list[Sparse]],
    ) -> None:
        inputs = [
            self._tracks[remapped(stage.shared, port.topic)].view(first - port.delay, samples) for port in stage.inputs
        ]
        outputs = []
        for port in stage.outputs:
            topic = remapped(stage.shared, port.topic)
            dense[topic] = self._tracks[topic].extend(samples)
            outputs.append(dense[topic])
        for message in stage.advance(first, inputs, outputs):
            sparse.setdefault(remapped(stage.shared, message.topic), []).append(message)
