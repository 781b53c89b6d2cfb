# SPDX-License-Identifier: Apache-2.0
"""The offline host for many cells at once: variations of one scenario, side by side in lanes."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from lathe_rc.cell.engine import Ports, chunk_size, delays
from lathe_rc.cell.messages import MAX_BLOCK, Signals, sample_fields
from lathe_rc.cell.parameters import remapped
from lathe_rc.cell.ring import Ring
from lathe_rc.cell.stages.lanes import LaneStage, lane_stage, same
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError

Array = npt.NDArray[np.float64]

_SAMPLES = 16384  #: in a chunk of all lanes, at most: more would not stay in the processor's memory


class LaneSink(Protocol):
    """What takes the results, chunk by chunk, in order."""

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals]) -> None:
        """Take the samples ``first`` on of every topic: arrays (n, lanes), or (n,) if they are equal in all lanes."""


class Lanes:
    """Steps cells at once that differ in numbers, not in structure; every lane gets the bits that it gets alone.

    Learning controllers (exponential Q, no correction, no identification), coarse drives, piezo drives with plays
    and the tool have kernels that go through the lanes as vectors; what is equal in all lanes runs once; the rest runs
    lane by lane. docs/performance.md has the figures.

    Args:
        cells: wired and checked, with the same nodes, ports and spindle.

    Attributes:
        samples: length of the run [sample].

    Raises:
        InputError: they differ in more than numbers, in the spindle, or have no end.
    """

    def __init__(self, cells: Sequence[Cell]) -> None:
        first = cells[0]
        if first.master.samples is None:
            raise InputError(f"{first.master.name}.revolutions = 0; lanes need an end: allowed above 0")
        self.samples: int = first.master.samples
        for lane, cell in enumerate(cells):
            _check(lane, first, cell)
        self._chunk = chunk_size(first, min(MAX_BLOCK, _SAMPLES // len(cells)))
        self._stages: dict[str, LaneStage[Any]] = {}
        rings: dict[str, Ring] = {}
        shared: set[str] = set()
        for name, stage in first.stages.items():
            topics = [remapped(stage.shared, port.topic) for port in stage.inputs]
            lanes = lane_stage([cell.stages[name] for cell in cells], shared=shared.issuperset(topics))
            for port in stage.outputs:
                topic, fields = remapped(stage.shared, port.topic), sample_fields(port.type)
                kept = delays(first, topic, port.type)
                rings[topic] = Ring(port.type, kept, self._chunk, len(cells), lanes.shared)
                if set(fields) <= set(lanes.shared):
                    shared.add(topic)
            self._stages[name] = lanes
        self._ports = {name: Ports(stage, rings, self._chunk) for name, stage in first.stages.items()}

    def run(self, sinks: Iterable[LaneSink] = ()) -> None:
        """Run to the end."""
        receivers = list(sinks)
        for first in range(0, self.samples, self._chunk):
            samples = min(self._chunk, self.samples - first)
            dense: dict[str, Signals] = {}
            for name, stage in self._stages.items():
                stage.process(first, *self._ports[name].open(first, samples, dense))
            for sink in receivers:
                sink.chunk(first, samples, dense)

    def curves(self) -> dict[str, tuple[Array, Array]]:
        """Learning curves so far, by controller: RMS and largest error of each cycle [m], shape (cycles, lanes)."""
        return {
            name: (np.array([rms for rms, _ in stage.curve]), np.array([largest for _, largest in stage.curve]))
            for name, stage in self._stages.items()
            if stage.curve
        }


def _check(lane: int, first: Cell, cell: Cell) -> None:
    if list(first.stages) != list(cell.stages):
        raise InputError(f"lane {lane} has the nodes {', '.join(cell.stages)}; allowed: {', '.join(first.stages)}")
    for name, stage in first.stages.items():
        other = cell.stages[name]
        if (stage.kind, stage.inputs, stage.outputs) != (other.kind, other.inputs, other.outputs):
            raise InputError(f"lane {lane}: {name} reads or writes otherwise than in lane 0; run it by itself")
        if stage.shared.remap != other.shared.remap or stage.shared.block_size != other.shared.block_size:
            raise InputError(f"lane {lane}: {name} has another remap or block_size than in lane 0; run it by itself")
    if not same(first.master.shared, cell.master.shared):
        raise InputError(f"lane {lane}: {first.master.name} differs from lane 0; lanes turn on one spindle")
