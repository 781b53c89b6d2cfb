# SPDX-License-Identifier: Apache-2.0
"""Blocks as CDR bytes, at the rate that a cell needs.

rosbags encodes and decodes any message, at 10 µs each. All blocks of a topic, however, are the same bytes but for a
few numbers and the samples. So for each length of block one message is encoded by rosbags, the places of the
numbers are found by changing them, and from then on only those places are written or read. Whatever
does not match the layout is decoded by rosbags and learned anew: CDR itself is nowhere written by hand.
"""

import struct
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lathe_rc.cell import messages
from lathe_rc.cell.messages import MAX_BLOCK, START_NS, Samples, Signals

_BILLION = 1_000_000_000
_MOST_FIELDS = 16
_ZEROS = np.zeros(_MOST_FIELDS * (MAX_BLOCK + 1))
_SHIFT = 4  # CDR aligns to what follows its first four bytes: with so many before, to memory as well
# What differs from block to block, but for the samples: the stamp, and what follows the texts of a BlockInfo.
_STAMP = struct.Struct("<iI")  # sec, nanosec
_INFO = struct.Struct("<QI?3xQ")  # first_index, step_ns, last, companions
_NOTHING, _ANYTHING = (0, 0, 0, 0, False, 0), (0x01010101, 0x01010101, 2**56 + 1, 0x01010101, True, 2**56 + 1)
_Numbers = tuple[int, int, int, int, bool, int]


def _message(msgtype: str, run_id: str, source: str, samples: int, numbers: _Numbers, fill: int = 0) -> bytes:
    """A block encoded by rosbags."""
    types = messages.store().types
    stamp = types["builtin_interfaces/msg/Time"](*numbers[:2])
    info = types[f"{messages.PACKAGE}/msg/BlockInfo"](run_id, source, *numbers[2:])
    arrays = [
        np.frombuffer(bytes([fill]) * (samples * dtype.itemsize), dtype)
        for dtype in messages.sample_fields(msgtype).values()
    ]
    return messages.encode(msgtype, types[msgtype](types["std_msgs/msg/Header"](stamp, ""), info, *arrays))


class _Layout:
    """Where everything stands in the blocks of one type, length and source."""

    def __init__(self, msgtype: str, run_id: str, source: str, samples: int) -> None:
        self.run_id, self.source, self.samples = run_id, source, samples
        self.template = _message(msgtype, run_id, source, samples, _NOTHING)
        blank = np.frombuffer(self.template, np.uint8)
        numbered = _message(msgtype, run_id, source, samples, _ANYTHING)
        different = np.flatnonzero(np.frombuffer(numbered, np.uint8) != blank)
        self.stamp = int(different[0])
        self.info = int(different[different >= self.stamp + _STAMP.size][0])
        patched = bytearray(self.template)
        _STAMP.pack_into(patched, self.stamp, *_ANYTHING[:2])
        _INFO.pack_into(patched, self.info, *_ANYTHING[2:])
        assert patched == numbered, "the numbers of a block are not where CDR should have them"
        changing = np.zeros(len(self.template), dtype=bool)
        changing[self.stamp : self.stamp + _STAMP.size] = True
        changing[self.info : self.info + _INFO.size] = True
        filled = np.frombuffer(_message(msgtype, run_id, source, samples, _NOTHING, fill=1), np.uint8) != blank
        changing |= filled
        self.fields: dict[str, tuple[np.dtype[Any], int]] = {}
        edges = np.flatnonzero(np.diff(filled.astype(np.int8), prepend=0) == 1)
        for (name, dtype), start in zip(messages.sample_fields(msgtype).items(), edges, strict=True):
            self.fields[name] = dtype, int(start)
        # Everything else is the same in each block: texts, lengths, padding.
        bounds = np.flatnonzero(np.diff(changing.astype(np.int8), prepend=1, append=1))
        self.constant = [(int(a), int(b), self.template[a:b]) for a, b in zip(bounds[::2], bounds[1::2], strict=True)]

    def fits(self, data: bytes) -> bool:
        """Whether a message has this layout."""
        if len(data) != len(self.template):
            return False
        for a, b, text in self.constant:  # noqa: SIM110 - a generator costs more than the comparisons
            if data[a:b] != text:
                return False
        return True


