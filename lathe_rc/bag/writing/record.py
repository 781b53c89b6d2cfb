# SPDX-License-Identifier: Apache-2.0
"""Recording of an offline run with the same messages, in the same order, as for a cell of ROS nodes."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lathe_rc import messages
from lathe_rc.bag import provenance
from lathe_rc.bag.snapshot import GONE_ON
from lathe_rc.bag.writing.order import Merger
from lathe_rc.bag.writing.writer import BagWriter, Both, MessageSink, offered_qos
from lathe_rc.blocks.block import Framer
from lathe_rc.blocks.ports import Sparse, signal_depth
from lathe_rc.cell.recorder import RecorderParameters
from lathe_rc.cell.scenario import Scenario
from lathe_rc.cell.wiring import Cell
from lathe_rc.messages import Signals

if TYPE_CHECKING:
    from lathe_rc.bag.writing.snapshots import Snapshots


def bag_of(path: Path, table: RecorderParameters, snapshots: "Snapshots | None") -> MessageSink:
    """Create the output of a recorder: the bag of the whole run (unless disabled), the snapshots, or both.

    Raises:
        InputError: the folder exists or cannot be created.
    """
    if snapshots is not None and table.mode == "snapshot":
        return snapshots
    bag = BagWriter(path, compression=table.compression, chunk_size=table.chunk_size, about={})
    split(bag, table.split_duration)
    return bag if snapshots is None else Both(bag, snapshots)


def split(output: MessageSink, duration: float) -> None:
    """Set the simulated time [s] after which the bag of a whole run goes on in another file; 0: one file."""
    bag = output.first if isinstance(output, Both) else output
    if isinstance(bag, BagWriter):
        bag.split_ns = round(duration * 1e9)


def begin(path: Path, scenario: Scenario, snapshots: "Snapshots | None" = None) -> MessageSink:
    """Create the bag of an offline run of a scenario, with the settings of its recorder.

    Args:
        path: folder of the bag.
        scenario: scenario of the run.
        snapshots: result of `begin_snapshots`; None: the whole run is recorded, whatever the scenario specifies.

    Raises:
        InputError: the folder exists or cannot be created.
    """
    output = bag_of(path, scenario.recorder[1], snapshots)
    output.tell(provenance.tell(scenario, []))
    return output


def begin_snapshots(path: Path, scenario: Scenario, cell: Cell) -> "Snapshots | None":
    """Create the snapshot output of a scenario's recorder, whose bag is at ``path``; None without snapshots.

    Raises:
        InputError: see `Snapshots` and its `prepare`.
    """
    name, table = scenario.recorder
    if table.mode == "continuous":
        return None
    from lathe_rc.bag.writing.snapshots import Snapshots

    snapshots = Snapshots(table.snapshots_of(path), table, name=name)
    snapshots.prepare(_dense(cell), list(cell.stages))
    return snapshots


def _dense(cell: Cell) -> dict[str, tuple[str, str]]:
    """Return the message type and source of each dense topic, by fully qualified name."""
    return {f"/{topic}": (source.type, f"/{source.node}") for topic, source in cell.dense.items()}


class OfflineRecorder:
    """Recorder of an offline run that divides the engine's chunks into blocks; a sink of the engine.

    Args:
        cell: the running cell.
        samples: index after the last sample of the run.
        writer: writer of the bag.
        snapshots: snapshot output instead of or in addition to the bag, if any.
        first: index of the first sample.
    """

    def __init__(
        self, cell: Cell, samples: int, writer: MessageSink, snapshots: "Snapshots | None" = None, first: int = 0
    ) -> None:
        shared = cell.master.shared
        self._snapshots = snapshots
        self._cell, self._samples, self._writer = cell, samples, writer
        self._block, self._step_ns = shared.block_size, shared.step_ns
        self._framers = {name: Framer(shared.run_id, f"/{name}", shared.step_ns) for name in cell.stages}
        qos = offered_qos(signal_depth(shared.window), "transient_local")
        for topic, source in sorted({**cell.dense, **cell.sparse}.items()):
            writer.add_topic(f"/{topic}", source.type, qos)

        self._merger = Merger(
            writer,
            _dense(cell),
            {f"/{topic}": f"/{source.node}" for topic, source in cell.sparse.items()},
            run_id=shared.run_id,
            step_ns=shared.step_ns,
            samples=shared.block_size,
            first=first,
        )
        if first:
            writer.tell({GONE_ON: str(first)})

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Divide a chunk into blocks and write the blocks."""
        ends = first + np.minimum(np.arange(self._block, samples + self._block, self._block), samples)
        before = {name: framer.companions for name, framer in self._framers.items()}
        sent: dict[str, list[int]] = {}  # sample indices of each node's sparse messages
        for topic, found in sparse.items():
            node = self._cell.sparse[topic].node
            for message in found:
                framed = self._framers[node].sparse(message)
                self._merger.add_sparse(f"/{topic}", messages.stamp_ns(framed), messages.encode(message.type, framed))
            sent.setdefault(node, []).extend(message.index for message in found)
        for topic, signals in dense.items():
            node = self._cell.dense[topic].node
            companions = before[node] + np.searchsorted(np.sort(sent.get(node, [])), ends)
            last = first + samples == self._samples
            self._merger.add_blocks(f"/{topic}", first, signals, companions, last=last)
        self._merger.release()

    def close(self) -> None:
        """End the recording, including that of an interrupted run.

        Raises:
            LatheError: writing to the disk fails.
        """
        try:
            if self._snapshots is not None and not self._merger.complete:
                self._snapshots.interrupt("interrupted")
        finally:
            self._writer.close()
