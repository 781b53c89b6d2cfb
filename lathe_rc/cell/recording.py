# SPDX-License-Identifier: Apache-2.0
"""Recording of all signals of a run, independent of the host, and the digests of a recording."""

import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lathe_rc import messages
from lathe_rc.blocks.columns import Column, columns, dense_rows, sparse_rows
from lathe_rc.blocks.ports import Sparse
from lathe_rc.cell.running_form import RunningForm
from lathe_rc.cell.soundness import Soundness
from lathe_rc.drawing import html
from lathe_rc.errors import InputError
from lathe_rc.messages import START_NS, Samples, Signals, full, signals_of
from lathe_rc.signals.form_errors import FormErrors, turns_at_end, turns_before
from lathe_rc.signals.zones import Zone

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from lathe_rc.drawing.form import TurnedForm

_PIECE = 2**15  # samples per hash update


@dataclass(frozen=True)
class SparseTopic:
    """Messages at individual samples: time stamps [ns] and, by field, one value per message."""

    stamps: list[int] = field(default_factory=list)
    values: dict[str, list[Any]] = field(default_factory=dict)

    def add(self, stamp: int, message: Any) -> None:
        """Append a message with its time stamp."""
        self.append(stamp, signals_of(message))

    def append(self, stamp: int, values: Mapping[str, Any]) -> None:
        """Append the values of a message with its time stamp."""
        self.stamps.append(stamp)
        for name, value in values.items():
            self.values.setdefault(name, []).append(value)