class Room(NamedTuple):
    """Memory of a message, for the samples of a block to be computed into.

    Attributes:
        signals: its arrays by field; zero at first.
        message: the whole, shape (bytes,).
        reals: all float64 arrays and the lengths between them as one array; None where a type has others too.
    """

    signals: Signals
    message: Samples
    reals: Samples | None


class _Form:
    """How blocks of one length are made."""

    def __init__(self, layout: _Layout) -> None:
        self.template, self.samples = np.frombuffer(layout.template, np.uint8), layout.samples
        self.stamp, self.info = layout.stamp, layout.info
        self.fields = [(name, dtype, place + _SHIFT) for name, (dtype, place) in layout.fields.items()]
        places = [place for _, dtype, place in self.fields if dtype == np.float64]
        gaps = set(np.diff(places).tolist()) or {8 * layout.samples}
        # Evenly spaced, the arrays are rows of one.
        self.rows = (len(places), layout.samples) if len(places) == len(self.fields) and len(gaps) == 1 else None
        self.names, self.start, self.strides = [name for name, _, _ in self.fields], places[0], (min(gaps), 8)
        self.reals = min(gaps) // 8 * (len(places) - 1) + layout.samples

    def room(self) -> Room:
        """Memory for one more."""
        memory = np.empty(self.template.size + _SHIFT, np.uint8)
        message = memory[_SHIFT:]
        message[:] = self.template
        if self.rows is None:
            signals = {name: np.frombuffer(memory, dtype, self.samples, place) for name, dtype, place in self.fields}
            return Room(signals, message, None)
        rows = np.ndarray(self.rows, np.float64, memory, self.start, self.strides)
        reals = np.frombuffer(memory, np.float64, self.reals, self.start)
        return Room(dict(zip(self.names, rows, strict=True)), message, reals)


@dataclass(slots=True)
class Block:
    """A block as it came; the samples are views of its bytes.

    Attributes:
        run_id, source, first_index, step_ns, last, companions: see BlockInfo.msg.
        samples: its length.
        log_ns: its stamp [ns].
    """

    run_id: str
    source: str
    first_index: int
    step_ns: int
    last: bool
    companions: int
    samples: int
    log_ns: int
    signals: Signals

    def copy_to(self, signals: Signals, *, check: bool = True) -> None:
        """Copy samples into arrays of shape (samples,), by field.

        Raises:
            ValueError: a sample is NaN or infinite, unless that has been checked.
        """
        for name, array in signals.items():
            array[:] = self.signals[name]
            if check:
                self._check(name, array)

    def check(self, reals: Samples | None) -> None:
        """Refuse samples that no reader could use; ``reals`` are all of them at once, see `Room`.

        Raises:
            ValueError: a sample is NaN or infinite.
        """
        if reals is None or np.dot(reals, _ZEROS[: reals.size]) != 0.0:
            for name, array in self.signals.items():
                self._check(name, array)

    def _check(self, name: str, array: Samples) -> None:
        # 0 times anything finite is 0, and NaN otherwise: one product tells for the whole block.
        if array.dtype == np.float64 and np.dot(array, _ZEROS[: self.samples]) != 0.0:
            bad = int(np.flatnonzero(~np.isfinite(array))[0])
            raise ValueError(
                f"{self.source} sends {name} = {array[bad]} at sample {self.first_index + bad}; allowed: finite numbers"
            )


