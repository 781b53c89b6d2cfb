# SPDX-License-Identifier: Apache-2.0
"""In-memory storage of the signals of an offline run."""

import contextlib
import math
import os
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from lathe_rc import messages
from lathe_rc.blocks.block import Framer
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.recording import Recording, SparseTopic
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError
from lathe_rc.messages import Signals
from lathe_rc.names import instead

_ALIGNED = 64  # begin of an array in the block [B]


def _free_memory() -> float:
    """Return the memory available without swapping [B], else the total memory; infinity: Windows tells neither."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            name, _, size = line.partition(":")
            if name == "MemAvailable":
                return int(size.split()[0]) * 1024
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else math.inf


def check_room(cell: Cell) -> None:
    """Check that this computer has enough memory for all signals, which form errors and digests need.

    Raises:
        InputError: there is not enough memory; the message states the memory required and available, and the longest
            possible run.
    """
    fields = [messages.sample_fields(source.type).values() for source in cell.dense.values()]
    needed = cell.expected_samples * sum(np.dtype(kind).itemsize for kinds in fields for kind in kinds)
    free, master = _free_memory(), cell.master
    if needed > free:
        turns = master.parameters.revolutions
        most = turns * free / needed
        most_said = f"{math.floor(most)}" if most > 10.0 else f"{most:.2g}"
        raise InputError(
            f"{master.name}.revolutions = {turns:g}: {cell.expected_samples:.4g} samples of all signals take "
            f"{needed / 2**30:,.1f} GiB of memory, {free / 2**30:,.1f} GiB are free; allowed: up to "
            f"{most_said} here (nodes that lathe node or launch starts keep no signals)"
        )


def _allocated(types: Mapping[str, str], samples: int) -> dict[str, Signals]:
    """Return zeroed arrays by topic and field, as parts of one block, given the message types by topic."""
    fields = [(topic, *field) for topic, kind in types.items() for field in messages.sample_fields(kind).items()]
    sizes = [-(-samples * dtype.itemsize // _ALIGNED) * _ALIGNED for *_, dtype in fields]
    block = np.empty(sum(sizes), np.uint8)
    # Touches the memory now: page faults would take 25 % of the run, and those of many arrays take 3 to 10 times as
    # long as those of one block, which large pages serve.
    block.fill(0)
    found: dict[str, Signals] = {topic: {} for topic in types}
    for (topic, name, dtype), begin in zip(fields, np.cumsum([0, *sizes]), strict=False):
        found[topic][name] = block[begin:][: samples * dtype.itemsize].view(dtype)
    return found


class Collector:
    """Collector of complete signals; a sink of the engine.

    Args:
        cell: the running cell.
        samples: number of samples to collect.
        topics: relative names of the topics to collect; None: all.
        first: index of the first sample.

    Raises:
        InputError: the cell has no such topic.
    """

    def __init__(self, cell: Cell, samples: int, topics: Collection[str] | None = None, first: int = 0) -> None:
        self._first = first
        known = {**cell.dense, **cell.sparse}
        self._sources = known if topics is None else {topic: known[topic] for topic in topics if topic in known}
        if missing := [topic for topic in topics or () if topic not in known]:
            raise InputError(f"no topic {missing[0]!r} in the cell; {instead(missing[0], known)}")
        self._step_ns = cell.master.shared.step_ns
        self._framer = Framer("", "", self._step_ns)
        types = {topic: source.type for topic, source in self._sources.items() if topic in cell.dense}
        self._dense = _allocated(types, samples)
        self._sparse: dict[str, list[Sparse]] = {topic: [] for topic in self._sources if topic in cell.sparse}

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Process a chunk of the run, as a sink of the engine."""
        for topic, whole in self._dense.items():
            for name, array in dense[topic].items():
                whole[name][first - self._first :][:samples] = array
        for topic, kept in self._sparse.items():
            kept.extend(sparse.get(topic, ()))

    def recording(self) -> Recording:
        """Return a recording of the collected signals, by fully qualified topic."""
        sparse = {}
        for topic, found in self._sparse.items():
            part = sparse[f"/{topic}"] = SparseTopic()
            for message in found:
                framed = self._framer.sparse(message)
                part.add(messages.stamp_ns(framed), framed)
        types = {f"/{topic}": source.type for topic, source in self._sources.items()}
        dense = {f"/{topic}": signals for topic, signals in self._dense.items()}
        return Recording(types, dense, sparse, self._step_ns, self._first)
