# SPDX-License-Identifier: Apache-2.0
"""Reading of a cell's bags into memory, as recordings."""

import os
from collections.abc import Mapping
from pathlib import Path

from lathe_rc import messages
from lathe_rc.bag.reading.source import BagSource
from lathe_rc.bag.reading.stream import ALL, feed
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.recording import Recording, SparseTopic
from lathe_rc.errors import LatheError, shown
from lathe_rc.messages import START_NS, Signals


class _Whole:
    """Sink that keeps the signals of a whole bag, which it receives as one chunk."""

    def __init__(self) -> None:
        self.dense: Mapping[str, Signals] = {}
        self.sparse: Mapping[str, list[Sparse]] = {}

    def chunk(self, first: int, samples: int, dense: Mapping[str, Signals], sparse: Mapping[str, list[Sparse]]) -> None:
        """Keep the chunk."""
        del first, samples
        self.dense, self.sparse = dense, sparse


def read_bag(path: str | os.PathLike[str], *, whole: bool = False) -> Recording:
    """Read all signal topics of a bag into memory; `lathe_rc.bag.reading.stream` reads longer bags in chunks.

    If members of the cell were lost, the recording ends there, and its ``lost`` gives the reason: later samples are
    held, or may rest on held ones.
    In a bag without blocks, the stamps of messages are their log times.

    Args:
        path: path of the bag.
        whole: whether reading continues after the loss of a member, up to the end of the safe state.

    Example:
        >>> import lathe_rc
        >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=3"])
        >>> result = lathe_rc.run(piston, bag="piston_bag")
        >>> recording = lathe_rc.read_bag("piston_bag")
        >>> recording.digests() == result.digest
        True
        >>> figure = recording.plot("three revolutions")
        >>> figure.savefig("piston.png")

    Raises:
        InputError: the path is not a bag.
        LatheError: a block is missing or repeated.
    """
    found = _Whole()
    header = feed(Path(path), [found], piece=ALL, whole=whole)
    dense: dict[str, Signals] = {}
    sparse: dict[str, SparseTopic] = {}
    for topic, msgtype in header.types.items():
        if msgtype in messages.block_types():
            dense[topic] = found.dense.get(topic) or messages.allocate(msgtype, 0)
        else:
            sparse[topic] = SparseTopic()
            for message in found.sparse.get(topic, ()):
                sparse[topic].append(START_NS + message.index * header.step_ns, message.values)
    if not dense and sparse:  # without blocks, the log states the times
        with BagSource(Path(path)) as source:
            for topic, log_ns, data in source.messages(set(sparse)):
                try:
                    sparse[topic].append(log_ns, messages.values_of(header.types[topic], data))
                except ValueError as error:
                    raise LatheError(f"{path}: {topic}: at {log_ns} ns: {shown(error)}") from None
    samples = next((array.size for signals in dense.values() for array in signals.values()), 0)
    lost = str(header.loss or "")
    return Recording(header.types, dense, sparse, header.step_ns, header.samples - samples, lost)
