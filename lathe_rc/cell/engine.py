# SPDX-License-Identifier: Apache-2.0
"""The offline host: all stages of a cell in one loop."""

import gc
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Protocol

from lathe_rc.cell.messages import MAX_BLOCK, Signals, sample_fields
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.stage import Sparse, Stage, compile_kernels
from lathe_rc.cell.track import Track, longest_delays
from lathe_rc.cell.wiring import Cell
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
        self._chunk = chunk_size(cell, MAX_BLOCK)
        tracks = {}
        for topic, source in cell.dense.items():
            tracks[topic] = Track(source.type, delays(cell, topic, source.type), self._chunk)
        self._stages = [
            (stage, Ports(stage, tracks), {topic: remapped(stage.shared, topic) for topic in stage.sparse_topics})
            for stage in cell.stages.values()
        ]
        for stage in cell.stages.values():
            compile_kernels(stage)

    def run(self, sinks: Iterable[Sink]) -> None:
        """Run to the end."""
        # What is there now stays: the garbage collector need not walk through it again and again.
        gc.freeze()
        try:
            for _ in self.steps(list(sinks)):
                pass
        finally:
            gc.unfreeze()

    def steps(self, sinks: Sequence[Sink]) -> Iterator[int]:
        """Run chunk by chunk; the sample index after each."""
        for first in range(0, self.samples, self._chunk):
            samples = min(self._chunk, self.samples - first)
            dense: dict[str, Signals] = {}
            sparse: dict[str, list[Sparse]] = {}
            for stage, ports, topics in self._stages:
                for message in stage.advance(first, *ports.open(first, samples, dense)):
                    sparse.setdefault(topics[message.topic], []).append(message)
            for sink in sinks:
                sink.chunk(first, samples, dense, sparse)
            yield first + samples


def chunk_size(cell: Cell, most: int) -> int:
    """Samples to compute at a time: whole blocks, as many as the feedback allows and ``most`` holds, at least one."""
    block = cell.master.shared.block_size
    return max(block, min(cell.shortest_feedback or most, most) // block * block)


def delays(cell: Cell, topic: str, msgtype: str) -> dict[str, int]:
    """Longest delay [sample] at which each field of a topic is read; 0 where it is not."""
    return dict.fromkeys(sample_fields(msgtype), 0) | longest_delays(cell.inputs(topic))


class Ports:
    """The tracks that a stage reads and writes.

    Args:
        stage: the stage.
        tracks: of all dense topics, by relative name.
    """

    def __init__(self, stage: Stage, tracks: Mapping[str, Track]) -> None:
        self._inputs = [(tracks[remapped(stage.shared, port.topic)], port.delay) for port in stage.inputs]
        topics = [remapped(stage.shared, port.topic) for port in stage.outputs]
        self._outputs = [(topic, tracks[topic]) for topic in topics]

    def open(self, first: int, samples: int, dense: dict[str, Signals]) -> tuple[list[Signals], list[Signals]]:
        """Inputs and outputs of the samples ``first`` on; the outputs are added to ``dense`` too."""
        inputs = [track.view(first - delay, samples) for track, delay in self._inputs]
        outputs = []
        for topic, track in self._outputs:
            dense[topic] = track.extend(samples)
            outputs.append(dense[topic])
        return inputs, outputs
