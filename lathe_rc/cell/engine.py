# SPDX-License-Identifier: Apache-2.0
"""The offline host: all stages of a cell in one loop."""

import gc
from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import lcm
from typing import Protocol

import numpy as np

from lathe_rc.cell.messages import MAX_BLOCK, Signals, sample_fields
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.ring import Ring
from lathe_rc.cell.stage import Sparse, Stage, compile_kernels
from lathe_rc.cell.track import longest_delays
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
        rings = {
            topic: Ring(source.type, delays(cell, topic, source.type), self._chunk)
            for topic, source in cell.dense.items()
        }
        self._stages = []
        for stage in cell.stages.values():
            said = {topic: remapped(stage.shared, topic) for topic in stage.sparse_topics}
            self._stages.append((stage, Ports(stage, rings, self._chunk), said))
            compile_kernels(stage)

    def run(self, sinks: Iterable[Sink]) -> None:
        """Run to the end."""
        # What is there now stays: the garbage collector need not walk through it again and again.
        gc.freeze()
        try:
            # What is not finite is named by a sink, see `lathe_rc.cell.collect.Finite`; NumPy need not warn of it too.
            with np.errstate(over="ignore", invalid="ignore"):
                for _ in self.steps(list(sinks)):
                    pass
        finally:
            gc.unfreeze()

    def steps(self, sinks: Sequence[Sink]) -> Iterator[int]:
        """Run chunk by chunk; the sample index after each."""
        for first in range(0, self.samples, self._chunk):
            samples = min(self._chunk, self.samples - first)
            last = first + samples == self.samples
            dense: dict[str, Signals] = {}
            sparse: dict[str, list[Sparse]] = {}
            for stage, ports, topics in self._stages:
                for message in stage.advance(first, *ports.open(first, samples, dense), last=last):
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
    """The rings that a stage reads and writes.

    Args:
        stage: the stage.
        rings: of all dense topics, by relative name.
        chunk: length of their chunks [sample].
    """

    def __init__(self, stage: Stage, rings: Mapping[str, Ring], chunk: int) -> None:
        self._inputs = [(rings[remapped(stage.shared, port.topic)], port.delay) for port in stage.inputs]
        self._outputs = {topic: rings[topic] for topic in (remapped(stage.shared, p.topic) for p in stage.outputs)}
        self._chunk = chunk
        self._period = lcm(*(ring.period for ring, _ in self._inputs), *(r.period for r in self._outputs.values()))
        self._steady = not any(delay % chunk for _, delay in self._inputs)  # only views, and the same ones again
        self._opened: dict[int, tuple[list[Signals], dict[str, Signals], list[Signals]]] = {}

    def open(self, first: int, samples: int, dense: dict[str, Signals]) -> tuple[list[Signals], list[Signals]]:
        """Inputs and outputs of the chunk that begins at ``first``; the outputs are added to ``dense`` too."""
        phase = first // samples % self._period if self._steady and samples == self._chunk else -1
        opened = self._opened.get(phase)
        if opened is None:
            opened = self._views(first, samples)
            if phase >= 0:
                self._opened[phase] = opened
        inputs, topics, outputs = opened
        dense.update(topics)
        return inputs, outputs

    def _views(self, first: int, samples: int) -> tuple[list[Signals], dict[str, Signals], list[Signals]]:
        """Inputs and outputs, these by topic too."""
        inputs = [ring.view(first, samples, delay) for ring, delay in self._inputs]
        topics = {topic: ring.newest(first, samples) for topic, ring in self._outputs.items()}
        return inputs, topics, list(topics.values())
