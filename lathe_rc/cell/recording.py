# SPDX-License-Identifier: Apache-2.0
"""The signals of a whole run, from whatever host, and their digests."""

import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lathe_rc import messages
from lathe_rc.cell.stage import Sparse
from lathe_rc.messages import NOT_SIGNALS, START_NS, Samples, Signals

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from lathe_rc.analysis.metrology import FormErrors

_PIECE = 2**15  # samples that are hashed in one go


@dataclass(frozen=True)
class SparseTopic:
    """Messages at chosen samples: time stamps [ns] and, by field, one value a message."""

    stamps: list[int] = field(default_factory=list)
    values: dict[str, list[Any]] = field(default_factory=dict)

    def add(self, stamp: int, message: Any) -> None:
        """Append a message."""
        self.append(stamp, {name: value for name, value in vars(message).items() if name not in NOT_SIGNALS})

    def append(self, stamp: int, values: Mapping[str, Any]) -> None:
        """Append the values of a message."""
        self.stamps.append(stamp)
        for name, value in values.items():
            self.values.setdefault(name, []).append(value)


@dataclass(frozen=True, repr=False)
class Recording:
    """All signal topics of a run.

    Attributes:
        types: message type by fully qualified topic.
        dense: by fully qualified topic, the arrays of each field, shape (samples,).
        sparse: by fully qualified topic.
        step_ns: sampling step [ns]; 0 without a dense topic.
        first: sample that the arrays begin with; 0 but in a snapshot.

    Example:
        >>> from pathlib import Path
        >>> from lathe_rc import harness, resources
        >>> from lathe_rc.cell import scenario
        >>> piston = scenario.load(resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=3"])
        >>> recording = harness.run(piston).recording
        >>> recording
        <Recording: 9 topics, 10785 samples (0.169 s), 3 revolutions, form error 150.8 to 1.166 µm RMS>
        >>> print(f"{recording.dense['/tool']['error'].min() * 1e6:.1f} µm")
        -232.7 µm
        >>> recording.sparse["/coarse/learning"].values["cycle"]
        [1, 2]
    """

    types: Mapping[str, str]
    dense: Mapping[str, Signals]
    sparse: Mapping[str, SparseTopic]
    step_ns: int
    first: int = 0

    def __repr__(self) -> str:
        """What it holds, in a line."""
        size = f"{self.samples} samples ({self.samples * self.step_ns * 1e-9:.3g} s)"
        return f"<Recording: {', '.join([f'{len(self.types)} topics', size, *self.errors.told()])}>"

    def _repr_html_(self) -> str:
        """Its topics as a table, for notebooks."""
        from lathe_rc.view import notebook

        return notebook.recording(self)

    @property
    def samples(self) -> int:
        """Of each dense topic."""
        return next((array.size for signals in self.dense.values() for array in signals.values()), 0)

    @cached_property
    def errors(self) -> "FormErrors":
        """Form error of each complete revolution; of none if there is no tool."""
        from lathe_rc.analysis.metrology import form_errors, turns_before

        if not {messages.ENCODER, messages.TOOL} <= {self.types[topic] for topic in self.dense}:
            return form_errors(np.empty(0), np.empty(0))
        angle = self.of_type(messages.ENCODER)["angle_true"]
        return form_errors(angle, self.of_type(messages.TOOL)["error"], turns_before(angle))

    def frame(self, topic: str) -> Any:
        """A topic as a table: a row a sample, or a message; see `lathe_rc.frames.frame`."""
        from lathe_rc import frames

        return frames.frame(self, topic)

    def plot(self, title: str = "") -> "Figure":
        """Desired form, form error over angle, form error by revolution; see `lathe_rc.view.figure.draw`."""
        from lathe_rc.view import figure

        return figure.draw(self, title)

    def messages(self, topic: str) -> list[Sparse]:
        """The messages of a sparse topic, by its fully qualified name."""
        found, kind = self.sparse[topic], self.types[topic]
        rows = [dict(zip(found.values, row, strict=True)) for row in zip(*found.values.values(), strict=True)]
        places = [(stamp - START_NS) // self.step_ns for stamp in found.stamps]
        return [Sparse(topic, kind, index, values) for index, values in zip(places, rows, strict=True)]

    def of_type(self, msgtype: str) -> Signals:
        """The signals of the first topic of a block type."""
        return next(signals for topic, signals in self.dense.items() if self.types[topic] == msgtype)

    def digests(self) -> dict[str, str]:
        """One digest for each signal topic, by topic.

        It is the SHA-256 of the SHA-256 of each field's samples in the order of the fields, little-endian; of sparse
        topics the time stamps come first. Blocks leave no trace in it.
        """
        digester = Digester()
        for topic, signals in self.dense.items():
            digester.dense(topic, signals)
        return digester.result(self.sparse)


class Digester:
    """Digests of a run whose signals come in pieces; see `Recording.digests`.

    A thread makes them: it needs no interpreter for it, so whoever brings the pieces computes on.
    """

    def __init__(self) -> None:
        self._topics: dict[str, _Topic] = {}
        self._thread = ThreadPoolExecutor(1)

    def dense(self, topic: str, signals: Signals) -> None:
        """Take the next samples of a dense topic, arrays of shape (n,) by field; they are copied."""
        found = self._topics.get(topic)
        if found is None:
            found = self._topics[topic] = _Topic(signals, self._thread)
        found.add(signals)

    def result(self, sparse: Mapping[str, SparseTopic]) -> dict[str, str]:
        """One digest for each topic, the sparse ones whole."""
        found = {topic: part.digests() for topic, part in self._topics.items()}
        for topic, part in sparse.items():
            arrays = [np.array(part.stamps, dtype=np.int64), *map(_flat, part.values.values())]
            found[topic] = [hashlib.sha256(_bytes(array)).digest() for array in arrays]
        return {topic: hashlib.sha256(b"".join(parts)).hexdigest() for topic, parts in sorted(found.items())}


class _Topic:
    """Digests of the fields of a dense topic.

    Args:
        signals: some of its samples.
        thread: makes them.
    """

    def __init__(self, signals: Signals, thread: ThreadPoolExecutor) -> None:
        self._hashes = [hashlib.sha256() for _ in signals]
        self._filled, self._hashed = (
            [np.empty(0, array.dtype.newbyteorder("<")) for array in signals.values()] for _ in range(2)
        )
        self._size = 0
        self._thread = thread
        self._at_work: Future[None] | None = None

    def add(self, signals: Signals) -> None:
        """Take the next samples."""
        arrays = list(signals.values())
        start, size = 0, arrays[0].size
        while start < size:
            end = min(size, start + _PIECE - self._size)
            stop = self._size + end - start
            if stop > self._filled[0].size:  # a topic with few samples takes little memory
                self._filled = [np.resize(piece, min(2 * stop, _PIECE)) for piece in self._filled]
            for piece, array in zip(self._filled, arrays, strict=True):
                piece[self._size : stop] = array[start:end]
            start, self._size = end, stop
            if stop == _PIECE:
                self._hand_over()

    def _hand_over(self) -> None:
        self._wait()
        self._filled, self._hashed = self._hashed, self._filled
        self._at_work = self._thread.submit(self._hash, self._size)
        self._size = 0

    def _wait(self) -> None:
        if self._at_work is not None:
            self._at_work.result()

    def _hash(self, size: int) -> None:
        for made, piece in zip(self._hashes, self._hashed, strict=True):
            made.update(piece[:size].data)

    def digests(self) -> list[bytes]:
        """Of each field, to the last sample."""
        self._hand_over()
        self._wait()
        return [made.digest() for made in self._hashes]


def _bytes(samples: Samples) -> memoryview:
    return np.ascontiguousarray(samples, samples.dtype.newbyteorder("<")).data


def _flat(values: Sequence[Any]) -> Samples:
    """One array of a field's values: numbers end to end, texts as their bytes with an end mark."""
    parts = []
    for value in values:
        for item in value if isinstance(value, list) else [value]:
            text = isinstance(item, str)
            parts.append(np.frombuffer(f"{item}\0".encode(), np.uint8) if text else np.atleast_1d(item))
    return np.concatenate(parts) if parts else np.empty(0)
