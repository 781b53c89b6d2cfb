# SPDX-License-Identifier: Apache-2.0
"""Reading bags of the cell back, whole."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lathe_rc import messages
from lathe_rc.bag.reading.stream import feed
from lathe_rc.cell.recording import Recording, SparseTopic
from lathe_rc.cell.stage import Sparse
from lathe_rc.messages import START_NS, Samples, Signals


class _Whole:
    """Keeps every piece; a sink."""

    def __init__(self) -> None:
        self.dense: dict[str, dict[str, list[Samples]]] = {}
        self.sparse: dict[str, list[Sparse]] = {}

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """See `lathe_rc.cell.engine.Sink`."""
        for topic, signals in dense.items():
            fields = self.dense.setdefault(topic, {name: [] for name in signals})
            for name, array in signals.items():
                fields[name].append(array)
        for topic, found in sparse.items():
            self.sparse.setdefault(topic, []).extend(found)


def read(path: Path) -> Recording:
    """All signal topics of a bag; memory for all of it is needed, see `lathe_rc.bag.reading.stream` otherwise.

    Example:
        >>> from pathlib import Path
        >>> from lathe_rc import harness, resources
        >>> from lathe_rc.bag import reader
        >>> from lathe_rc.cell import scenario
        >>> piston = scenario.load(resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=3"])
        >>> result = harness.run(piston, bag=Path("piston_bag"))
        >>> recording = reader.read(Path("piston_bag"))
        >>> recording.digests() == result.digest
        True
        >>> figure = recording.plot("three revolutions")
        >>> figure.savefig("piston.png")

    Raises:
        InputError: not a bag.
        LatheError: a block is missing or repeated.
    """
    whole = _Whole()
    header = feed(path, [whole])
    dense, sparse = {}, {}
    for topic, msgtype in header.types.items():
        if msgtype in messages.block_types():
            parts = whole.dense.get(topic, {})
            empty = messages.allocate(msgtype, 0)
            dense[topic] = {name: np.concatenate(parts.get(name) or [array]) for name, array in empty.items()}
        else:
            sparse[topic] = SparseTopic()
            for message in whole.sparse.get(topic, []):
                sparse[topic].append(START_NS + message.index * header.step_ns, message.values)
    samples = next((array.size for signals in dense.values() for array in signals.values()), 0)
    return Recording(header.types, dense, sparse, header.step_ns, header.samples - samples)