@dataclass(frozen=True, repr=False)
class Recording:
    """Recording of all signal topics of a run.

    Attributes:
        types: message type by fully qualified topic.
        dense: array of each field, shape (samples,), by fully qualified topic.
        sparse: sparse messages by fully qualified topic.
        step_ns: sampling step [ns]; 0 without a dense topic.
        first: index of the first sample of the arrays; 0 except in a snapshot.
        lost: reason why the recording ends before the run, at the loss of a member; empty if it does not.

    Example:
        >>> import lathe_rc
        >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=3"])
        >>> recording = lathe_rc.run(piston).recording
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
    lost: str = ""

    def __repr__(self) -> str:
        """Return a one-line summary of the content."""
        size = f"{self.samples} samples ({self.samples * self.step_ns * 1e-9:.3g} s)"
        told = [
            f"{len(self.types)} topics",
            size,
            self.turned(),
            *self.errors.told(),
            *filter(None, [self.sound_form[1]]),
        ]
        return f"<Recording: {', '.join(told)}>"

    def _repr_html_(self) -> str:
        """Return an HTML table of the topics with their fields and units, for notebooks."""
        rows = []
        for topic, kind in self.types.items():
            dense = topic in self.dense
            count = self.samples if dense else len(self.sparse[topic].stamps)
            fields = ", ".join(column.label for column in columns(kind)[2:])
            rows.append((topic, f"{count} {'samples' if dense else 'messages'}", fields))
        return html.table(("topic", "", "fields"), rows) + self.errors_picture()

    def errors_picture(self) -> str:
        """Return an HTML image of the form error by revolution; empty without a revolution."""
        return html.errors_picture(self.errors, self.turns_before if self.errors.rms.size else 0)

    def turned(self) -> str:
        """Describe the number of complete revolutions."""
        count = self.revolutions
        return f"{count} revolution{'' if count == 1 else 's'}"

    @property
    def turns_before(self) -> int:
        """Number of revolutions before the first complete one, as in a snapshot; needs a recorded encoder."""
        return turns_before(self.of_type(messages.ENCODER)["angle_true"], self.first)

    @property
    def samples(self) -> int:
        """Number of samples of each dense topic."""
        return next((array.size for signals in self.dense.values() for array in signals.values()), 0)

    @property
    def revolutions(self) -> int:
        """Number of complete revolutions; 0 without a recorded encoder."""
        if messages.ENCODER not in {self.types[topic] for topic in self.dense}:
            return 0
        turns = self.of_type(messages.ENCODER)["angle_true"][-2:] / (2.0 * np.pi)
        return max(turns_at_end(*turns.tolist()) - self.turns_before, 0) if turns.size == 2 else 0

    @cached_property
    def errors(self) -> FormErrors:
        """Form error of each complete revolution; empty if there is no tool."""
        return self.form.found()

    @cached_property
    def form(self) -> RunningForm:
        """Form of the part by revolution."""
        return self.form_by(())

    def form_by(self, zones: Sequence[Zone]) -> RunningForm:
        """Return the form of the part by revolution, and by zones with tolerances of their own."""
        form = RunningForm.of(self.types, zones)
        form.chunk(self.first, self.samples, self.dense, self.events)
        return form

    @cached_property
    def sound_form(self) -> tuple[int, str]:
        """Number of samples on which the form error may rest, and the reason if these are not those of the whole run.

        The reason is a fault of a signal that the form error is made of, or the loss of a member (`lost`).
        """
        soundness = Soundness.of_form(self.types)
        sound = soundness.sound(self.first, self.samples, self.events)
        return sound, soundness.why or self.lost

    @property
    def events(self) -> dict[str, list[Sparse]]:
        """Events of the nodes at samples, by topic."""
        topics = [topic for topic in self.sparse if self.types[topic] == messages.EVENT] if self.step_ns else []
        return {topic: self.messages(topic) for topic in topics}

    def frame(self, topic: str) -> Any:
        """Return a topic as a table with one row per sample or message, or per element of a message with lists.

        The columns are those of `lathe_export.tables.export`: ``sample``, ``time`` [s] (sample 0 is at 1 s) and the
        fields of the message. If the recording has an encoder, two more columns come before the fields: ``revolution``,
        counted from 1, and ``spindle_angle``, the true angle within the revolution [rad].

        Args:
            topic: topic name, with or without the leading slash.

        Returns:
            If pandas is installed, a ``pandas.DataFrame`` with a copy of the samples, indexed by ``time``, and with the
            topic and the units of the columns in ``attrs``. Otherwise a ``pyarrow.Table`` with the units in the
            metadata of the fields, as in an exported Parquet file.

        Raises:
            InputError: there is no such topic.

        Example:
            >>> import lathe_rc
            >>> piston = lathe_rc.load("piston", ["spindle_encoder.revolutions=3"])
            >>> tool = lathe_rc.run(piston).recording.frame("/tool")
            >>> (tool["error"].abs() * 1e6).groupby(tool["revolution"]).max().round(1).to_dict()
            {1: 232.7, 2: 13.4, 3: 4.0}
            >>> tool.attrs["units"]["error"]
            'm'
        """
        from lathe_rc.cell import frames  # pyarrow is slow to import

        name = full(topic)
        if name not in self.types:
            raise InputError(f"no topic {topic!r} in the recording; allowed: {', '.join(self.types)}")
        table: Sequence[Column] = columns(self.types[name])
        rows: Mapping[str, Samples]
        if name in self.dense:
            rows = dense_rows(self.first, self.dense[name], self.step_ns)
        else:
            rows = sparse_rows(table, self.messages(name), self.step_ns)
        if messages.ENCODER in {self.types[known] for known in self.dense}:
            angle = self.of_type(messages.ENCODER)["angle_true"][rows["sample"] - self.first]
            table, rows = frames.with_spindle(table, rows, angle)
        return frames.frame(name, table, rows)

    def plot(self, title: str = "", beside: "tuple[str, Recording] | None" = None) -> "Figure":
        """Plot the desired form, and the form error over angle and by revolution (see `lathe_rc.drawing.form.draw`).

        Args:
            title: title of the figure.
            beside: name and recording of another run of the same part, whose errors are drawn as well.

        Raises:
            InputError: there is no tool, or no complete revolution.
        """
        from lathe_rc.drawing import form  # Matplotlib is slow to import

        other = beside and (beside[0], beside[1].turned_form())
        return form.draw(self.turned_form(), title, other)

    def turned_form(self) -> "TurnedForm":
        """Return the turned form of the part, for a figure.

        Raises:
            InputError: there is no tool, or no complete revolution.
        """
        from lathe_rc.drawing.form import TurnedForm

        if not self.errors.rms.size:
            kinds = set(self.types.values())
            both = (("encoder", messages.ENCODER), ("tool", messages.TOOL))
            missing = [name for name, kind in both if kind not in kinds]
            why = (
                f"no {' and no '.join(missing)}; record both"
                if missing
                else f"no complete revolution{f': {why}' if (why := self.sound_form[1]) else '; let it run longer'}"
            )
            raise InputError(f"nothing to draw: the recording has {why}")
        angle, tool = self.of_type(messages.ENCODER)["angle_true"], self.of_type(messages.TOOL)
        return TurnedForm(angle, tool["reference"], tool["error"], self.errors, self.turns_before)

    def messages(self, topic: str) -> list[Sparse]:
        """Return the messages of a sparse topic, by its fully qualified name."""
        found, kind = self.sparse[topic], self.types[topic]
        rows = [dict(zip(found.values, row, strict=True)) for row in zip(*found.values.values(), strict=True)]
        places = [(stamp - START_NS) // self.step_ns for stamp in found.stamps]
        return [Sparse(topic, kind, index, values) for index, values in zip(places, rows, strict=True)]

    def of_type(self, msgtype: str) -> Signals:
        """Return the signals of the first topic of a block type."""
        return next(signals for topic, signals in self.dense.items() if self.types[topic] == msgtype)

    def digests(self) -> dict[str, str]:
        """Return the digest of each signal topic, by topic.

        A digest is the SHA-256 of the concatenated SHA-256 hashes of each field's samples (little-endian), in the order
        of the fields; for sparse topics, the time stamps come first. The digest does not depend on the block size.
        """
        arrays = [(topic, array) for topic, signals in self.dense.items() for array in signals.values()]
        with ThreadPoolExecutor() as threads:
            hashes = list(threads.map(lambda each: hashlib.sha256(_bytes(each[1])).digest(), arrays))
        found: dict[str, list[bytes]] = {}
        for (topic, _), digest in zip(arrays, hashes, strict=True):
            found.setdefault(topic, []).append(digest)
        return _digests(found, self.sparse)


class Digester:
    """Digests of a run whose signals arrive in chunks (see `Recording.digests`).

    A thread computes the digests in parallel with the caller, without holding the interpreter lock.
    """

    def __init__(self) -> None:
        self._topics: dict[str, _Topic] = {}
        self._thread = ThreadPoolExecutor(1)

    def dense(self, topic: str, signals: Signals) -> None:
        """Append the next samples of a dense topic, as arrays of shape (n,) by field, which are copied."""
        found = self._topics.get(topic)
        if found is None:
            found = self._topics[topic] = _Topic(signals, self._thread)
        found.add(signals)

    def result(self, sparse: Mapping[str, SparseTopic]) -> dict[str, str]:
        """Return the digest of each topic; ``sparse`` contains the sparse topics in full."""
        return _digests({topic: part.digests() for topic, part in self._topics.items()}, sparse)


def _digests(dense: Mapping[str, list[bytes]], sparse: Mapping[str, SparseTopic]) -> dict[str, str]:
    """Return the digest of each topic; ``dense`` contains the hashes of fields."""
    found = dict(dense)
    for topic, part in sparse.items():
        arrays = [np.array(part.stamps, dtype=np.int64), *map(_flat, part.values.values())]
        found[topic] = [hashlib.sha256(_bytes(array)).digest() for array in arrays]
    return {topic: hashlib.sha256(b"".join(parts)).hexdigest() for topic, parts in sorted(found.items())}


class _Topic:
    """Digests of the fields of a dense topic.

    Args:
        signals: first samples of the topic.
        thread: executor that computes the digests.
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
        """Append the next samples."""
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
        # Two buffers: one is filled while the thread hashes the other.
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
        """Return the digest of each field, including the last sample."""
        self._hand_over()
        self._wait()
        return [made.digest() for made in self._hashes]


def _bytes(samples: Samples) -> memoryview:
    return np.ascontiguousarray(samples, samples.dtype.newbyteorder("<")).data


def _flat(values: Sequence[Any]) -> Samples:
    """Concatenate the values of a field into one array; strings are converted to bytes with an end mark."""
    parts = []
    for value in values:
        for item in value if isinstance(value, list) else [value]:
            text = isinstance(item, str)
            parts.append(np.frombuffer(f"{item}\0".encode(), np.uint8) if text else np.atleast_1d(item))
    return np.concatenate(parts) if parts else np.empty(0)
