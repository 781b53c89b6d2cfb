# SPDX-License-Identifier: Apache-2.0
"""Checking the signals of an offline run, and keeping them in memory."""

from collections.abc import Collection, Mapping

import numpy as np

from lathe_rc.cell import messages
from lathe_rc.cell.framing import Framer
from lathe_rc.cell.messages import Samples, Signals
from lathe_rc.cell.recording import Recording, SparseTopic
from lathe_rc.cell.stage import Sparse
from lathe_rc.cell.wire import NotFiniteError, check_finite
from lathe_rc.cell.wiring import Cell
from lathe_rc.errors import InputError, LatheError
from lathe_rc.jit import kernel


@kernel
def _not_finite(samples: Samples) -> int:
    """How many samples are NaN or infinite."""
    count = 0
    for k in range(samples.size):
        count += not abs(samples[k]) < np.inf
    return count


class Finite:
    """Ends a run with numbers that are not finite, as nodes end theirs; a sink of the engine, the first."""

    def __init__(self, cell: Cell) -> None:
        self._sources = {topic: f"/{source.node}" for topic, source in cell.dense.items()}

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`.

        Raises:
            LatheError: a sample is NaN or infinite; names the first.
        """
        if not any(
            array.dtype == np.float64 and _not_finite(array) for signals in dense.values() for array in signals.values()
        ):
            return
        found: list[tuple[int, int, str]] = []
        for topic, signals in dense.items():
            for name, array in signals.items():
                try:
                    check_finite(self._sources[topic], name, array, first)
                except NotFiniteError as error:
                    found.append((error.index, len(found), f"/{topic}: {error}"))
        raise LatheError(min(found)[2])


class Collector:
    """Collects whole arrays; a sink of the engine.

    Args:
        cell: that runs.
        samples: of the run.
        topics: relative names of those to collect; None: all.

    Raises:
        InputError: the cell has no such topic.
    """

    def __init__(self, cell: Cell, samples: int, topics: Collection[str] | None = None) -> None:
        known = {**cell.dense, **cell.sparse}
        self._sources = known if topics is None else {topic: known[topic] for topic in topics if topic in known}
        if missing := [topic for topic in topics or () if topic not in known]:
            raise InputError(f"no topic {missing[0]!r} in the cell; allowed: {', '.join(known)}")
        self._step_ns = cell.master.shared.step_ns
        self._framer = Framer("", "", self._step_ns)
        self._dense = {
            topic: messages.allocate(source.type, samples)
            for topic, source in self._sources.items()
            if topic in cell.dense
        }
        for signals in self._dense.values():
            for array in signals.values():
                array.fill(0)  # touches the memory now: page faults would cost a quarter of the run
        self._sparse: dict[str, list[Sparse]] = {topic: [] for topic in self._sources if topic in cell.sparse}

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        for topic, whole in self._dense.items():
            for name, array in dense[topic].items():
                whole[name][first : first + samples] = array
        for topic, kept in self._sparse.items():
            kept.extend(sparse.get(topic, ()))

    def recording(self) -> Recording:
        """What was collected, by fully qualified topic."""
        sparse = {}
        for topic, found in self._sparse.items():
            part = sparse[f"/{topic}"] = SparseTopic()
            for message in found:
                framed = self._framer.sparse(message)
                part.add(messages.stamp_ns(framed), framed)
        types = {f"/{topic}": source.type for topic, source in self._sources.items()}
        dense = {f"/{topic}": signals for topic, signals in self._dense.items()}
        return Recording(types, dense, sparse, self._step_ns)
