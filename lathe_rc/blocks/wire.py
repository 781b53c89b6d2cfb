# SPDX-License-Identifier: Apache-2.0
"""CDR encoding and decoding of blocks, at the rate that a cell needs.

rosbags encodes and decodes any message, in 10 µs each. All blocks of a topic, however, have equal bytes except for a
few numbers and the samples. For each block length, one message is therefore encoded by rosbags, the offsets of the
numbers are found by changing the numbers, and from then on only the bytes at those offsets are written or read. A
message that does not match the layout is decoded by rosbags and analysed again; no CDR code is written by hand. CDR
does not specify the content of padding, the byte order or the padding of the encapsulation, and a publisher may set a
frame: a block that differs in these respects is re-encoded by rosbags, which takes 10 to 50 µs, and then read like one
from lathe_rc.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from lathe_rc import messages
from lathe_rc.blocks.block import Block, is_finite
from lathe_rc.messages import START_NS, Samples, Signals

_BILLION = 1_000_000_000
_SHIFT = 4  # CDR aligns relative to the end of its 4-byte header; this many bytes in front align it in memory as well
# Numbers that differ between blocks: the stamp, and the fields after the strings of a BlockInfo.
_STAMP = struct.Struct("<iI")  # sec, nanosec
_INFO = struct.Struct("<QI?3xQ")  # first_index, step_ns, last, companions
NUMBERS = ("sec", "nanosec", "first_index", "step_ns", "last", "companions")  #: names of these numbers
_NOTHING, _ANYTHING = (0, 0, 0, 0, False, 0), (0x01010101, 0x01010101, 2**56 + 1, 0x01010101, True, 2**56 + 1)
_Numbers = tuple[int, int, int, int, bool, int]


def _message(msgtype: str, run_id: str, source: str, samples: int, numbers: _Numbers, fill: int = 0) -> bytes:
    """Return a block encoded by rosbags."""
    types = messages.store().types
    stamp = types["builtin_interfaces/msg/Time"](*numbers[:2])
    info = types[f"{messages.PACKAGE}/msg/BlockInfo"](run_id, source, *numbers[2:])
    arrays = [
        np.frombuffer(bytes([fill]) * (samples * dtype.itemsize), dtype)
        for dtype in messages.sample_fields(msgtype).values()
    ]
    return messages.encode(msgtype, types[msgtype](types["std_msgs/msg/Header"](stamp, ""), info, *arrays))


class Layout:
    """Byte layout of the blocks of one type, length and source.

    Attributes:
        run_id, source, samples: see `Block`.
        template: message in which all numbers and samples are 0.
        stamp, info: offsets of the stamp and of the numbers of a BlockInfo.
        fields: element type and offset of the samples by name.
        constant: start, end and content of the constant bytes.
    """

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
        # Everything else is constant across blocks: strings, lengths, padding.
        bounds = np.flatnonzero(np.diff(changing.astype(np.int8), prepend=1, append=1))
        self.constant = [(int(a), int(b), self.template[a:b]) for a, b in zip(bounds[::2], bounds[1::2], strict=True)]

    @cached_property
    def same(self) -> Samples:
        """Positions of the bytes that are constant across blocks."""
        return np.concatenate([np.arange(begin, end) for begin, end, _ in self.constant])

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """Unaligned NumPy type of the message: `NUMBERS`, and the fields with all their samples, by name."""
        info = [self.info + place for place in (0, 8, 12, 16)]
        fields = [(dtype, (self.samples,)) for dtype, _ in self.fields.values()]
        return np.dtype(
            {
                "names": [*NUMBERS, *self.fields],
                "formats": ["<i4", "<u4", "<u8", "<u4", "?", "<u8", *fields],
                "offsets": [self.stamp, self.stamp + 4, *info, *(place for _, place in self.fields.values())],
                "itemsize": len(self.template),
            }
        )

    @cached_property
    def numbers(self) -> list[tuple[int, int]]:
        """Offset and length of the arrays of numbers, those that follow each other in one with their lengths."""
        runs: list[tuple[int, int]] = []
        for dtype, place in self.fields.values():
            if dtype != np.float64:
                continue
            first = runs.pop()[0] if runs and place == runs[-1][0] + 8 * runs[-1][1] + 8 else place
            runs.append((first, (place - first) // 8 + self.samples))
        return runs

    def fits(self, data: bytes) -> bool:
        """Return whether a message has this layout."""
        if len(data) != len(self.template):
            return False
        for a, b, text in self.constant:  # noqa: SIM110 - a generator costs more than the comparisons
            if data[a:b] != text:
                return False
        return True


class _Scratch:
    """Reusable buffer for messages of one length."""

    def __init__(self, layout: Layout) -> None:
        memory = np.empty(len(layout.template) + _SHIFT, np.uint8)
        memory[_SHIFT:] = np.frombuffer(layout.template, np.uint8)
        self._message, self._layout = memory[_SHIFT:], layout
        self.signals = {
            name: np.frombuffer(memory, dtype, layout.samples, place + _SHIFT)
            for name, (dtype, place) in layout.fields.items()
        }

    def message(self, log_ns: int, first: int, step_ns: int, *, last: bool, companions: int) -> bytes:
        """Return the complete message, after the samples have been set."""
        data = self._message.data
        _STAMP.pack_into(data, self._layout.stamp, *divmod(log_ns, _BILLION))
        _INFO.pack_into(data, self._layout.info, first, step_ns, last, companions)
        return data.tobytes()


class Encoder:
    """Encoder of the blocks of one topic.

    Args:
        msgtype: message type.
        run_id: ID of the run.
        source: fully qualified name of the node.
        step_ns: sampling step [ns].
    """

    def __init__(self, msgtype: str, run_id: str, source: str, step_ns: int) -> None:
        self._type, self._run_id, self._source, self._step_ns = msgtype, run_id, source, step_ns
        self._scratches: dict[int, _Scratch] = {}

    def prepare(self, samples: int) -> None:
        """Determine the layout for a block length before the first block of that length."""
        self._scratch(samples)

    def _scratch(self, samples: int) -> _Scratch:
        scratch = self._scratches.get(samples)
        if scratch is None:
            scratch = self._scratches[samples] = _Scratch(Layout(self._type, self._run_id, self._source, samples))
        return scratch

    def block(self, first: int, signals: Signals, whole: Samples | None, *, last: bool, companions: int) -> Block:
        """Return an unencoded block for readers in the same process; it holds the arrays themselves (see `Pool`)."""
        samples = next(iter(signals.values())).size
        log_ns = START_NS + (first + samples - 1) * self._step_ns
        run_id, source, step_ns = self._run_id, self._source, self._step_ns
        return Block(run_id, source, first, step_ns, last, companions, samples, log_ns, signals, whole)

    def encode(self, first: int, signals: Signals, *, last: bool, companions: int) -> tuple[int, bytes]:
        """Encode a block as a message.

        Args:
            first: index of the block's first sample.
            signals: samples of the block, as arrays of shape (n,) by field.
            last: whether the run ends with this block.
            companions: see BlockInfo.msg.

        Returns:
            The time stamp [ns], which is that of the last sample, and the bytes.
        """
        samples = next(iter(signals.values())).size
        scratch = self._scratch(samples)
        for name, array in scratch.signals.items():
            array[:] = signals[name]
        log_ns = START_NS + (first + samples - 1) * self._step_ns
        return log_ns, scratch.message(log_ns, first, self._step_ns, last=last, companions=companions)


@cache
def _create_codec(msgtype: str) -> None:
    messages.decode(msgtype, _message(msgtype, "", "", 1, _NOTHING))


class NoBlockError(ValueError):
    """Error for bytes that are not a block, so that the sender is unknown."""


class Decoder:
    """Decoder of the blocks of one topic.

    Args:
        msgtype: message type.
        fields: requested fields; None: all.
        admit: called with the run and source of each block whose layout is not that of the previous one; may raise an
            error to reject the block.

    Attributes:
        message: last decoded block, encoded as by `Encoder`: the received bytes, unless these were encoded differently.
    """

    def __init__(
        self, msgtype: str, fields: list[str] | None = None, admit: Callable[[str, str], None] | None = None
    ) -> None:
        self._type, self._admit = msgtype, admit
        self._fields = list(messages.sample_fields(msgtype)) if fields is None else fields
        self._layout: Layout | None = None
        self.message = b""

    def prepare(self) -> None:
        """Create the rosbags codec of the message type before the first block arrives."""
        _create_codec(self._type)

    def decode(self, data: bytes) -> Block:
        """Decode a block.

        Raises:
            NoBlockError: the bytes are not a block.
            ValueError: the arrays of the block are empty or differ in length.
        """
        layout = self._layout
        if layout is None or not layout.fits(data):
            layout, data = self._learn(data)
        self.message = data
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

    def check(self) -> None:
        """Check that no number of the last decoded block is NaN or infinite, in fields that are not requested either.

        Raises:
            ValueError: a number is; the message names the first.
        """
        assert self._layout is not None, "a block has been decoded"
        # The length of an array, read as a number, is finite.
        if any(not is_finite(np.frombuffer(self.message, np.float64, *run[::-1])) for run in self._layout.numbers):
            Decoder(self._type).decode(self.message).check()

    def decode_all(self, whole: bytes, places: Samples) -> Iterator[tuple[Block, int]]:
        """Decode several blocks, joining consecutive ones, in a fraction of the time of separate calls.

        Joined blocks follow one another also by their time stamps, and none but the last ends the run.

        Args:
            whole: bytes that contain all blocks, possibly among others.
            places: start and end of each block, shape (blocks, 2).

        Yields:
            Each joined block, and the number of blocks in it.

        Raises:
            ValueError: see `decode`.
        """
        begins, lengths = places[:, 0], places[:, 1] - places[:, 0]
        start = 0
        while start < len(places):
            begin, length = int(begins[start]), int(lengths[start])
            first = self.decode(data := whole[begin : begin + length])
            if self.message is not data:  # the block was encoded differently, so its samples have other offsets
                yield first, 1
                start += 1
                continue
            assert self._layout is not None, "that has been learned"
            other = np.flatnonzero(lengths[start:] != length)
            stop = start + int(other[0]) if other.size else len(places)
            # A strided view with a record at each byte, created without copying; indexing selects the starts of blocks.
            anywhere: Samples = np.ndarray(len(whole) - length + 1, f"V{length}", whole, strides=(1,))
            records = anywhere[begins[start:stop]].view(self._layout.dtype)
            count = self._following(records, first)
            yield self._joined(records[:count], first), count
            start += count

    def _following(self, records: Samples, first: Block) -> int:
        """Return how many records, starting at the first, are consecutive blocks."""
        assert self._layout is not None, "that has been learned"
        constant = records.view(np.uint8).reshape(records.size, -1)[:, self._layout.same]
        fits = (constant == constant[0]).all(axis=1)
        counts = np.arange(records.size, dtype=np.uint64) * np.uint64(first.samples)
        # Computed in uint64, as in the message: the first index of a damaged block may be any number.
        fits &= records["first_index"] == np.uint64(first.first_index) + counts
        fits &= records["step_ns"] == first.step_ns
        stamps = records["sec"].astype(np.int64) * _BILLION + records["nanosec"]
        fits &= (stamps - first.log_ns).astype(np.uint64) == counts * np.uint64(first.step_ns)
        fits[1:] &= ~records["last"][:-1].astype(bool)
        return int(np.argmin(fits)) if not fits.all() else records.size

    def _joined(self, records: Samples, first: Block) -> Block:
        last = records[-1]
        return replace(
            first,
            last=bool(last["last"]),
            companions=int(last["companions"]),
            samples=records.size * first.samples,
            log_ns=int(last["sec"]) * _BILLION + int(last["nanosec"]),
            signals={name: records[name].reshape(-1) for name in self._fields},
        )

    def _learn(self, data: bytes) -> tuple[Layout, bytes]:
        """Return the layout of a block that does not match the previous one, and the block, re-encoded if necessary."""
        try:
            message = messages.decode(self._type, data)
        except ValueError as error:
            raise NoBlockError(str(error)) from None
        info = message.block
        if self._admit is not None:
            self._admit(info.run_id, info.source)
        lengths = sorted({getattr(message, name).size for name in messages.sample_fields(self._type)})
        if len(lengths) != 1 or lengths[0] == 0:
            raise ValueError(f"{info.source} sends arrays of {lengths} samples in one block")
        layout, wanted = self._layout, (info.run_id, info.source, lengths[0])
        if layout is None or (layout.run_id, layout.source, layout.samples) != wanted:
            layout = Layout(self._type, *wanted)
        if not layout.fits(data):
            message.header.frame_id = ""
            data = messages.encode(self._type, message)
        self._layout = layout
        return layout, data