class Encoder:
    """Makes the blocks of one topic.

    Args:
        msgtype: message type.
        run_id: identity of the run.
        source: fully qualified name of the node.
        step_ns: sampling step [ns].
    """

    def __init__(self, msgtype: str, run_id: str, source: str, step_ns: int) -> None:
        self._type, self._run_id, self._source, self._step_ns = msgtype, run_id, source, step_ns
        self._forms: dict[int, _Form] = {}

    def prepare(self, samples: int) -> None:
        """Learn the layout for a length ahead of its first block."""
        self._form(samples)

    def _form(self, samples: int) -> _Form:
        form = self._forms[samples] = _Form(_Layout(self._type, self._run_id, self._source, samples))
        return form

    def room(self, samples: int) -> Room:
        """Memory for a block's message."""
        return (self._forms.get(samples) or self._form(samples)).room()

    def block(self, first: int, signals: Signals, *, last: bool, companions: int) -> Block:
        """The same block as readers find it who need no bytes; it holds ``signals`` themselves."""
        samples = next(iter(signals.values())).size
        log_ns = START_NS + (first + samples - 1) * self._step_ns
        return Block(self._run_id, self._source, first, self._step_ns, last, companions, samples, log_ns, signals)

    def stamp(self, room: Room, first: int, samples: int, *, last: bool, companions: int) -> int:
        """Complete a message whose samples have been computed, with the time of its last sample.

        Args:
            room: its memory.
            first: index of its first sample.
            samples: its length.
            last: the run ends with it.
            companions: see BlockInfo.msg.

        Returns:
            The stamp [ns].
        """
        log_ns = START_NS + (first + samples - 1) * self._step_ns
        form, data = self._forms[samples], room.message.data
        _STAMP.pack_into(data, form.stamp, *divmod(log_ns, _BILLION))
        _INFO.pack_into(data, form.info, first, self._step_ns, last, companions)
        return log_ns

    def encode(self, first: int, signals: Signals, *, last: bool, companions: int) -> tuple[int, bytes]:
        """A block of arrays that are elsewhere; stamp [ns] and bytes. See `stamp`."""
        samples = next(iter(signals.values())).size
        room = self.room(samples)
        for name, array in room.signals.items():
            array[:] = signals[name]
        return self.stamp(room, first, samples, last=last, companions=companions), room.message.tobytes()


class Decoder:
    """Reads the blocks of one topic.

    Args:
        msgtype: message type.
        fields: those whose samples are wanted; default: all.
    """

    def __init__(self, msgtype: str, fields: list[str] | None = None) -> None:
        self._type = msgtype
        self._fields = list(messages.sample_fields(msgtype)) if fields is None else fields
        self._layout: _Layout | None = None

    def prepare(self) -> None:
        """Let rosbags build its codec of the type ahead of the first block."""
        messages.decode(self._type, _message(self._type, "", "", 1, _NOTHING))

    def decode(self, data: bytes) -> Block:
        """A block from its bytes.

        Raises:
            ValueError: the arrays of the block have different lengths, or it has none.
        """
        layout = self._layout
        if layout is None or not layout.fits(data):
            layout = self._layout = self._learn(data)
        sec, nanosec = _STAMP.unpack_from(data, layout.stamp)
        first_index, step_ns, last, companions = _INFO.unpack_from(data, layout.info)
        samples = layout.samples
        fields = layout.fields
        return Block(
            layout.run_id,
            layout.source,
            first_index,
            step_ns,
            last,
            companions,
            samples,
            sec * _BILLION + nanosec,
            {name: np.frombuffer(data, fields[name][0], samples, fields[name][1]) for name in self._fields},
        )

    def _learn(self, data: bytes) -> _Layout:
        message = messages.decode(self._type, data)
        lengths = sorted({getattr(message, name).size for name in messages.sample_fields(self._type)})
        info = message.block
        if len(lengths) != 1 or lengths[0] == 0:
            raise ValueError(f"{info.source} sends arrays of {lengths} samples in one block")
        layout = _Layout(self._type, info.run_id, info.source, lengths[0])
        if not layout.fits(data):
            raise ValueError(f"{info.source} sends a block that is not encoded as little-endian CDR with no frame_id")
        return layout
